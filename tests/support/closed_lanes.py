"""Roads whose lanes end, and vehicles on them without a network."""

from __future__ import annotations

from attrs import define, evolve, field

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.road_layout import Exits
from laneweave.protocol.runtime.node import Send
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Closure, DestinationShare, Road
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, Pose, pose_of
from laneweave.sim_bridge.road.demand import arrivals
from laneweave.sim_bridge.road.obstacles import Breakdown
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.convoy import ROLLING


def road_with(*closures: Closure, s3_m: float = 850.0) -> Scenario:
    """Return the rolling operation on three lanes; lanes may be changed from 100 m on."""
    road = Road(s1_m=50.0, s2_m=100.0, s3_m=s3_m, closures=closures)
    return evolve(ROLLING, road=road)


DROP_M = 800.0
DROP = road_with(Closure(0, DROP_M))
"""Lane 0 of three ends at 800 of 1000 m."""
BLOCKED = road_with(Closure(1, 600.0, 700.0))
"""Lane 1 of three is closed from 600 to 700 m."""


def ramp_road(
    *, ends_m: float = 500.0, exit_name: str = "", share: float = 0.2, **more: dict[str, object]
) -> Scenario:
    """Return four lanes: lane 0 is a ramp from 50 to 200 m, and ends, by an exit if it has a name.

    `share`: share of the other vehicles that leave by the exit.
    """
    data: dict[str, object] = {
        "road": {
            "lanes": 4,
            "s1_m": 50.0,
            "s2_m": 100.0,
            "s3_m": 850.0,
            "closures": [{"lane": 0, "to_m": 50.0}, {"lane": 0, "from_m": ends_m}],
        },
        "entrance": [
            {"name": "on", "lane": 0, "at_m": 50.0, "merge_m": 200.0, "volume_veh_per_h": 600.0}
        ],
        "demand": {"volume_veh_per_lane_h": 900.0, "duration_s": 60.0},
        "formation": {"operation": "rolling"},
    }
    if exit_name:
        data["exit"] = [{"name": exit_name, "lanes": [0], "at_m": ends_m}]
    scenario = parse_scenario(data)
    if exit_name:
        destinations = (DestinationShare(exit_name, share),)
        demand = evolve(scenario.demand, destinations=destinations)
        scenario = evolve(scenario, demand=demand)
    for table, fields in more.items():
        scenario = evolve(scenario, **{table: evolve(getattr(scenario, table), **fields)})
    return scenario


@define
class LonelyRoad:
    """Vehicles at the real roadside that no agent drives: they hold, and nothing else happens."""

    scenario: Scenario
    breakdowns: tuple[Breakdown, ...] = ()
    roadside: Roadside = field(init=False)
    vehicles: dict[Name, RoadVehicle] = field(factory=dict)
    tick: int = 0
    left: list[tuple[Name, float]] = field(factory=list)
    """Vehicles that have left the road, and when."""
    exits: dict[Name, str] = field(factory=dict)
    """Exits by which vehicles have left."""
    overlaps: list[tuple[float, str, str]] = field(factory=list)
    events: list[tuple[float, str, Name]] = field(factory=list)
    """Changes at the ends of lanes."""

    def __attrs_post_init__(self) -> None:
        """Open the entrance, with the scenario's arrivals."""
        self.roadside = Roadside(
            self.scenario, arrivals(self.scenario), bridge=1, breakdowns=self.breakdowns
        )

    @property
    def t_s(self) -> float:
        return self.tick * self.scenario.runtime.tick_s

    def step(self) -> None:
        """Drive one tick."""
        scenario, t_s = self.scenario, self.t_s
        self.roadside.demand.newly_demanded(t_s)
        for admission in self.roadside.admit(t_s, self.vehicles):
            vehicle = RoadVehicle.entering(admission, t_s, scenario, 1)
            vehicle.close(self.roadside.lane_ends, self.t_s)
            self.vehicles[vehicle.name] = vehicle
        for change in self.roadside.control_lane_ends(self.vehicles, t_s):
            self.events.append((t_s, change.kind, change.vehicle))
        published = self.roadside.publish(self.tick, t_s, self.vehicles.values())
        for effect in published:
            # Receivers must be able to read it.
            assert not isinstance(effect, Send) or decode(encode(effect.message)) == effect.message
        self.roadside.assign_empty_cells(self.vehicles)
        for vehicle in self.vehicles.values():
            vehicle.step(self.tick)
        self.roadside.obstacles.step(self.vehicles.values(), t_s)
        self.tick += 1
        exits = Exits(scenario.geometry.sections, scenario.road.length_m)
        for name, vehicle in list(self.vehicles.items()):
            section = exits.left_by(vehicle.body_lane, vehicle.state[0])
            if section is not None:
                self.left.append((name, self.t_s))
                self.exits[name] = section.exit
                del self.vehicles[name]
                self.roadside.on_left(vehicle, self.vehicles, self.t_s)
        self.sense()

    def sense(self) -> None:
        """Let all vehicles sense their neighbours, and record overlaps."""
        road, size = self.scenario.road, self.scenario.vehicle
        states: dict[str, State] = {name: vehicle.state for name, vehicle in self.vehicles.items()}
        passing = self.roadside.obstacles.passing
        states |= passing.states
        poses: dict[str, Pose] = {name: pose_of(state) for name, state in states.items()}
        bodies = Bodies(poses, size.length_m, size.width_m, passing.sizes)
        accels: dict[str, float] = {name: state[2] for name, state in states.items()}
        neighbours = bodies.exact_neighbours(road.lanes, road.lane_width_m, accels)
        for name, vehicle in self.vehicles.items():
            vehicle.perceive(neighbours[name])
        closed = self.roadside.obstacles.without_vehicles(self.t_s)
        pairs = [*bodies.overlapping_pairs(), *bodies.in_closed_lanes(self.scenario, closed)]
        self.overlaps += [(self.t_s, *pair) for pair in pairs]
