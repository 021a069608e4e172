"""The bridge process, which connects SUMO to Zenoh."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from laneweave.protocol.radio.radio_core import over_radio
from laneweave.protocol.runtime.message_faults import CoreWrapper, unwrapped
from laneweave.protocol.runtime.metrics import Observe, unobserved
from laneweave.protocol.runtime.processes import interrupts_deferred
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.summary import Ending
from laneweave.protocol.transports.zenoh.runner import run_core
from laneweave.protocol.wire.identities import Incarnations
from laneweave.protocol.wire.topics import Party
from laneweave.sim_bridge.core import BridgeCore
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.obstacles import Breakdown
from laneweave.sim_bridge.road_sources import demand_of, open_road


def run_bridge(
    scenario: Scenario,
    folder: Path,
    method: str,
    pace: float | None,
    wrap: CoreWrapper = unwrapped,
    observe: Observe = unobserved,
    breakdowns: Iterable[Breakdown] = (),
) -> None:
    """Run the simulated world until all vehicles have left, or until SIGINT or SIGTERM.

    Args:
        scenario: complete configuration.
        folder: the run's folder.
        method: name of the control method in the summary.
        pace: maximum road seconds per wall-clock second; None: the scenario's.
        wrap: wraps the core, to inject faults.
        observe: registers the metrics source.
        breakdowns: vehicles that break down.

    Raises:
        BadInputError: no router answers at the scenario's endpoint.
        SumoUnavailableError: libsumo cannot be loaded.
    """
    access = access_of(scenario, "bridge")
    with open_road(demand_of(scenario), folder) as road, ExitStack() as closing:
        # A signal must not leave a record behind that is not closed.
        with interrupts_deferred():
            record = RunRecord(folder, scenario, method, time.perf_counter, road.left_out)
            incarnations = Incarnations()
            core = BridgeCore(
                scenario,
                road.world,
                record,
                road.stream,
                new_incarnation=incarnations,
                pace=pace,
                incarnation=incarnations(),
                outside_traffic=road.outside_traffic,
                breakdowns=breakdowns,
            )
            # Also after an error, to save the recorded data.
            closing.callback(lambda: record.close(core.t_s, Ending.INTERRUPTED))
        received = over_radio(core, scenario, Party.BRIDGE, Party.BRIDGE)
        run_core(wrap(received), access, observe=observe)
