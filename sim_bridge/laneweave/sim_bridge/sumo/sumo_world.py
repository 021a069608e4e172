"""The road in SUMO, with bodies that SUMO displays but does not drive.

SUMO displays every vehicle with the position, lateral position, heading and speed of its plant,
even between lanes. The calls in each tick are

    place() every vehicle  ->  step()  ->  positions(), collisions()

`place` passes the middle of the front bumper and the angle to SUMO (moveToXY with keepRoute=2,
which keeps both unchanged). During its step SUMO derives a speed from the displacement; `step`
replaces it with the plant's speed (setPreviousSpeed).
"""

from __future__ import annotations

import math
from pathlib import Path

from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.bodies_world import BodiesWorld
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose, Size, pose_of
from laneweave.sim_bridge.sumo.road_edges import ROAD, margin_m, route_name
from laneweave.sim_bridge.sumo.session import SumoSession

_ROUTE = route_name(MAIN_ENTRANCE, END_OF_ROAD)


class SumoWorld(SumoSession, BodiesWorld):
    """One road with vehicles in SUMO. Close it, or use it as a context manager."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        """Start SUMO with an empty road; see `SumoSession`."""
        super().__init__(scenario, folder)
        BodiesWorld.__init__(self)
        margin = margin_m(scenario)
        self._range_m = (-margin, scenario.road.length_m + margin)
        """Range of positions on SUMO's edge [m]."""
        self._lane_width_m = scenario.road.lane_width_m
        self._lanes = scenario.road.lanes
        self._placed: set[str] = set()
        self._shown: list[str] = []

    def add(self, vehicle: str, state: State, vehicle_type: str = CAR) -> None:
        """Add a vehicle to the road; SUMO displays it from the next step on.

        Raises:
            ValueError: the vehicle is already on the road, or `state` is not on the edge.
        """
        super().add(vehicle, state, vehicle_type)  # raises before the vehicle is added to SUMO
        api = self.vehicle
        self.set_type(vehicle, vehicle_type)
        api.add(vehicle, _ROUTE, typeID=vehicle_type, depart="now", departPos="0", departSpeed="0")
        api.setSpeedMode(vehicle, 0)
        api.setLaneChangeMode(vehicle, 0)
        self._move(vehicle, state)

    def resize(self, vehicle: str, size: Size) -> None:
        """Set length and width [m] of a vehicle.

        Its heading must stay 0: rotated bodies are shown with the lengths of their types.
        """
        self.vehicle.setLength(vehicle, size[0])
        self.vehicle.setWidth(vehicle, size[1])

    def place(self, vehicle: str, state: State) -> None:
        """Set the state of a vehicle at the end of the next step.

        Raises:
            ValueError: the vehicle is not on the road, or `state` is not on the edge.
        """
        super().place(vehicle, state)
        self._move(vehicle, state)

    def step(self) -> None:
        """Advance SUMO by one tick; vehicles without a new state stay in place.

        Raises:
            RuntimeError: SUMO has a different number of vehicles (internal error).
        """
        if len(self._placed) < len(self.states):
            for vehicle, state in self.states.items():
                if vehicle not in self._placed:
                    self._move(vehicle, state)
        self._placed.clear()
        super().step()
        api = self.vehicle
        if api.getIDCount() != len(self.states):
            raise RuntimeError(f"SUMO shows {api.getIDCount()} of {len(self.states)} vehicles")
        set_previous_speed = api.setPreviousSpeed
        for vehicle, state in self.states.items():
            set_previous_speed(vehicle, state[1], state[2])
        self._shown = list(self.states)

    def positions(self) -> dict[str, Pose]:
        """Return the pose of each vehicle after the last step, in the order of `add` calls."""
        return self.poses(self._shown)

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle from the road.

        Raises:
            ValueError: the vehicle is not on the road.
        """
        super().remove(vehicle)
        self._placed.discard(vehicle)
        self._shown = [other for other in self._shown if other != vehicle]
        self.forget(vehicle)

    def _check(self, vehicle: str, state: State) -> None:
        """Reject a state that SUMO would display elsewhere."""
        super()._check(vehicle, state)
        low_m, high_m = self._range_m
        if not low_m <= state[0] <= high_m:
            raise ValueError(
                f"{vehicle} must be at s in [{low_m:g}, {high_m:g}] m, not at {state[0]:g} m"
            )

    def _move(self, vehicle: str, state: State) -> None:
        """Pass the middle of the front bumper, its lane and the angle to SUMO."""
        s_m, front_y_m, heading, _ = pose_of(state)
        degrees = 90.0
        if heading != 0.0:
            front_y_m += self.half_body_m(vehicle) * math.sin(heading)
            degrees -= math.degrees(heading)
        lane = min(max(int(front_y_m // self._lane_width_m), 0), self._lanes - 1)
        self.vehicle.moveToXY(vehicle, ROAD, lane, s_m, front_y_m, degrees, 2)
        self._placed.add(vehicle)
