"""The reward of a vehicle for one step."""

from __future__ import annotations

from attrs import frozen

from laneweave.env.record import Trip


@frozen
class Rewards:
    """Weights of the reward of a vehicle."""

    arrived: float = 1.0
    """For a vehicle that leaves in its preferred lane, or by its exit."""
    missed: float = -1.0
    """For a vehicle that leaves elsewhere."""
    second: float = -0.001
    """Per second on the road."""
    move: float = -0.01
    """Per move to another cell."""
    discomfort: float = -0.001
    """Per m2/s3: integral of the squared acceleration, along and across the road."""

    def of_step(
        self, seconds: float, *, moved: bool, discomfort: float, left: Trip | None
    ) -> float:
        """Return the reward of a step.

        Args:
            seconds: time of the step that the vehicle has spent on the road.
            moved: whether it has begun a move.
            discomfort: integral of its squared acceleration [m2/s3].
            left: its trip, if it has left the road; else None.
        """
        reward = self.second * seconds + self.discomfort * discomfort
        if moved:
            reward += self.move
        if left is not None:
            reward += self.arrived if left.at_destination else self.missed
        return reward
