"""Interface of the world that displays and measures bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR, Name
from laneweave.sim_bridge.bodies.overlaps_and_gaps import ExactNeighbour, OtherBody, Pose
from laneweave.sim_bridge.recording.record_interface import Record
from laneweave.sim_bridge.road.sized_bodies import bodies_of
from laneweave.sim_bridge.road.vehicle import RoadVehicle

EXIT_TOLERANCE_M = 10.0
"""Distance behind an exit up to which a vehicle that has not left yet sees what is behind it."""


class World(Protocol):
    """Display of bodies: `SumoWorld`, or a substitute in tests."""

    def add(self, vehicle: str, state: State, vehicle_type: str = CAR) -> None:
        """Add a vehicle to the road."""

    def place(self, vehicle: str, state: State) -> None:
        """Set the state of a vehicle at the end of the next step."""

    def step(self) -> None:
        """Advance by one tick."""

    def positions(self) -> dict[str, Pose]:
        """Return the pose of each vehicle."""

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that the world itself reports as colliding."""

    def others(self) -> Sequence[OtherBody]:
        """Return the bodies behind the exits, the nearest ones first."""

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle from the road."""


def show_bodies(
    world: World,
    vehicles: Mapping[Name, RoadVehicle],
    scenario: Scenario,
    record: Record,
    t_s: float,
) -> None:
    """Display all bodies after a tick, record their poses and update all sensors.

    `t_s` is the road time after the tick.
    """
    states = {name: vehicle.state for name, vehicle in vehicles.items()}
    for name, state in states.items():
        world.place(name, state)
    world.step()
    road = scenario.road
    bodies = bodies_of(world.positions(), (one.arrival for one in vehicles.values()), scenario)
    accels_mps2: dict[str, float] = {name: state[2] for name, state in states.items()}
    neighbours = bodies.exact_neighbours(road.lanes, road.lane_width_m, accels_mps2)
    touching = []
    exits_m = [(lane, one.at_m) for one in scenario.exit for lane in one.lanes]
    others = world.others()
    if exits_m or others:
        for name, vehicle in vehicles.items():
            ahead, behind = neighbours[name]
            ahead = _before_exits(vehicle, ahead, exits_m)
            seen, touched = _behind_exits(vehicle, others, ahead, scenario)
            neighbours[name] = seen, behind
            touching += [(name, other) for other in touched]
    for name, vehicle in vehicles.items():
        vehicle.perceive(neighbours[name])
    record.on_positions(
        t_s,
        vehicles.values(),
        overlaps=[
            *bodies.overlapping_pairs(),
            *bodies.in_closed_lanes(scenario),
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


def _behind_exits(
    vehicle: RoadVehicle,
    others: Sequence[OtherBody],
    ahead: Sequence[ExactNeighbour],
    scenario: Scenario,
) -> tuple[list[ExactNeighbour], list[str]]:
    """Return what a vehicle sees ahead, and the names of the bodies behind exits that it touches.

    The nearest body behind the exit of a lane is seen if there is none in the lane before.
    """
    s_m, _, _, y_m, _, _ = vehicle.state
    first, last = scenario.lattice.lanes_touched(y_m, vehicle.size[1])
    seen, touched = list(ahead), list[str]()
    for other in others:
        if not s_m <= other.exit_m + EXIT_TOLERANCE_M:
            continue
        gap_m = other.rear_m - s_m
        if first <= other.lane <= last and gap_m < 0.0:
            touched.append(other.name)
        if all(lane != other.lane for lane, _, _, _ in seen):
            seen.append((other.lane, gap_m, other.speed_mps, other.accel_mps2))
    return seen, touched
