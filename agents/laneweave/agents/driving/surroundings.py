"""Surroundings: what those ahead and behind leave a vehicle, as its own sensors see them.

They count in the lanes that the body touches and in the lane that it enters. Each is predicted at
constant speed, as far as that holds; and where one is at the place of a motion that was heard of
(`motions`), along its trajectory from where it is sensed, too. At each tick the nearer one of both
counts: what is said can only add to what is seen. All positions are commanded ones
(`protocol.motion`): bodies of equal lag keep every distance that their commanded states keep.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from attrs import frozen
from numpy.typing import NDArray

from laneweave.agents.driving.motions import Motions
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Motion, Neighbour, Sense

Array = NDArray[np.float64]

SENSED_S = 1.0
"""How far ahead local sensing is extrapolated: speeds change."""


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
        shape = (ticks + 1,)
        for name, positions in (("earliest", self.earliest), ("latest", self.latest)):
            if positions is not None and positions.shape != shape:
                raise ValueError(f"{name} has shape {positions.shape}, expected {shape}")


NOBODY = Gaps()


_Seen = tuple[int, float, float]
"""Of somebody who is sensed: lane, where the front bumper should be for its sake, its speed."""


@frozen
class _Side:
    """Ahead or behind."""

    sign: float
    nearest: Callable[[Any, Any], Any]
    nobody: float


_AHEAD = _Side(1.0, np.minimum, np.inf)
_BEHIND = _Side(-1.0, np.maximum, -np.inf)


class Surroundings:
    """Predicts those around one vehicle."""

    def __init__(self, scenario: Scenario) -> None:
        """Take sizes, limits and horizon from a scenario."""
        limits = scenario.vehicle
        self._motions = Motions(scenario)
        self._lattice = scenario.lattice
        self._width_m = limits.width_m
        self._length_m = limits.length_m
        self._lag_s = limits.actuator_lag_s
        self._speed_mps = scenario.formation.speed_mps
        self._least_m = scenario.tracking.min_gap_m
        # What this vehicle can gain or lose in the time of prediction, beside its speed.
        self._gain_m = limits.max_accel_mps2 * SENSED_S**2 / 2.0
        self._loss_m = -limits.min_accel_mps2 * SENSED_S**2 / 2.0
        self._times_s = np.arange(scenario.horizon_ticks + 1) * scenario.runtime.tick_s
        self._beyond = self._times_s > SENSED_S + 1e-9

    def hear(self, motion: Motion) -> None:
        """Take what another vehicle says of its motion."""
        self._motions.hear(motion)

    def gaps(self, sense: Sense, state: State, lane: int) -> Gaps:
        """Return what the others leave; those that cannot come into question are left out.

        Args:
            sense: what the sensors see.
            state: commanded state of this vehicle.
            lane: the lane that it is in or enters.
        """
        first, last = self._lattice.lanes_touched(sense.state[3], self._width_m)
        touched = first, last, lane
        latest = earliest = None
        ahead, near = self._look(sense, state, sense.ahead, touched, 1.0, self._gain_m)
        if near:
            latest = self._sensed(near, _AHEAD)
        behind, near = self._look(sense, state, sense.behind, touched, -1.0, -self._loss_m)
        if near:
            earliest = self._sensed(near, _BEHIND)
        if self._motions.heard:
            self._motions.advance(sense.tick)
            lanes = min(first, lane), max(last, lane)
            if ahead:
                latest = self._said(latest, ahead, _AHEAD, lanes)
            if behind:
                earliest = self._said(earliest, behind, _BEHIND, lanes)
        return NOBODY if latest is None and earliest is None else Gaps(earliest, latest)

    def _look(
        self,
        sense: Sense,
        state: State,
        others: tuple[Neighbour, ...],
        touched: tuple[int, int, int],
        sign: float,
        change_m: float,
    ) -> tuple[list[_Seen], list[_Seen]]:
        """Return who counts, if any motion is known, and who comes into question as sensed.

        It runs twice at each tick of each vehicle, and mostly nobody is near.

        Args:
            sense: what the sensors see.
            state: commanded state of this vehicle.
            others: those on one side.
            touched: the first and the last lane that the body touches; the lane that it enters.
            sign: 1 for those ahead, -1 for those behind.
            change_m: how far the vehicle can get towards them in the time of prediction, beside
                its speed; negative behind.
        """
        first, last, lane = touched
        heard, lag_s = self._motions.heard, self._lag_s
        counting: list[_Seen] = []
        near: list[_Seen] = []
        for other in others:
            if first <= other.lane <= last or other.lane == lane:
                # How far its commanded position is from its position.
                lag_m = lag_s * (other.speed_mps - self._speed_mps)
                front_m = sense.state[0] + sign * (other.gap_m - self._least_m) + lag_m
                other_mps = max(other.speed_mps + lag_s * other.accel_mps2, 0.0)
                if heard:
                    counting.append((other.lane, front_m, other_mps))
                # Greatest now or at the end of prediction, since it cannot but bend upwards.
                closer_m = (state[1] - other_mps) * SENSED_S + change_m
                if sign * closer_m < 0.0:
                    closer_m = 0.0
                if sign * (state[0] + closer_m) > sign * front_m:
                    near.append((other.lane, front_m, other_mps))
        return counting, near

    def _sensed(self, others: list[_Seen], side: _Side) -> Array:
        """Return the nearest positions at constant speeds."""
        positions = np.full(self._times_s.shape, side.nobody)
        for _, front_m, speed_mps in others:
            positions = side.nearest(positions, front_m + speed_mps * self._times_s)
        positions[self._beyond] = side.nobody
        return positions

    def _said(
        self,
        positions: Array | None,
        others: list[_Seen],
        side: _Side,
        lanes: tuple[int, int],
    ) -> Array | None:
        """Return positions, or nearer ones of those whose motions are known.

        Args:
            positions: as sensed.
            others: who is sensed.
            side: where they are.
            lanes: the first and the last one that count.
        """
        apart_m = side.sign * (self._length_m + self._least_m)
        for lane, front_m, speed_mps in others:
            fronts = self._motions.fronts(lane, front_m + apart_m, speed_mps, lanes, side.nobody)
            if fronts is None:
                continue
            fronts -= apart_m
            positions = fronts if positions is None else side.nearest(positions, fronts)
        return positions
