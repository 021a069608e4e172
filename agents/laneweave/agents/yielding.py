"""Yielding: the reference a vehicle follows when another one stands in the way of its own.

The tracker's gap rows alone would do, but badly: a reference that runs away through the vehicle
ahead pulls against them with a force that grows with the distance, and the program takes ten
times as long. So where the reference violates a gap it is replaced by the gentlest constant
deceleration, from the vehicle's own state, that stays behind:

    s(t) = s + v t - d t^2 / 2,    d = max over t of 2 (s + v t - latest(t)) / t^2

It ends at standstill, never goes backwards, and is left as soon as the reference is behind it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laneweave.protocol.motion import State
from laneweave.protocol.scenario import Vehicle

Array = NDArray[np.float64]

_BUFFER_M = 0.3
"""The path stays this much further behind than it must, so that the gap rows rest."""
_REACT_S = 1.0
"""A gap that is violated now is to be open again after this time, not earlier."""
_BRAKE_SHARE = 0.9
_ACCEL_SHARE = 0.6
"""Shares of the vehicle's limits that a yielding path may use."""


def yield_behind(
    state: State, states: Array, jerks: Array, latest_m: Array, times_s: Array, limits: Vehicle
) -> None:
    """Replace the part of a reference that is beyond the yielding path, in place.

    The result need not obey the dynamics where the path ends or takes over.

    Args:
        state: (s, v, a, y, v_y, a_y) of the vehicle now.
        states: the reference (N + 1, 6); s, v and a change.
        jerks: its jerks (N, 2); j_s changes.
        latest_m: the furthest that the front bumper may be, (N + 1,); +inf for no limit.
        times_s: 0, h, .. N h, (N + 1,).
        limits: the vehicle's limits.
    """
    s, v = state[0], max(state[1], 0.0)
    late = times_s >= _REACT_S
    t = times_s[late]
    needed = 2.0 * (s + v * t - latest_m[late] + _BUFFER_M) / (t * t)
    decel = float(needed.max()) if needed.size else -np.inf
    decel = min(decel, -_BRAKE_SHARE * limits.min_accel_mps2)
    decel = max(decel, -_ACCEL_SHARE * limits.max_accel_mps2)
    moving = np.minimum(times_s, v / decel) if decel > 0.0 else times_s
    path = s + v * moving - decel / 2.0 * moving * moving
    beyond = states[:, 0] > path
    states[beyond, 0] = path[beyond]
    states[beyond, 1] = np.minimum(v - decel * moving, limits.max_speed_mps)[beyond]
    states[beyond, 2] = np.where(moving < times_s, 0.0, -decel)[beyond]
    jerks[beyond[:-1], 0] = 0.0
