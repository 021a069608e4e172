"""A world without a display: bodies are exactly where the bridge places them."""

from __future__ import annotations

from collections.abc import Sequence

from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody, Pose, pose_of


class BodiesWorld:
    """Bodies of vehicles without SUMO; implements `World`.

    A process may have any number of such worlds, but only one with SUMO.
    """

    def __init__(self) -> None:
        """Begin with an empty road."""
        self.states: dict[str, State] = {}
        """State of each vehicle on the road, in the order of `add` calls."""

    def add(self, vehicle: str, state: State, vehicle_type: str = CAR) -> None:
        """Add a vehicle to the road; its type does not matter here.

        Raises:
            ValueError: the vehicle is on the road already.
        """
        del vehicle_type
        if vehicle in self.states:
            raise ValueError(f"{vehicle} is on the road already")
        self.states[vehicle] = state

    def place(self, vehicle: str, state: State) -> None:
        """Set the state of a vehicle.

        Raises:
            ValueError: the vehicle is not on the road.
        """
        if vehicle not in self.states:
            raise ValueError(f"{vehicle} is not on the road")
        self.states[vehicle] = state

    def step(self) -> None:
        """Do nothing: only the bridge moves bodies."""

    def positions(self) -> dict[str, Pose]:
        """Return the pose of each vehicle."""
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
