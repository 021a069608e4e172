"""SUMO drives all vehicles of a corridor itself: what laneweave is compared with.

The vehicles are the same. Those that depart on the corridor's first edge, or on a ramp, do so at
its start, in the lane that suits them best, whatever their files say: otherwise their trips would
not be as long as with laneweave.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from laneweave.sim_bridge.corridors.corridor_setup import MAX_WAIT_S, CorridorSetup
from laneweave.sim_bridge.sumo.simulation import SumoProcess


def drive_alone(
    setup: CorridorSetup,
    folder: Path,
    results: Path,
    progress: Callable[[float], None] = lambda _: None,
) -> None:
    """Run a simulation in which SUMO drives all vehicles, and write its statistics.

    Args:
        setup: corridor and scenario.
        folder: folder for temporary files.
        results: folder for SUMO's statistics.
        progress: called with the share of the simulated time that has passed.

    Raises:
        SumoUnavailableError: libsumo cannot be loaded.
        SumoFailedError: SUMO rejects a file.
    """
    # After a run of laneweave, SUMO drives on for up to this time (`CorridorWorld.drive_on`).
    begin_s, end_s = setup.found.simulation.demand.begin_s, setup.end_s + MAX_WAIT_S
    awaited = {*setup.by_name}
    with SumoProcess(setup.command_alone(folder, results)) as sumo:
        while awaited and (now_s := sumo.simulation.getTime()) < end_s:
            sumo.step()
            awaited.difference_update(sumo.simulation.getArrivedIDList())
            progress((now_s - begin_s) / (end_s - begin_s))
