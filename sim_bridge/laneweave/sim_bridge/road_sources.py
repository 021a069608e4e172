"""Where the vehicles of a run come from: drawn arrivals, or a SUMO simulation of the user."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from attrs import field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.corridors.corridor_setup import CorridorSetup, setup_of
from laneweave.sim_bridge.corridors.corridor_world import CorridorWorld
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import TimeWindow
from laneweave.sim_bridge.corridors.take_over import TakeOver
from laneweave.sim_bridge.road.demand import Arrival, arrivals
from laneweave.sim_bridge.road.demand_queue import NO_OUTSIDE_TRAFFIC, OutsideTraffic
from laneweave.sim_bridge.sumo.sumo_world import SumoWorld
from laneweave.sim_bridge.world_interface import World

TOLERANCE_M = 0.05
"""Maximum difference between the road of a scenario and that of its corridor."""


@frozen
class RunDemand:
    """All vehicles that may arrive in a run."""

    scenario: Scenario
    arrivals: tuple[Arrival, ...]
    """By time; those from SUMO with the times of their departures."""
    corridor: CorridorSetup | None = None
    """The vehicles from SUMO, and their corridor; None: the vehicles have been drawn."""

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Names of the vehicles."""
        return tuple(arrival.vehicle for arrival in self.arrivals)


def demand_of(scenario: Scenario) -> RunDemand:
    """Draw the vehicles of a run from the scenario's seed, or read those of a SUMO simulation.

    Once in each process that needs them, which passes them on: the launcher of a run needs their
    names, for faults, certificates and agents; the bridge needs their arrivals. If the bridge is
    a process of its own, it gets the scenario with its seed only, from which the same follow.

    Raises:
        BadInputError: the SUMO simulation cannot be read, or has another road.
    """
    if not scenario.sumo.config:
        return RunDemand(scenario, arrivals(scenario))
    setup = corridor_setup(scenario)
    return RunDemand(scenario, tuple(one.arrival for one in setup.arrivals), setup)


@frozen
class RoadSource:
    """A world, and the vehicles that come to it."""

    world: World
    stream: tuple[Arrival, ...]
    """Arrivals at the entrances, by time."""
    outside_traffic: OutsideTraffic = NO_OUTSIDE_TRAFFIC
    left_out: Mapping[str, int] = field(factory=dict)
    """Number of vehicles with routes through a corridor that it cannot serve, by reason."""


@contextmanager
def open_road(demand: RunDemand, results: Path) -> Iterator[RoadSource]:
    """Open the world to which vehicles come; `results` is the run's folder, for SUMO's statistics.

    Raises:
        CommandFailedError: libsumo cannot be loaded, or SUMO rejects a file.
    """
    scenario, setup = demand.scenario, demand.corridor
    with temporary_folder("sumo") as folder:
        if setup is None:
            with SumoWorld(scenario, folder) as world:
                if scenario.sumo.gui:
                    world.show(scenario.runtime.tick_s)
                yield RoadSource(world, demand.arrivals)
            return
        with CorridorWorld(setup, folder, results) as corridor:
            if scenario.sumo.gui:
                corridor.show(scenario.runtime.tick_s)
            stream = tuple(one.arrival for one in setup.arrivals if one.origin.departs_at_start)
            taken_over = TakeOver(scenario, corridor)
            yield RoadSource(corridor, stream, taken_over, setup.found.missing)
            corridor.drive_on()


def corridor_setup(scenario: Scenario) -> CorridorSetup:
    """Return the corridor of a scenario, whose road must be that of the corridor.

    Raises:
        BadInputError: the simulation cannot be read, has another road, or needs entrances, exits or
            types of vehicles that the scenario lacks.
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
    return setup_of(found, scenario)
