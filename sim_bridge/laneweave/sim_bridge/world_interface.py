"""Interface of the world that displays and measures bodies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR, Name
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.sized_bodies import bodies_of
from laneweave.sim_bridge.road.vehicle import RoadVehicle


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

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle from the road."""


def show_bodies(
    world: World,
    vehicles: Mapping[Name, RoadVehicle],
    scenario: Scenario,
    record: RunRecord,
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
    for name, vehicle in vehicles.items():
        vehicle.perceive(neighbours[name])
    record.on_positions(
        t_s,
        vehicles.values(),
        overlaps=[*bodies.overlapping_pairs(), *bodies.in_closed_lanes(scenario)],
        collisions=world.collisions(),
        gaps=bodies.min_gaps(),
    )
