"""Surroundings: free positions between the sensed vehicles ahead and behind.

Neighbours in the lanes that the body touches or enters are relevant. Bounds of positions assume
that they keep their speed for `SENSED_S`. A neighbour that matches an announced motion (`motions`)
is also assumed to follow the motion's trajectory from the sensed position on. At each tick the
nearer prediction counts, so an announcement cannot relax the limits of positions from sensors. A
vehicle ahead that matches none also bounds the stopping points (`stopping_points`).

All positions are commanded ones (`protocol.vehicle.motion`): bodies of equal lag keep the distances
between their commanded states.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from attrs import frozen
from numpy.typing import NDArray

from laneweave.agents.driving.motions import Motions
from laneweave.agents.driving.stopping_points import SENSED_S, StoppingPoints
from laneweave.agents.driving.tracking_problem import NO_GAPS, Gaps
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Motion, Neighbour, Sense

Array = NDArray[np.float64]

SLOW_S = 2.0
"""Time for which slow neighbours ahead are assumed to keep their speed, so that this vehicle need
not brake hard behind them. It is less than the time after which a vehicle that leaves the lane in
time would reach them."""
SLOW_SHARE = 0.5
"""Fraction of v_F below which a neighbour is slow; no vehicle that moves between cells is."""

_Sensed = tuple[int, float, float]
"""(lane, front-bumper limit [m], speed [m/s]) of a sensed neighbour."""


@frozen
class _Side:
    """Direction of neighbours: ahead or behind."""

    sign: float
    nearest: Callable[[Any, Any], Any]
    free: float
    """Limit where there is no neighbour."""


_AHEAD = _Side(1.0, np.minimum, np.inf)
_BEHIND = _Side(-1.0, np.maximum, -np.inf)


class Surroundings:
    """Predicts the gaps around one vehicle."""

    def __init__(self, scenario: Scenario, limits: Vehicle) -> None:
        """Take the limits of the vehicle; read the sizes of others from a scenario."""
        self._motions = Motions(scenario)
        self._stopping_points = StoppingPoints(scenario, limits)
        self._lattice = scenario.lattice
        self._width_m = limits.width_m
        self._length_m = limits.length_m
        self._lengths_m = sorted({one.limits.length_m for one in scenario.types.values()})
        """Lengths of the bodies of all types, since sensors do not report types."""
        self._lag_s = limits.actuator_lag_s
        self._speed_mps = scenario.formation.speed_mps
        self._min_gap_m = scenario.tracking.min_gap_m
        self._slow_mps = SLOW_SHARE * scenario.formation.speed_mps
        # Accelerations with which this vehicle can approach neighbours ahead and behind.
        self._gain_mps2, self._loss_mps2 = limits.max_accel_mps2, limits.min_accel_mps2
        self._times_s = np.arange(scenario.timing.horizon_ticks + 1) * scenario.runtime.tick_s
        self._beyond = self._times_s > SENSED_S + 1e-9
        self._beyond_slow = self._times_s > SLOW_S + 1e-9

    def on_motion(self, motion: Motion) -> None:
        """Handle another vehicle's announced motion."""
        self._motions.add(motion)

    def gaps(self, sense: Sense, commanded: State, lane: int) -> Gaps:
        """Return the gaps between neighbours, ignoring neighbours out of reach.

        Args:
            sense: sensor measurements.
            commanded: commanded state of this vehicle.
            lane: lane that this vehicle is in or enters.
        """
        first, last = self._lattice.lanes_touched(sense.measured[3], self._width_m)
        latest = earliest = stopping = None
        ahead = [o for o in sense.ahead if first <= o.lane <= last or o.lane == lane]
        behind = [o for o in sense.behind if first <= o.lane <= last or o.lane == lane]
        sensed_ahead, near = self._sensed(sense, commanded, ahead, _AHEAD)
        if near:
            latest = self._at_constant_speed(near, _AHEAD)
        sensed_behind, near = self._sensed(sense, commanded, behind, _BEHIND)
        if near:
            earliest = self._at_constant_speed(near, _BEHIND)
        if self._motions.known:
            self._motions.advance(sense.tick)
            lanes = min(first, lane), max(last, lane)
            if ahead:
                latest, found = self._with_motions(latest, sensed_ahead, _AHEAD, lanes)
                # Plans leave room behind vehicles that drive as announced.
                ahead = [other for other, known in zip(ahead, found, strict=True) if not known]
            if behind:
                earliest, _ = self._with_motions(earliest, sensed_behind, _BEHIND, lanes)
        if ahead:
            stopping = self._stopping_points.bounds(commanded, sense.measured[0], ahead)
        if latest is None and earliest is None and stopping is None:
            return NO_GAPS
        return Gaps(earliest, latest, stopping)

    def _sensed(
        self, sense: Sense, commanded: State, others: list[Neighbour], side: _Side
    ) -> tuple[list[_Sensed], list[_Sensed]]:
        """Return the neighbours on a side (if motions are known) and the ones within reach.

        Called twice per tick per vehicle; usually no neighbour is within reach.

        Args:
            sense: sensor measurements.
            commanded: commanded state of this vehicle.
            others: neighbours on this side in the relevant lanes.
            side: the direction.
        """
        accel_mps2 = self._loss_mps2 if side is _BEHIND else self._gain_mps2
        motions_known, lag_s, sign = self._motions.known, self._lag_s, side.sign
        relevant: list[_Sensed] = []
        near: list[_Sensed] = []
        for other in others:
            # Difference between position and commanded position.
            lag_m = lag_s * (other.speed_mps - self._speed_mps)
            front_m = sense.measured[0] + sign * (other.gap_m - self._min_gap_m) + lag_m
            other_mps = max(other.speed_mps + lag_s * other.accel_mps2, 0.0)
            if motions_known:
                relevant.append((other.lane, front_m, other_mps))
            # The maximum is now or at the end of the prediction, by convexity in time.
            lasts_s = SLOW_S if sign > 0.0 and other_mps < self._slow_mps else SENSED_S
            closer_m = (commanded[1] - other_mps + 0.5 * accel_mps2 * lasts_s) * lasts_s
            if sign * closer_m < 0.0:
                closer_m = 0.0
            if sign * (commanded[0] + closer_m) > sign * front_m:
                near.append((other.lane, front_m, other_mps))
        return relevant, near

    def _at_constant_speed(self, others: list[_Sensed], side: _Side) -> Array:
        """Return the nearest limits (N + 1,) set by neighbours at constant speed."""
        positions = np.full(self._times_s.shape, side.free)
        for _, front_m, speed_mps in others:
            limits = front_m + speed_mps * self._times_s
            slow = side is _AHEAD and speed_mps < self._slow_mps
            limits[self._beyond_slow if slow else self._beyond] = side.free
            positions = side.nearest(positions, limits)
        return positions

    def _with_motions(
        self,
        positions: Array | None,
        others: list[_Sensed],
        side: _Side,
        lanes: tuple[int, int],
    ) -> tuple[Array | None, list[bool]]:
        """Return limits that include announced motions, and which neighbours follow one.

        Args:
            positions: limits from the prediction at constant speed; None: there are none.
            others: sensed neighbours.
            side: direction of the neighbours.
            lanes: the first and the last relevant lane.
        """
        lengths_m = self._lengths_m if side is _AHEAD else [self._length_m]
        found = [False] * len(others)
        for index, (lane, front_m, speed_mps) in enumerate(others):
            for length_m in lengths_m:
                apart_m = side.sign * (length_m + self._min_gap_m)
                fronts = self._motions.fronts(lane, front_m + apart_m, speed_mps, lanes, side.free)
                if fronts is None:
                    continue
                found[index] = True
                fronts -= apart_m
                positions = fronts if positions is None else side.nearest(positions, fronts)
        return positions, found
