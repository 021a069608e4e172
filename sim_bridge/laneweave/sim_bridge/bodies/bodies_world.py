"""A world without a display: bodies are exactly where the bridge places them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody, Pose, Size, pose_of


class BodiesWorld:
    """Bodies of vehicles without SUMO; implements `World`, and is the base of worlds with SUMO.

    A process may have any number of such worlds, but only one with SUMO.
    """

    def __init__(self) -> None:
        """Begin with an empty road."""
        self.states: dict[str, State] = {}
        """State of each vehicle on the road, in the order of `add` calls."""

    def add(self, vehicle: str, state: State, vehicle_type: str = CAR) -> None:
        """Add a vehicle to the road; its type does not matter here.

        Raises:
            ValueError: the vehicle is already on the road, or its state is not finite.
        """
        del vehicle_type
        if vehicle in self.states:
            raise ValueError(f"{vehicle} is already on the road")
        self._check(vehicle, state)
        self.states[vehicle] = state

    def resize(self, vehicle: str, size: Size) -> None:
        """Do nothing: this world does not use sizes."""

    def place(self, vehicle: str, state: State) -> None:
        """Set the state of a vehicle at the end of the next step.

        Raises:
            ValueError: the vehicle is not on the road, or its state is not finite.
        """
        if vehicle not in self.states:
            raise ValueError(f"{vehicle} is not on the road")
        self._check(vehicle, state)
        self.states[vehicle] = state

    def step(self) -> None:
        """Do nothing: only the bridge moves bodies."""

    def positions(self) -> dict[str, Pose]:
        """Return the pose of each vehicle, in the order of `add` calls."""
        return {vehicle: pose_of(state) for vehicle, state in self.states.items()}

    def collisions(self) -> list[tuple[str, str]]:
        """Return no pairs: `overlaps_and_gaps` finds overlaps."""
        return []

    def others(self) -> Sequence[OtherBody]:
        """Return no bodies: the bridge drives all."""
        return ()

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle from the road.

        Raises:
            ValueError: the vehicle is not on the road.
        """
        if self.states.pop(vehicle, None) is None:
            raise ValueError(f"{vehicle} is not on the road")

    def _check(self, vehicle: str, state: State) -> None:
        """Reject a state that cannot be displayed."""
        if not math.isfinite(sum(state)):
            raise ValueError(f"{vehicle} must have a finite state, not {state}")
