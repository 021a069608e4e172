"""The entry point: Ctrl-C is delivered whatever the process does."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time

import pytest

INTERRUPTS = 60

# Everything is loaded by the real entry point: threads inherit its signal mask.
SOLVING = """
import signal, sys
from laneweave.launch.cli import main

def solve(_: list[str]) -> None:
    from laneweave.agents.driving.tracker import Tracker
    from laneweave.agents.driving.reference import Reference
    from laneweave.protocol.vehicle.motion import cell_state
    from laneweave.protocol.scenario.fields import Scenario
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.alarm(90)  # end even if the test has died
    scenario = Scenario()
    tracker = Tracker(scenario, scenario.vehicle)
    window = Reference.hold(scenario, scenario.vehicle, (3, 1)).window(0)
    s, *rest = cell_state(scenario.lattice, (3, 1), 0.0)
    for _ in range(int(sys.argv[1])):
        try:
            print("solving", flush=True)
            while True:
                tracker.solve((s + 1.0, *rest), window)
        except KeyboardInterrupt:
            print("interrupted", flush=True)

main._status = solve
main.main()
"""


@pytest.mark.slow
def test_no_interrupt_is_lost_while_osqp_solves() -> None:
    """Without the forwarding thread one in eight would be lost."""
    command = [sys.executable, "-c", SOLVING, str(INTERRUPTS)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        watchdog = threading.Timer(60.0, process.kill)
        watchdog.start()
        try:
            for index in range(INTERRUPTS):
                assert process.stdout.readline() == "solving\n"
                time.sleep(0.01 + 0.000_37 * index)
                process.send_signal(signal.SIGINT)
                assert process.stdout.readline() == "interrupted\n"
        finally:
            watchdog.cancel()
            process.kill()
