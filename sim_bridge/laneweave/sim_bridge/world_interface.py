"""Interface of the world that displays and measures bodies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Protocol

from laneweave.protocol.road_layout import TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR, Name
from laneweave.sim_bridge.bodies.overlaps_and_gaps import (
    NO_SIZES,
    ExactNeighbour,
    ExactNeighbours,
    OtherBody,
    Pose,
    Size,
)
from laneweave.sim_bridge.recording.record_interface import Record
from laneweave.sim_bridge.road.passing_vehicles import PassingVehicles
from laneweave.sim_bridge.road.sized_bodies import bodies_of
from laneweave.sim_bridge.road.vehicle import RoadVehicle

EXIT_TOLERANCE_M = 10.0
"""Distance behind an exit up to which a vehicle that has not left yet sees what is behind it."""


class World(Protocol):
    """Display of bodies: `SumoWorld`, or a substitute in tests."""

    def add(self, vehicle: str, state: State, vehicle_type: str = CAR) -> None:
        """Add a vehicle to the road."""

    def resize(self, vehicle: str, size: Size) -> None:
        """Set length and width [m] of a vehicle that has no type."""

    def place(self, vehicle: str, state: State) -> None:
        """Set the state of a vehicle at the end of the next step."""

    def step(self) -> None:
        """Advance by one tick."""

    def positions(self) -> dict[str, Pose]:
        """Return the pose of each vehicle."""

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that the world itself reports as colliding."""

    def others(self) -> Sequence[OtherBody]:
        """Return the bodies of others on the road and behind its exits, the rearmost first."""

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle from the road."""


def show_bodies(
    world: World,
    vehicles: Mapping[Name, RoadVehicle],
    scenario: Scenario,
    record: Record,
    t_s: float,
    closed: Iterable[TemporaryClosure] = (),
    passing: PassingVehicles | None = None,
) -> None:
    """Display all bodies after a tick, record their poses and update all sensors.

    `t_s` is the road time after the tick; `closed` are parts of lanes in which no body may be now,
    `passing` vehicles of other systems.
    """
    states: dict[str, State] = {name: vehicle.state for name, vehicle in vehicles.items()}
    if passing:
        states |= passing.states
    for name, state in states.items():
        world.place(name, state)
    world.step()
    road = scenario.road
    sizes = passing.sizes if passing else NO_SIZES
    arrivals = (one.arrival for one in vehicles.values())
    bodies = bodies_of(world.positions(), arrivals, scenario, sizes)
    accels_mps2: dict[str, float] = {name: state[2] for name, state in states.items()}
    neighbours = bodies.exact_neighbours(road.lanes, road.lane_width_m, accels_mps2)
    touching = []
    exits_m = [(lane, one.at_m) for one in scenario.exit for lane in one.lanes]
    others = world.others()
    if exits_m or others:
        for name, vehicle in vehicles.items():
            ahead, behind = neighbours[name]
            ahead = _before_exits(vehicle, ahead, exits_m)
            in_sight = [*_in_sight(vehicle, others, exits_m)]
            neighbours[name] = _with_others(vehicle, in_sight, (ahead, behind))
            touching += [(name, other) for other in _touched(vehicle, in_sight, scenario)]
    for name, vehicle in vehicles.items():
        vehicle.perceive(neighbours[name])
    record.on_positions(
        t_s,
        vehicles.values(),
        overlaps=[
            *bodies.overlapping_pairs(),
            *bodies.in_closed_lanes(scenario, closed),
            *touching,
        ],
        collisions=world.collisions(),
        gaps=bodies.min_gaps(),
    )


def _before_exits(
    vehicle: RoadVehicle, ahead: Sequence[ExactNeighbour], exits_m: Sequence[tuple[int, float]]
) -> list[ExactNeighbour]:
    """Return the neighbours ahead without those behind an exit, in the lane of a ramp.

    Args:
        vehicle: the vehicle that sees them.
        ahead: its neighbours ahead.
        exits_m: lane and position of each exit.
    """
    s_m = vehicle.state[0]
    return [
        other
        for other in ahead
        if not any(lane == other[0] and s_m <= at_m < s_m + other[1] for lane, at_m in exits_m)
    ]


def _in_sight(
    vehicle: RoadVehicle, others: Sequence[OtherBody], exits_m: Sequence[tuple[int, float]]
) -> Iterator[OtherBody]:
    """Yield the bodies of others in lanes that do not end by an exit before them, or have ended."""
    s_m = vehicle.state[0]
    for other in others:
        if s_m <= other.exit_m + EXIT_TOLERANCE_M and not any(
            lane == other.lane and s_m <= at_m < other.exit_m for lane, at_m in exits_m
        ):
            yield other


def _with_others(
    vehicle: RoadVehicle, others: Sequence[OtherBody], neighbours: ExactNeighbours
) -> ExactNeighbours:
    """Return the nearest neighbours of a vehicle in each lane, bodies of others included."""
    s_m = vehicle.state[0]
    rear_m = s_m - vehicle.size[0]
    ahead, behind = ({one[0]: one for one in side} for side in neighbours)
    for other in others:
        is_ahead = other.front_m > s_m
        gap_m = other.rear_m - s_m if is_ahead else rear_m - other.front_m
        side = ahead if is_ahead else behind
        nearest = side.get(other.lane)
        if nearest is None or gap_m < nearest[1]:
            side[other.lane] = other.lane, gap_m, other.speed_mps, other.accel_mps2
    return [*ahead.values()], [*behind.values()]


def _touched(
    vehicle: RoadVehicle, others: Sequence[OtherBody], scenario: Scenario
) -> Iterator[str]:
    """Yield the names of the bodies of others that a vehicle overlaps."""
    s_m, _, _, y_m, _, _ = vehicle.state
    first, last = scenario.lattice.lanes_touched(y_m, vehicle.size[1])
    for other in others:
        if (
            first <= other.lane <= last
            and other.rear_m < s_m
            and other.front_m > s_m - vehicle.size[0]
        ):
            yield other.name
