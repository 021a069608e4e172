"""Where the vehicles of a run come from: drawn arrivals, or a SUMO simulation of the user."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from attrs import field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.corridors.corridor_reading import read_corridor
from laneweave.sim_bridge.corridors.corridor_setup import SumoCorridor
from laneweave.sim_bridge.corridors.corridor_world import CorridorWorld
from laneweave.sim_bridge.corridors.sumo_demand import TimeWindow
from laneweave.sim_bridge.corridors.take_over import TakeOver
from laneweave.sim_bridge.road.demand import Arrival, arrivals
from laneweave.sim_bridge.road.outside_traffic import OutsideTraffic
from laneweave.sim_bridge.sumo.sumo_world import SumoWorld
from laneweave.sim_bridge.world_interface import World

TOLERANCE_M = 0.05
"""Maximum difference between the road of a scenario and that of its corridor."""


@frozen
class RoadSource:
    """A world, and the vehicles that come to it."""

    world: World
    stream: tuple[Arrival, ...] | None = None
    """The arrivals, by time; None: drawn from the scenario's seed."""
    outside_traffic: OutsideTraffic | None = None
    left_out: Mapping[str, int] = field(factory=dict)
    """Number of vehicles with routes through a corridor that it cannot serve, by reason."""


@contextmanager
def open_road(scenario: Scenario, results: Path) -> Iterator[RoadSource]:
    """Open the world of a scenario.

    Args:
        scenario: road, demand, vehicles.
        results: the run's folder, for SUMO's own statistics.

    Raises:
        BadInputError: the SUMO simulation cannot be read, or has another road.
        CommandFailedError: libsumo cannot be loaded, or SUMO rejects a file.
    """
    with temporary_folder("sumo") as folder:
        if not scenario.sumo.config:
            with SumoWorld(scenario, folder) as world:
                if scenario.sumo.gui:
                    world.show(scenario.runtime.tick_s)
                yield RoadSource(world)
            return
        found = sumo_corridor(scenario)
        setup = found.setup(scenario)
        with CorridorWorld(setup, folder, results) as world_of_sumo:
            if scenario.sumo.gui:
                world_of_sumo.show(scenario.runtime.tick_s)
            ramps = TakeOver(scenario, world_of_sumo)
            stream = tuple(one.arrival for one in setup.arrivals if one.departs_at_start)
            yield RoadSource(world_of_sumo, stream, ramps, found.demand.missing)
            world_of_sumo.drive_on()


def demanded(scenario: Scenario) -> tuple[Arrival, ...]:
    """Return all vehicles that may arrive; those from SUMO with the times of their departures."""
    if not scenario.sumo.config:
        return arrivals(scenario)
    return tuple(one.arrival for one in sumo_corridor(scenario).setup(scenario).arrivals)


def sumo_corridor(scenario: Scenario) -> SumoCorridor:
    """Return the corridor of a scenario, whose road must be that of the corridor.

    Raises:
        BadInputError: the simulation cannot be read, or has another road.
    """
    sumo = scenario.sumo
    window = TimeWindow(
        begin_s=sumo.begin_s, duration_s=scenario.demand.duration_s, scale=sumo.scale
    )
    found = read_corridor(Path(sumo.config), sumo.corridor, window, scenario.seed)
    corridor, road = found.corridor, scenario.road
    for name, value, expected in (
        ("road.lanes", road.lanes, corridor.lanes),
        ("road.lane_width_m", road.lane_width_m, corridor.lane_width_m),
        ("road.s1_m + s2_m + s3_m", road.length_m, corridor.length_m),
    ):
        if abs(value - expected) > TOLERANCE_M:
            allowed = f"{expected:g}, as the corridor {sumo.corridor} has"
            raise BadInputError(name, value, allowed)
    return found
