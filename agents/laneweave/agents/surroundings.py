"""Surroundings: what those ahead and behind leave a vehicle, as its own sensors see them.

They count in the lanes that the body touches and in the lane that it enters. Each is predicted at
constant speed, as far as that holds. All positions are commanded ones (`protocol.motion`): bodies
of equal lag keep every distance that their commanded states keep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from attrs import frozen
from numpy.typing import NDArray

from laneweave.protocol.messages import Neighbour, Sense
from laneweave.protocol.motion import State
from laneweave.protocol.scenario import Scenario

Array = NDArray[np.float64]

SENSED_S = 1.0
"""How far ahead local sensing is extrapolated; what others plan to do is not known here."""


@frozen(eq=False)
class Gaps:
    """Where the front bumper should stay for others' sake now and at the next N ticks [m].

    Commanded positions, each (N + 1,); infinite where there is nobody.
    """

    earliest: Array | None = None
    """Ahead of this, for those behind; None: nobody is behind."""
    latest: Array | None = None
    """Behind this, for those ahead; None: nobody is ahead."""

    def check(self, ticks: int) -> None:
        """Check the shapes for a horizon of N ticks.

        Raises:
            ValueError: one is not (N + 1,).
        """
        for name, positions in (("earliest", self.earliest), ("latest", self.latest)):
            if positions is not None and positions.shape != (ticks + 1,):
                raise ValueError(f"{name} has shape {positions.shape}, expected {(ticks + 1,)}")


NOBODY = Gaps()


class Surroundings:
    """Predicts those around one vehicle."""

    def __init__(self, scenario: Scenario) -> None:
        """Take sizes, limits and horizon from a scenario."""
        limits = scenario.vehicle
        self._lane_width_m = scenario.road.lane_width_m
        self._half_width_m = limits.width_m / 2.0
        self._length_m = limits.length_m
        self._lag_s = limits.actuator_lag_s
        self._speed_mps = scenario.formation.speed_mps
        self._least_m = scenario.tracking.min_gap_m
        # What this vehicle can gain or lose in the time of prediction, beside its speed.
        self._gain_m = limits.max_accel_mps2 * SENSED_S**2 / 2.0
        self._loss_m = -limits.min_accel_mps2 * SENSED_S**2 / 2.0
        self._times_s = np.arange(scenario.tracking.horizon_ticks + 1) * scenario.runtime.tick_s
        self._beyond = self._times_s > SENSED_S + 1e-9

    def gaps(self, sense: Sense, state: State, lane: int) -> Gaps:
        """Return what the others leave; those that cannot come into question are left out.

        Args:
            sense: what the sensors see.
            state: commanded state of this vehicle.
            lane: the lane that it is in or enters.
        """
        y_m = sense.state[3]
        first = int((y_m - self._half_width_m) // self._lane_width_m)
        last = int((y_m + self._half_width_m) // self._lane_width_m)

        def in_the_way(others: Iterable[Neighbour]) -> Iterable[Neighbour]:
            return (each for each in others if first <= each.lane <= last or each.lane == lane)

        s_m, speed_mps = state[0], state[1]
        latest, earliest = [], []
        for other in in_the_way(sense.ahead):
            lag_m, other_mps = self._commanded(other)
            front_m = sense.state[0] + other.gap_m + lag_m - self._least_m
            # Greatest now or at the end of prediction, since it cannot but bend upwards.
            if s_m + max((speed_mps - other_mps) * SENSED_S + self._gain_m, 0.0) > front_m:
                latest.append((front_m, other_mps))
        for other in in_the_way(sense.behind):
            lag_m, other_mps = self._commanded(other)
            front_m = sense.state[0] - other.gap_m + lag_m + self._least_m
            if s_m + min((speed_mps - other_mps) * SENSED_S - self._loss_m, 0.0) < front_m:
                earliest.append((front_m, other_mps))
        if not (latest or earliest):
            return NOBODY
        return Gaps(
            self._predicted(earliest, np.maximum, -np.inf),
            self._predicted(latest, np.minimum, np.inf),
        )

    def _commanded(self, other: Neighbour) -> tuple[float, float]:
        """Return how far another one's commanded position is from its position, and its speed."""
        lag_s = self._lag_s
        return (
            lag_s * (other.speed_mps - self._speed_mps),
            max(other.speed_mps + lag_s * other.accel_mps2, 0.0),
        )

    def _predicted(
        self,
        fronts: list[tuple[float, float]],
        nearest: Callable[[Any, Any], Any],
        nobody: float,
    ) -> Array | None:
        if not fronts:
            return None
        positions = np.full(self._times_s.shape, nobody)
        for front_m, speed_mps in fronts:
            positions = nearest(positions, front_m + speed_mps * self._times_s)
        positions[self._beyond] = nobody
        return positions
