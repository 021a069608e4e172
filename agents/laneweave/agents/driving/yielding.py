"""Yielding: the reference a vehicle follows when another one stands in the way of its own.

The tracker's gap rows alone would do, but badly: a reference that runs away through the vehicle
ahead pulls against them with a force that grows with the distance, and the program takes ten
times as long. So where the reference violates a gap it is replaced by the gentlest constant
deceleration, from the vehicle's own state, that stays behind:

    d = max over t of 2 (s + v t - latest(t)) / t^2

The path reaches d with limited jerk, ends at standstill, never goes backwards, and is left as
soon as the reference is behind it. What the jerk limit costs, the next tick's d makes good.
Across the road the vehicle follows the reference as well as it can while it slows down: it must
not slide sideways.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from laneweave.protocol.scenario.tables import Vehicle
from laneweave.protocol.vehicle.motion import State, integrate, limited_jerk

Array = NDArray[np.float64]

_BUFFER_M = 0.5
"""The path stays this much further behind than it must, so that the gap rows rest."""
_REACT_S = 1.0
"""A gap that is violated now is to be open again after this time, not earlier."""
_BRAKE_SHARE = 0.9
_ACCEL_SHARE = 0.6
"""Shares of the vehicle's limits that a yielding path may use."""

_LATERAL_GAINS = (1.3, 3.6, 3.0)
"""Jerk per error of (y, v_y, a_y) [1/s3, 1/s2, 1/s]: poles near -0.6 and -1.2 +- 0.8i 1/s."""


def yield_behind(
    state: State, states: Array, jerks: Array, latest_m: Array, tick_s: float, limits: Vehicle
) -> None:
    """Replace the part of a reference that is beyond the yielding path, in place.

    Along the road the result need not obey the dynamics where the path ends or takes over.

    Args:
        state: (s, v, a, y, v_y, a_y) of the vehicle now.
        states: the reference (N + 1, 6).
        jerks: its jerks (N, 2).
        latest_m: the furthest that the front bumper may be, (N + 1,); +inf for no limit.
        tick_s: length of the tick [s].
        limits: the vehicle's limits.
    """
    s, v = state[0], max(state[1], 0.0)
    first = min(round(_REACT_S / tick_s), len(jerks))
    t = tick_s * np.arange(first, len(states))
    needed = 2.0 * (s + v * t - latest_m[first:] + _BUFFER_M) / (t * t)
    decel = float(needed.max())
    decel = min(decel, -_BRAKE_SHARE * limits.min_accel_mps2)
    decel = max(decel, -_ACCEL_SHARE * limits.max_accel_mps2)
    now, path, inputs = state, [state], []
    p_y, p_v, p_a = _LATERAL_GAINS
    for (_, _, _, y, v_y, a_y), (_, j_y) in zip(states[:-1].tolist(), jerks.tolist(), strict=True):
        back = p_y * (y - now[3]) + p_v * (v_y - now[4]) + p_a * (a_y - now[5])
        jerk = limited_jerk(now, ((-decel - now[2]) / tick_s, j_y + back), limits, tick_s)
        now = integrate(now, jerk, tick_s)
        path.append(now)
        inputs.append(jerk)
    yielding, driving = np.array(path), np.array(inputs)
    beyond = states[:, 0] >= yielding[:, 0]
    states[beyond, :3] = yielding[beyond, :3]
    states[:, 3:] = yielding[:, 3:]
    jerks[beyond[1:], 0] = driving[beyond[1:], 0]
    jerks[:, 1] = driving[:, 1]
