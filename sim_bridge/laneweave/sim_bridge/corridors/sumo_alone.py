"""SUMO drives all vehicles of a corridor itself: what laneweave is compared with.

The vehicles are the same. Those that depart on the corridor's first edge do so at its start, in
the lane that suits them best, whatever their files say: otherwise their trips would not be as long
as with laneweave.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from laneweave.sim_bridge.corridors.corridor_arrivals import CorridorSetup
from laneweave.sim_bridge.corridors.sumo_config import sumo_command
from laneweave.sim_bridge.corridors.sumo_statistics import AGAIN
from laneweave.sim_bridge.sumo.simulation import SumoProcess


def drive_alone(
    setup: CorridorSetup,
    seed: int,
    folder: Path,
    results: Path,
    progress: Callable[[float], None] = lambda _: None,
) -> None:
    """Run a simulation in which SUMO drives all vehicles, and write its statistics.

    Args:
        setup: network, demand, corridor.
        seed: SUMO's seed.
        folder: folder for temporary files.
        results: folder for SUMO's statistics.
        progress: called with the share of the simulated time that has passed.

    Raises:
        SumoUnavailableError: libsumo cannot be loaded.
        SumoFailedError: SUMO rejects a file.
    """
    config = setup.config
    command = sumo_command(config, config.step_s, seed, folder, results, setup.corridor.edge_names)
    waiting = {
        one.origin.vehicle.name: one.origin.vehicle
        for one in setup.arrivals
        if one.departs_at_start
    }
    awaited = {one.origin.vehicle.name for one in setup.arrivals}
    end_s = setup.end_s
    with SumoProcess(command) as sumo:
        while True:
            for name in sumo.simulation.getLoadedIDList():
                if name.startswith(AGAIN):
                    continue
                vehicle = waiting.pop(name, None)
                route = sumo.vehicle.getRoute(name)
                if vehicle is not None or setup.is_left_out(name, route):
                    sumo.vehicle.remove(name)
                if vehicle is not None:
                    sumo.route.add(f"{AGAIN}{name}", list(vehicle.route))
                    # The device for conflicts may still know the vehicle of a flow by its name.
                    sumo.vehicle.add(
                        f"{AGAIN}{name}",
                        f"{AGAIN}{name}",
                        typeID=vehicle.type_name,
                        depart=str(vehicle.depart_s),
                        departLane="best",
                        departPos="base",
                        departSpeed="max",
                    )
            now_s = sumo.simulation.getTime()
            if now_s >= end_s or not awaited:
                return
            sumo.step()
            arrived = sumo.simulation.getArrivedIDList()
            awaited.difference_update(name.removeprefix(AGAIN) for name in arrived)
            progress((now_s - config.begin_s) / (end_s - config.begin_s))
