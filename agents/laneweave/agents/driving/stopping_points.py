"""Stopping points: where vehicles would stand if all braked as hard as they can from now on.

The emergency brake acts when a vehicle's stopping point passes that of the vehicle ahead
(`protocol.vehicle.emergency_brake`). The tracker's reference yields so that the predicted stopping
points stay `_EARLY_M` behind: a vehicle brakes early and little instead of late and hard, and a
disturbance becomes smaller from vehicle to vehicle. The acceleration of a vehicle ahead is assumed
to fade within about `SENSED_S`.

All positions of the vehicle itself are commanded ones (`protocol.vehicle.motion`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.emergency_brake import (
    last_tick_m,
    lead_lag_s,
    lead_path_m,
    own_braking_mps2,
)
from laneweave.protocol.vehicle.motion import SETTLED_MPS, State
from laneweave.protocol.wire.messages import Neighbour

Array = NDArray[np.float64]
Number = TypeVar("Number", float, Array)

SENSED_S = 1.0
"""Time for which sensed neighbours are predicted."""
_EARLY_M = 1.0
"""Distance that predicted stopping points keep from where the emergency brake acts."""
_SLOWER_MPS = 2.0
"""Loss of speed of a vehicle ahead from which the whole distance is kept; less is kept for smaller
losses, because plans leave less room behind vehicles that hold their cells."""
_REACT_S = 0.3
"""Time allowed to restore that distance."""
_NEAR_M = 2.0
"""Distance to its bound from which a vehicle ahead is ignored."""
_MIN_FREE_M = 1e-3
"""Shortest distance in which a vehicle is asked to stop."""
_KEPT_LATER = math.exp(-1.0)
"""Share of its acceleration that a vehicle ahead keeps after `SENSED_S`."""


class StoppingPoints:
    """Stopping points of one vehicle, and their bounds."""

    def __init__(self, scenario: Scenario, limits: Vehicle) -> None:
        """Take the limits of the vehicle, and assumptions about vehicles ahead."""
        assumed, tick_s = scenario.braking, scenario.runtime.tick_s
        self._brake_mps2 = own_braking_mps2(limits, assumed)
        self._lead_brake_mps2 = assumed.lead_brake_mps2
        self._lead_lag_s = lead_lag_s(limits, assumed)
        self._reaction_s = assumed.reaction_s
        # A standing body is ahead of its commanded state.
        lag_m = limits.actuator_lag_s * scenario.lattice.speed_mps
        self._apart_m = assumed.margin_m + last_tick_m(self._brake_mps2, tick_s) + lag_m
        self._lattice_mps = scenario.lattice.speed_mps
        self._size = scenario.timing.horizon_ticks + 1
        self._known = min(round(SENSED_S / tick_s) + 1, self._size)
        """Number of ticks for which others are predicted."""
        self._times_s = tick_s * np.arange(self._known)
        self._kept = np.exp(-self._times_s / SENSED_S)
        """Share of its acceleration that a vehicle ahead keeps."""
        self._first = min(max(round(_REACT_S / tick_s), 1), self._known - 1)

    def distances_m(self, states: Array) -> Array:
        """Return the distances (n,) from states (n, 6) to the stopping points."""
        v, a, reaction_s = states[:, 1], states[:, 2], self._reaction_s
        braking = np.maximum(v + a * reaction_s, 0.0)
        distances: Array = (v + a * (0.5 * reaction_s)) * reaction_s
        distances += braking * braking / (2.0 * self._brake_mps2)
        return distances

    def bounds(self, commanded: State, s_m: float, ahead: Iterable[Neighbour]) -> Array | None:
        """Return the upper bounds (N + 1,) of the stopping points; +inf where there is none.

        Args:
            commanded: commanded state of the vehicle.
            s_m: measured position of its front bumper.
            ahead: vehicles ahead in the lanes that the vehicle is in or enters.

        Returns:
            None if no bound matters while the vehicle does not accelerate more than now.
        """
        positions: Array | None = None
        for other in ahead:
            if self._is_far(commanded, s_m, other):
                continue
            own = self._bounds_behind(s_m, other)
            positions = own if positions is None else np.minimum(positions, own)
        if positions is None:
            return None
        bounds = np.full(self._size, np.inf)
        bounds[: self._known] = positions
        return bounds

    def needed_decel_mps2(self, commanded: State, bounds: Array) -> float:
        """Return the gentlest constant deceleration that keeps the bounds.

        A vehicle that brakes with d from speed v has the speed w = v - d t at time t, and stops
        at s + (v + w) t / 2 + w^2 / (2 b), with the reaction time included in t. If it stands
        before, it has stopped at s + v^2 / (2 d). Negative: it may accelerate.

        Args:
            commanded: commanded state of the vehicle.
            bounds: upper bounds (N + 1,) of the stopping points.
        """
        s, v, brake = commanded[0], max(commanded[1], 0.0), self._brake_mps2
        first, known = self._first, self._known
        t = self._times_s[first:] + self._reaction_s
        half = 0.5 * t
        free_m = bounds[first:known] - s
        room = half * half + (2.0 / brake) * (free_m - v * half)
        w = brake * (np.sqrt(np.maximum(room, 0.0)) - half)
        standing = v * v / (2.0 * np.maximum(free_m, _MIN_FREE_M))
        return float(np.where(w >= 0.0, (v - w) / t, standing).max())

    def _is_far(self, commanded: State, s_m: float, other: Neighbour) -> bool:
        """Return whether a vehicle ahead sets no bound that matters, now and after `SENSED_S`."""
        later = _predicted(other, SENSED_S, _KEPT_LATER)
        if min(other.speed_mps, later[1]) > self._lattice_mps - SETTLED_MPS:
            return True  # plans leave room behind vehicles that hold their cells
        s, v, a, _, _, _ = commanded
        for after_s, (moved_m, speed_mps, accel_mps2) in (
            (0.0, (0.0, other.speed_mps, other.accel_mps2)),
            (SENSED_S, later),
        ):
            t_s = after_s + self._reaction_s
            own_mps = v + max(a, 0.0) * t_s
            own_m = s + own_mps * t_s + own_mps * own_mps / (2.0 * self._brake_mps2)
            path_m = lead_path_m(speed_mps, accel_mps2, self._lead_brake_mps2, self._lead_lag_s)
            stop_m = s_m + other.gap_m + max(moved_m, 0.0) + path_m
            if own_m > stop_m - self._apart_m - _NEAR_M:
                return False
        return True

    def _bounds_behind(self, s_m: float, other: Neighbour) -> Array:
        """Return the bounds (K,) set by one vehicle ahead, at the K ticks that are predicted."""
        brake, lag_s = self._lead_brake_mps2, self._lead_lag_s
        moved, speeds, accels = _predicted(other, self._times_s, self._kept)
        positions = np.maximum.accumulate(moved)
        speeds = np.maximum(speeds, 0.0)
        # As `lead_path_m`, for all ticks at once.
        change = np.clip(accels, -brake, 0.0) + brake
        braking = speeds + lag_s * change
        paths = braking * braking / (2.0 * brake) - lag_s * lag_s * change
        positions += np.maximum(paths, speeds * speeds / (2.0 * brake))
        slower = (self._lattice_mps - float(speeds[-1])) / _SLOWER_MPS
        early_m = _EARLY_M * min(max(slower, 0.0), 1.0)
        positions += s_m + other.gap_m - self._apart_m - early_m
        return positions


def _predicted(other: Neighbour, t_s: Number, kept: Number) -> tuple[Number, Number, Number]:
    """Return distance, speed and acceleration of a vehicle ahead after a time, without standing.

    Args:
        other: the vehicle as it is sensed now.
        t_s: time, or times (n,).
        kept: share of its acceleration that it keeps then.
    """
    gained = other.accel_mps2 * SENSED_S * (1.0 - kept)
    moved = (other.speed_mps + other.accel_mps2 * SENSED_S) * t_s - gained * SENSED_S
    return moved, other.speed_mps + gained, other.accel_mps2 * kept
