"""How a vehicle that enters with another speed than v_F gets into a cell.

In the moving frame the vehicle is ahead of its cell by some distance, and slower: it falls back
while it accelerates. It follows the quintic from its state to rest in the cell (minimum jerk).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from laneweave.protocol.scenario.fields import Vehicle

LIMIT_SHARE = 0.9
"""Share of its limits that a vehicle uses."""
COMFORTABLE_BRAKE_MPS2 = 3.0
MAX_BEHIND_M = 0.5
"""Distance behind its cell at which the vehicle may be; farther behind is the room of others."""
LONGEST_S = 30.0
_STEP_S = 0.5
_X = np.linspace(0.0, 1.0, 41)
_POSITION = np.stack(
    [1.0 - _X**3 * (10.0 - 15.0 * _X + 6.0 * _X**2), _X - _X**3 * (6.0 - 8.0 * _X + 3.0 * _X**2)]
)
_SPEED = np.stack(
    [-30.0 * _X**2 * (1.0 - _X) ** 2, 1.0 - _X**2 * (18.0 - 32.0 * _X + 15.0 * _X**2)]
)
_ACCEL = np.stack(
    [-60.0 * _X * (1.0 - 3.0 * _X + 2.0 * _X**2), -_X * (36.0 - 96.0 * _X + 60.0 * _X**2)]
)
_JERK = np.stack([-60.0 * (1.0 - 6.0 * _X + 6.0 * _X**2), -36.0 + 192.0 * _X - 180.0 * _X**2])


def settling_s(
    ahead_m: float, slower_mps: float, speed_mps: float, limits: Vehicle
) -> float | None:
    """Return the shortest time in which a vehicle settles in a cell within its limits.

    Args:
        ahead_m: distance by which it is ahead of the cell.
        slower_mps: v_F minus its speed.
        speed_mps: v_F.
        limits: the vehicle's limits.

    Returns:
        None: it cannot, or takes longer than `LONGEST_S`.
    """
    for count in range(2, round(LONGEST_S / _STEP_S) + 1):
        if _is_possible(ahead_m, slower_mps, speed_mps, limits, count * _STEP_S):
            return count * _STEP_S
    return None


@lru_cache(maxsize=4096)
def fall_back_m(slower_mps: float, speed_mps: float, limits: Vehicle, longest_s: float) -> float:
    """Return how far ahead of its cell a vehicle must be to settle there in a given time [m].

    If it cannot, it is the distance for `LONGEST_S`.
    """
    for ahead_m in np.arange(0.0, 200.0, 1.0):
        time_s = settling_s(float(ahead_m), slower_mps, speed_mps, limits)
        if time_s is not None and time_s <= longest_s:
            return float(ahead_m)
    return 0.5 * slower_mps * longest_s if longest_s < LONGEST_S else math.inf


def _is_possible(
    ahead_m: float, slower_mps: float, speed_mps: float, limits: Vehicle, time_s: float
) -> bool:
    """Return whether the motion of this duration is within limits, and not behind the cell."""
    weights: NDArray[np.float64] = np.array([ahead_m, -slower_mps * time_s])
    speed = weights @ _SPEED / time_s
    accel = weights @ _ACCEL / time_s**2
    return bool(
        (weights @ _POSITION).min() >= -MAX_BEHIND_M
        and accel.max() <= LIMIT_SHARE * limits.max_accel_mps2
        and accel.min() >= -min(COMFORTABLE_BRAKE_MPS2, -LIMIT_SHARE * limits.min_accel_mps2)
        and np.abs(weights @ _JERK).max() / time_s**3 <= LIMIT_SHARE * limits.max_jerk_mps3
        and speed.max() + speed_mps <= limits.max_speed_mps
        and speed.min() + speed_mps >= 0.0
    )
