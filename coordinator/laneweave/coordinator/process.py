"""The coordinator process over Zenoh."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

import structlog

from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.planning.solve import warm_up
from laneweave.protocol.runtime.message_faults import CoreWrapper, unwrapped
from laneweave.protocol.runtime.metrics import Observe, unobserved
from laneweave.protocol.runtime.processes import accepted_stop_signals
from laneweave.protocol.runtime.worker_pool import WorkerPool
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.transports.zenoh.runner import run_core
from laneweave.protocol.wire.identities import Incarnations
from laneweave.protocol.wire.messages import Name

log = structlog.get_logger(__name__)

WARN_AFTER_S = 8.0
"""Time until a warning; loading the planner takes 1 to 2 s, compiling it nearly a minute."""


def run_coordinator(
    scenario: Scenario,
    name: str,
    wrap: CoreWrapper = unwrapped,
    observe: Observe = unobserved,
    *,
    fork_workers: bool = False,
) -> None:
    """Run a coordinator candidate until SIGINT or SIGTERM.

    The planner is loaded first, so that a leader can plan at once.

    Args:
        scenario: road and deployment.
        name: name of the candidate; candidates are ranked by name.
        wrap: wraps the core, to inject faults.
        observe: registers the metrics source.
        fork_workers: whether the planning service forks its worker processes now, with the planner
            loaded, instead of starting new ones at its first request.

    Raises:
        BadInputError: no router answers at the scenario's endpoint.
    """
    with _exits_on_stop_signals(), _warns_when_slow():
        warm_up()
    workers = scenario.service.workers or max(1, len(os.sched_getaffinity(0)) - 1)
    core = CoordinatorCore(Name(name), Incarnations()(), scenario, workers=workers)
    with contextlib.closing(WorkerPool(workers, warm_up)) as pool:
        if fork_workers:
            pool.fork()
        run_core(wrap(core), access_of(scenario, f"coordinator.{name}"), pool, observe)


@contextlib.contextmanager
def _exits_on_stop_signals() -> Iterator[None]:
    """Exit with status 0 on a stop signal: there is nothing to complete yet.

    An exception that a signal handler raises in a compiler callback would only be printed, so a
    thread waits for the byte that Python writes when a signal arrives.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    before = {number: signal.signal(number, lambda *_: None) for number in accepted_stop_signals()}
    descriptor = signal.set_wakeup_fd(writer)

    def wait() -> None:
        if os.read(reader, 1):
            os._exit(0)
        os.close(reader)

    threading.Thread(target=wait, name="end", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(descriptor)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(writer)  # ends the thread


@contextlib.contextmanager
def _warns_when_slow() -> Iterator[None]:
    """Warn if the planner has to be compiled rather than just loaded."""
    timer = threading.Timer(
        WARN_AFTER_S, log.warning, ("compiling the planner once; this takes about a minute",)
    )
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
