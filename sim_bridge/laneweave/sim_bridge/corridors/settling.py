"""How a vehicle that enters with another speed than v_F gets into a cell.

In the moving frame the vehicle is ahead of its cell by some distance, and slower: it falls back
while it accelerates. The fastest way is to brake first, so that it falls back faster, then to hold
the speed, and to accelerate last, each phase with limited jerk. The agent then plans the trajectory
of minimum squared jerk in the time that this takes (`agents.driving.trajectory`).
"""

from __future__ import annotations

import math
from functools import lru_cache

from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import NEARLY_SETTLED_MPS

LIMIT_SHARE = 0.9
"""Share of its limits that a vehicle uses."""
BRAKE_MPS2 = 2.0
"""Deceleration with which a vehicle falls back."""
MIN_SPEED_MPS = 6.0
"""Lowest speed to which a vehicle brakes."""
LONGEST_S = 60.0
SLOW_ENTRY_S = 6.0
"""Time after its entry in which a slow vehicle is usually ready to change lanes."""
_SHORTEST_S = 1.0
_SLACK_S = 0.3
"""Spare time: ticks are discrete."""
_LATE_S = 0.15
"""Time for which it may hold its speed before it has to accelerate: agents do not begin at once."""
_STEP_MPS = 0.25
_NEAR_M, _NEAR_MPS = 0.1, 0.1
"""Distance and difference in speed at which a vehicle is in its cell."""


@lru_cache(maxsize=4096)
def settling_s(
    ahead_m: float, slower_mps: float, speed_mps: float, limits: Vehicle
) -> float | None:
    """Return the shortest time in which a vehicle settles in a cell within its limits.

    Args:
        ahead_m: distance by which it is ahead of the cell.
        slower_mps: v_F minus its speed.
        speed_mps: v_F.
        limits: the vehicle's limits.

    None: it cannot without falling behind the cell, or takes longer than `LONGEST_S`.
    """
    if abs(ahead_m) <= _NEAR_M and abs(slower_mps) <= _NEAR_MPS:
        return _SHORTEST_S
    brake_mps2 = min(BRAKE_MPS2, -LIMIT_SHARE * limits.min_accel_mps2)
    least_mps = max(slower_mps, _STEP_MPS)
    found = []
    for step in range(max(1, math.ceil((speed_mps - MIN_SPEED_MPS - least_mps) / _STEP_MPS))):
        slowest_mps = least_mps + step * _STEP_MPS
        brake_s, brakes_m = _change(slower_mps, slowest_mps, brake_mps2, limits)
        accel_s, accelerates_m = _change(
            slowest_mps, 0.0, LIMIT_SHARE * limits.max_accel_mps2, limits
        )
        holds_s = (ahead_m - brakes_m - accelerates_m) / slowest_mps
        if holds_s < _LATE_S:
            break  # slower still, it would fall back farther
        found.append(brake_s + holds_s + accel_s)
    time_s = max(min(found, default=math.inf) + _SLACK_S, _SHORTEST_S)
    return round(time_s, 1) if time_s <= LONGEST_S else None


def before_rest_s(room_ahead_m: float, limits: Vehicle) -> float:
    """Return how long before it is in its cell a vehicle is ready for plans, at least.

    It may be ahead of the cell by `room_ahead_m` (`VehicleTypes.room_ahead_m`).
    """
    accel_mps2 = limits.max_accel_mps2
    return min(NEARLY_SETTLED_MPS / accel_mps2, math.sqrt(2.0 * room_ahead_m / accel_mps2))


def _change(
    from_mps: float, to_mps: float, accel_mps2: float, limits: Vehicle
) -> tuple[float, float]:
    """Return the time and the distance of a change of the speed in the moving frame."""
    jerk_mps3 = LIMIT_SHARE * limits.max_jerk_mps3
    change_mps = abs(to_mps - from_mps)
    if change_mps < accel_mps2**2 / jerk_mps3:
        time_s = 2.0 * math.sqrt(change_mps / jerk_mps3)
    else:
        time_s = change_mps / accel_mps2 + accel_mps2 / jerk_mps3
    return time_s, 0.5 * (from_mps + to_mps) * time_s


@lru_cache(maxsize=4096)
def fall_back(slower_mps: float, speed_mps: float, limits: Vehicle) -> tuple[float, float]:
    """Return how far ahead of its cell a vehicle must be to settle there soonest [m], and the time.

    If it cannot settle, they are infinite.
    """
    for ahead_m in range(500):
        time_s = settling_s(float(ahead_m), slower_mps, speed_mps, limits)
        if time_s is not None:
            return float(ahead_m), time_s
    return math.inf, math.inf
