"""Motion of one vehicle: exact integration, limits, and the control law that holds a cell.

Both axes are triple integrators (front bumper s along the road, body centre y across it):

    state z = (s, v, a, y, v_y, a_y)        input u = (j_s, j_y), constant during a tick

**The commanded state.** The acceleration of a body follows its set-point u with a first-order lag:
lag da/dt = u - a. Let c = s + lag v. Then dc/dt = v + lag a and d2c/dt2 = u: the point c moves
without lag, and the body follows it through a low-pass filter, lag ds/dt = c - s. Controlling the
*commanded state* (c, dc/dt, u) therefore compensates the lag exactly. A low-pass filter averages,
so the body keeps every limit on speed, acceleration and jerk that the commanded state keeps, and
two bodies of equal lag keep the distance between their commanded states. All control laws here, the
tracker and the references use commanded states. The constant term lag v_F is left out of c, so that
a vehicle that holds has equal true and commanded states.

All functions are pure functions of floats. The agent plans with them, the motion controller drives
with them when the agent's commands run out, and the plant integrates with them, so the results of
all three are bit-identical.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.vehicle_tables import Vehicle

State = tuple[float, float, float, float, float, float]
"""(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""

Jerk = tuple[float, float]
"""(j_s, j_y) [m/s3]."""

ARRIVED_ALONG_M = 0.5
ARRIVED_ACROSS_M = 0.3
"""Distances from the target point at which a body has arrived once the motion's time has passed."""

SETTLED_MPS = 0.5
"""Difference in speed to its cell up to which a body has settled in it."""
NEARLY_SETTLED_MPS = 4.0
"""How much slower than its cell a body that settles may be when it is ready for plans."""
DISPLACED_ALONG_M = 1.0
DISPLACED_ACROSS_M = 0.5
"""Distances from its cell from which a vehicle no longer holds it, for example after an emergency
brake: the minimum gaps between bodies in neighbouring cells (modules `config.*_checks`)."""

# Poles of the hold law near -0.6 and -1.2 +- 0.8i 1/s: hardly any overshoot, and slow enough for
# ticks of 0.1 s.
_POSITION_GAIN = 0.35
"""Requested speed per position error [1/s]."""
_SPEED_GAIN = 1.2
"""Requested acceleration per speed error [1/s]."""
_ACCEL_GAIN = 3.0
"""Jerk per acceleration error [1/s]."""
_BRAKE_SHARE = 0.6
"""Fraction of the braking limit that the hold law uses."""
_ACCEL_SHARE = 0.8
"""Fraction of the other limits that the hold law uses."""
_CATCH_UP_SHARE = 0.25
"""Maximum speed towards the cell along the road, as a fraction of the cell's speed."""

_PLENTY = 0.3
"""More than the 1/4 in `_min_accel`, with ample room for rounding errors."""

_OPEN_GAIN = 0.6
"""Speed at which too small a gap is widened, per missing metre [1/s]."""
_SETTLE_TICKS = 2.0
"""Number of ticks in which the safe speed is reached."""


def integrate(state: State, jerk: Jerk, tick_s: float) -> State:
    """Return the exact state after one tick of constant jerk."""
    s, v, a, y, v_y, a_y = state
    j_s, j_y = jerk
    half = tick_s * tick_s / 2.0
    sixth = half * tick_s / 3.0
    return (
        s + v * tick_s + a * half + j_s * sixth,
        v + a * tick_s + j_s * half,
        a + j_s * tick_s,
        y + v_y * tick_s + a_y * half + j_y * sixth,
        v_y + a_y * tick_s + j_y * half,
        a_y + j_y * tick_s,
    )


def commanded_state(
    state: State, setpoint: tuple[float, float], limits: Vehicle, speed_mps: float
) -> State:
    """Return the commanded state of a body; see the module docstring.

    Args:
        state: state of the body.
        setpoint: accelerations commanded to its actuators, along and across [m/s2].
        limits: the vehicle, for its lags.
        speed_mps: v_F, the speed of the lattice.
    """
    s, v, a, y, v_y, a_y = state
    lag_s, lateral_lag_s = limits.actuator_lag_s, limits.lateral_actuator_lag_s
    return (
        s + lag_s * (v - speed_mps),
        v + lag_s * a,
        setpoint[0],
        y + lateral_lag_s * v_y,
        v_y + lateral_lag_s * a_y,
        setpoint[1],
    )


def cell_state(lattice: Lattice, cell: Cell, t_s: float) -> State:
    """Return the state of a vehicle that holds `cell` at road time `t_s` [s]."""
    column, lane = cell
    return (lattice.cell_s_m(column, t_s), lattice.speed_mps, 0.0, lattice.cell_y_m(lane), 0.0, 0.0)


def at_rest_in_cell(
    measured: State, lattice: Lattice, cell: Cell, t_s: float, room_ahead_m: float = 0.0
) -> bool:
    """Return whether a body has arrived in `cell` at road time `t_s` [s].

    It may be as far ahead of its cell as behind it, and `room_ahead_m` if that is farther.
    """
    goal = cell_state(lattice, cell, t_s)
    ahead_m, across_m = measured[0] - goal[0], abs(measured[3] - goal[3])
    in_column = -ARRIVED_ALONG_M <= ahead_m <= max(ARRIVED_ALONG_M, room_ahead_m)
    return in_column and across_m <= ARRIVED_ACROSS_M


def has_settled(measured: State, lattice: Lattice, cell: Cell, t_s: float) -> bool:
    """Return whether a body is in `cell` at road time `t_s` [s], and about as fast as the cell."""
    return (
        at_rest_in_cell(measured, lattice, cell, t_s)
        and abs(measured[1] - lattice.speed_mps) <= SETTLED_MPS
    )


def nearly_settled(
    measured: State, lattice: Lattice, cell: Cell, t_s: float, room_ahead_m: float
) -> bool:
    """Return whether a body that settles in `cell` is near enough to take part in plans.

    Args:
        measured: measured state of the body.
        lattice: the lattice.
        cell: the cell.
        t_s: road time.
        room_ahead_m: how far ahead of its cell a body may be (`VehicleTypes.room_ahead_m`).
    """
    goal = cell_state(lattice, cell, t_s)
    return (
        -ARRIVED_ALONG_M <= measured[0] - goal[0] <= room_ahead_m
        and abs(measured[3] - goal[3]) <= ARRIVED_ACROSS_M
        and -NEARLY_SETTLED_MPS <= measured[1] - goal[1] <= SETTLED_MPS
    )


def displaced(
    measured: State, lattice: Lattice, cell: Cell, t_s: float, room_ahead_m: float = 0.0
) -> bool:
    """Return whether a body is too far from `cell` to hold it at road time `t_s` [s].

    It may be as far ahead of its cell as behind it, and `room_ahead_m` if that is farther.
    """
    goal = cell_state(lattice, cell, t_s)
    ahead_m = measured[0] - goal[0]
    return (
        not -DISPLACED_ALONG_M <= ahead_m <= max(DISPLACED_ALONG_M, room_ahead_m)
        or abs(measured[3] - goal[3]) > DISPLACED_ACROSS_M
    )


def limited_jerk(state: State, jerk: Jerk, limits: Vehicle, tick_s: float) -> Jerk:
    """Return the jerk nearest to `jerk` that keeps the vehicle within its limits.

    After the tick the accelerations are within their limits, the speed is within [0, max_speed_mps]
    and |v_y| <= max_slip_ratio v, and later ticks can keep these limits: braking ends early enough
    for the acceleration to return to zero before the vehicle would roll backwards. From a state
    that was reached within the limits, the jerk limits suffice. From other states (after an
    emergency brake) the speed limits take precedence over the jerk limits, and the acceleration
    limits over the speed limits. The state must be finite; a NaN jerk counts as zero.
    """
    _, v, a, _, v_y, a_y = state
    a_next = limited_accel(v, a, jerk[0], limits, tick_s)
    ay_next = _limited_lateral_accel((v, a, v_y, a_y), a_next, jerk[1], limits, tick_s)
    return ((a_next - a) / tick_s, (ay_next - a_y) / tick_s)


def limited_accel(v: float, a: float, jerk: float, limits: Vehicle, tick_s: float) -> float:
    """Return the acceleration along the road after a tick of the jerk that `limited_jerk` allows.

    `v`, `a` and `jerk` are longitudinal, in SI units; a NaN jerk counts as zero.
    """
    j_max = limits.max_jerk_mps3
    step = j_max * tick_s
    a_next = a + tick_s * (jerk if -j_max <= jerk <= j_max else _clamp(jerk, -j_max, j_max))
    # Usually the limit is far away; this test is cheaper than the bound itself (`_min_accel`).
    share, x = (2.0 * v / tick_s + a) / step, -a_next / step
    if share < (x + 1.0) * x + _PLENTY:
        a_next = max(a_next, _min_accel(share, step))
    share, x = (2.0 * (limits.max_speed_mps - v) / tick_s - a) / step, a_next / step
    if share < (x + 1.0) * x + _PLENTY:
        a_next = min(a_next, -_min_accel(share, step))
    low, high = limits.min_accel_mps2, limits.max_accel_mps2
    return a_next if low <= a_next <= high else _clamp(a_next, low, high)


def _limited_lateral_accel(
    motion: tuple[float, float, float, float],
    a_next: float,
    jerk: float,
    limits: Vehicle,
    tick_s: float,
) -> float:
    """Return the acceleration across the road after a tick of the jerk that `limited_jerk` allows.

    Args:
        motion: (v, a, v_y, a_y) in SI units.
        a_next: acceleration along the road after the tick [m/s2].
        jerk: requested j_y [m/s3]; NaN counts as zero.
        limits: the vehicle's limits.
        tick_s: length of the tick [s].
    """
    v, a, v_y, a_y = motion
    j_max, ratio = limits.max_lateral_jerk_mps3, limits.max_slip_ratio
    a_max = limits.max_lateral_accel_mps2
    step = j_max * tick_s
    ay_next = a_y + tick_s * (jerk if -j_max <= jerk <= j_max else _clamp(jerk, -j_max, j_max))
    # The margins to the slip limit on both sides are treated like speeds: ratio v -+ v_y >= 0.
    speed, rate, rate_next = ratio * v, ratio * a, ratio * a_next
    share, x = (2.0 * (speed + v_y) / tick_s + (rate + a_y)) / step, -(rate_next + ay_next) / step
    if share < (x + 1.0) * x + _PLENTY:
        ay_next = max(ay_next, _min_accel(share, step) - rate_next)
    share, x = (2.0 * (speed - v_y) / tick_s + (rate - a_y)) / step, (ay_next - rate_next) / step
    if share < (x + 1.0) * x + _PLENTY:
        ay_next = min(ay_next, rate_next - _min_accel(share, step))
    return ay_next if -a_max <= ay_next <= a_max else _clamp(ay_next, -a_max, a_max)


def hold_law(state: State, reference: State, limits: Vehicle, tick_s: float) -> Jerk:
    """Return the jerk that brings the vehicle to rest in a cell: a saturated linear feedback.

    The position error determines a speed, the speed error an acceleration, and the acceleration
    error a jerk; each is saturated. Other vehicles are ignored: see `keep_gap`. The result keeps
    the limits as in `limited_jerk`.

    Args:
        state: finite state.
        reference: state of the cell now, `cell_state(lattice, cell, t_s)`.
        limits: the vehicle's limits.
        tick_s: length of the tick [s].
    """
    s, v, a, y, v_y, a_y = state
    cell_s, cell_v, _, cell_y, _, _ = reference
    catch_up = _CATCH_UP_SHARE * cell_v
    headroom = _ACCEL_SHARE * (limits.max_speed_mps - cell_v)
    # A weak vehicle that falls back faster would fall behind its cell before it is as fast again.
    fall_back = min(catch_up, _ACCEL_SHARE * limits.max_accel_mps2 / _POSITION_GAIN)
    wanted_v = cell_v + _clamp(_POSITION_GAIN * (cell_s - s), -fall_back, min(catch_up, headroom))
    wanted_a = _clamp(
        _SPEED_GAIN * (wanted_v - v),
        _BRAKE_SHARE * limits.min_accel_mps2,
        _ACCEL_SHARE * limits.max_accel_mps2,
    )
    slip = _ACCEL_SHARE * limits.max_slip_ratio * max(v, 0.0)
    wanted_vy = _clamp(_POSITION_GAIN * (cell_y - y), -slip, slip)
    a_max = _ACCEL_SHARE * limits.max_lateral_accel_mps2
    wanted_ay = _clamp(_SPEED_GAIN * (wanted_vy - v_y), -a_max, a_max)
    jerk = (_ACCEL_GAIN * (wanted_a - a), _ACCEL_GAIN * (wanted_ay - a_y))
    return limited_jerk(state, jerk, limits, tick_s)


def stop_law(state: State, goal: State, decel_mps2: float, limits: Vehicle, tick_s: float) -> Jerk:
    """Return the jerk that brakes to standing with a deceleration, beside a goal state."""
    _, across = hold_law(state, (state[0], *goal[1:]), limits, tick_s)
    wanted_mps2 = max(-decel_mps2, -max(state[1], 0.0) / tick_s)
    return limited_jerk(state, ((wanted_mps2 - state[2]) / tick_s, across), limits, tick_s)


def keep_gap(
    state: State,
    jerk: Jerk,
    ahead: Iterable[tuple[float, float]],
    limits: Vehicle,
    min_gap_m: float,
    tick_s: float,
) -> Jerk:
    """Return `jerk`, or one that brakes harder if necessary to stay behind other vehicles.

    The safe speed after Gipps ("A behavioural car-following model for computer simulation",
    Transportation Research B 15, 1981): if the vehicle ahead brakes with b to standstill, this one,
    which brakes with b after the time T, comes to rest `min_gap_m` behind it,

        v T + v^2 / (2 b)  <=  gap - min_gap + v_other^2 / (2 b).

    b is also the maximum braking of the hold law, so a queue of vehicles that all use these laws is
    safe. T is half the time in which limited jerk reaches b, plus two ticks, plus the time until
    the vehicle stops accelerating; the speed that the vehicle gains until then is added to v.

    There are two exceptions. A vehicle at least `min_gap_m` behind may always be as fast as the one
    ahead, so a queue at equal speed keeps its gaps; if these are below v T, the queue relies on
    `min_gap_m` when its first vehicle brakes. A vehicle closer than `min_gap_m` falls back. Since
    time is discrete, up to 0.1 m of the gap may be missing with ticks of 0.1 s, and up to 2 m with
    ticks of 0.4 s (measured). The result keeps the limits as in `limited_jerk`.

    Args:
        state: finite state.
        jerk: requested jerk.
        ahead: (net gap [m], speed [m/s]) of each vehicle to stay behind.
        limits: the vehicle's limits.
        min_gap_m: net gap to keep.
        tick_s: length of the tick [s].
    """
    _, v, a, _, _, _ = state
    brake = -_BRAKE_SHARE * limits.min_accel_mps2
    # With limited jerk, an acceleration ends only after some time.
    fade_s = max(a, 0.0) / limits.max_jerk_mps3
    gained_v = max(a, 0.0) * (0.5 * fade_s + tick_s)
    delay_s = brake / (2.0 * limits.max_jerk_mps3) + 2.0 * tick_s + fade_s
    j_s = jerk[0]
    for gap_m, speed_mps in ahead:
        spare_m = gap_m - min_gap_m
        room_m = max(spare_m + speed_mps * speed_mps / (2.0 * brake), 0.0)
        stopping = brake * (math.sqrt(delay_s * delay_s + 2.0 * room_m / brake) - delay_s)
        safe_v = max(stopping, speed_mps + _OPEN_GAIN * min(spare_m, 0.0))
        wanted_a = max((safe_v - v - gained_v) / (_SETTLE_TICKS * tick_s), -brake)
        j_s = min(j_s, (wanted_a - a) / tick_s)
    return limited_jerk(state, (j_s, jerk[1]), limits, tick_s)


def _clamp(value: float, low: float, high: float) -> float:
    """Return `value` within [low, high]; NaN becomes 0."""
    if low <= value <= high:
        return value
    return 0.0 if math.isnan(value) else min(max(value, low), high)


def _min_accel(share: float, step: float) -> float:
    """Return the minimum rate, after this tick, that lets a speed stay above its lower bound.

    The margin is the speed above that bound [m/s], the rate its derivative [m/s2]. Raising the rate
    from -x jerk tick_s to zero, at full jerk except in the last tick, reduces the margin by jerk
    tick_s^2 / 2 times m^2, interpolated at x between integers m; this tick changes the margin by
    tick_s times the mean of the rates before and after. The minimum rate uses up the margin:

        x + interp(m^2)(x) = 2 (margin + rate tick_s / 2) / (jerk tick_s^2)

    The interpolation exceeds x^2 by at most 1/4: if the right side is above x + x^2 + 1/4, a rate
    of -x jerk tick_s is above the minimum.

    Args:
        share: the right side.
        step: jerk tick_s, the maximum change of the rate in a tick [m/s2].
    """
    if share <= 0.0:
        return -share * step
    whole = math.floor((math.sqrt(1.0 + 4.0 * share) - 1.0) / 2.0)
    return -step * (whole + (share - whole * (whole + 1.0)) / (2.0 * (whole + 1.0)))
