"""Motion of one vehicle: exact integration, limits, and the law that brings it to rest in a cell.

State and input of the road model, both axes triple integrators (front bumper s along the road,
body centre y across it):

    state z = (s, v, a, y, v_y, a_y)        input u = (j_s, j_y), constant during a tick

**The commanded state.** A body does not follow its set-point of acceleration u at once, but as a
first-order lag does: lag da/dt = u - a. Let c = s + lag v. Then dc/dt = v + lag a and
d2c/dt2 = u: the point c moves as if there were no lag, and the body follows it as a low-pass
filter does, lag ds/dt = c - s. So whoever steers the *commanded state* (c, dc/dt, u) has
compensated the lag exactly, and since a low-pass filter averages, the body keeps every limit on
speed, acceleration and jerk, and every distance between two bodies of equal lag, that the commanded
states keep. All laws here, the tracker and the references are about commanded states. They
are counted from where they are at rest in the lattice (lag v_F is left out of c), so that a
vehicle that holds has equal true and commanded states.

Everything here is a pure function of plain floats. The agent plans with it, the vehicle's own
motion controller runs on it when the agent's commands run out, and the plant integrates with it,
so the three agree to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.tables import Vehicle

State = tuple[float, float, float, float, float, float]
"""(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""

Jerk = tuple[float, float]
"""(j_s, j_y) [m/s3]."""

ARRIVED_ALONG_M = 0.5
ARRIVED_ACROSS_M = 0.3
"""A motion has ended when its time is over and the body is this close to the target point."""

# Poles of the hold law near -0.6 and -1.2 +- 0.8i 1/s: no overshoot worth mentioning, and slow
# enough for ticks of 0.1 s.
_POSITION_GAIN = 0.35
"""Wanted speed per position error [1/s]."""
_SPEED_GAIN = 1.2
"""Wanted acceleration per speed error [1/s]."""
_ACCEL_GAIN = 3.0
"""Jerk per acceleration error [1/s]."""
_BRAKE_SHARE = 0.6
"""Share of the braking limit that the hold law asks for."""
_ACCEL_SHARE = 0.8
"""Share of the other limits that the hold law asks for."""
_CATCH_UP_SHARE = 0.25
"""Largest speed towards the cell along the road, as a share of the cell's speed."""

_PLENTY = 0.3
"""More than the 1/4 of `_min_accel`, by far more than rounding."""

_OPEN_GAIN = 0.6
"""Speed at which a gap that is too small is opened, per metre that it lacks [1/s]."""
_SETTLE_TICKS = 2.0
"""Ticks after which the speed is to be the safe one."""


def integrate(state: State, jerk: Jerk, tick_s: float) -> State:
    """Return the state after one tick of constant jerk: the exact solution, no approximation.

    Args:
        state: (s, v, a, y, v_y, a_y) in m and s.
        jerk: (j_s, j_y) [m/s3].
        tick_s: length of the tick [s].
    """
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
    """Return the state that a body pursues through its actuators; see the module.

    Args:
        state: of the body, (s, v, a, y, v_y, a_y) in m and s.
        setpoint: accelerations that its actuators were told, along and across [m/s2].
        limits: the vehicle; its lags count.
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


def at_rest_in_cell(state: State, lattice: Lattice, cell: Cell, t_s: float) -> bool:
    """Tell whether a motion that led to `cell` has ended: the body is close to the target point.

    Args:
        state: of the body at road time `t_s` [s].
        lattice: where the cell lies.
        cell: (column, lane) of the target.
        t_s: road time [s].
    """
    goal = cell_state(lattice, cell, t_s)
    return (
        abs(state[0] - goal[0]) <= ARRIVED_ALONG_M and abs(state[3] - goal[3]) <= ARRIVED_ACROSS_M
    )


def limited_jerk(state: State, jerk: Jerk, limits: Vehicle, tick_s: float) -> Jerk:
    """Return the jerk nearest to `jerk` that keeps the vehicle within its limits.

    After the tick the accelerations are within their limits, the speed within [0, max_speed_mps]
    and |v_y| <= max_slip_ratio v, and all of them can be kept ever after: the speed looks ahead,
    so braking ends early enough for the acceleration to return to zero before the vehicle would
    roll backwards. From a state that was reached within the limits this needs no more than the
    jerk limits. From any other (an emergency brake that was released late) the jerk limit gives
    way to the speed, and the speed to the acceleration limit.

    Args:
        state: (s, v, a, y, v_y, a_y) in m and s, finite.
        jerk: wanted (j_s, j_y) [m/s3]; NaN counts as zero.
        limits: the vehicle's limits.
        tick_s: length of the tick [s].
    """
    _, v, a, _, v_y, a_y = state
    a_next = limited_accel(v, a, jerk[0], limits, tick_s)
    ay_next = _limited_lateral_accel((v, a, v_y, a_y), a_next, jerk[1], limits, tick_s)
    return ((a_next - a) / tick_s, (ay_next - a_y) / tick_s)


def limited_accel(v: float, a: float, jerk: float, limits: Vehicle, tick_s: float) -> float:
    """Return the acceleration along the road after a tick of the jerk that `limited_jerk` allows.

    Args:
        v: speed along the road [m/s].
        a: acceleration along the road [m/s2].
        jerk: wanted j_s [m/s3]; NaN counts as zero.
        limits: the vehicle's limits.
        tick_s: length of the tick [s].
    """
    j_max = limits.max_jerk_mps3
    step = j_max * tick_s
    a_next = a + tick_s * (jerk if -j_max <= jerk <= j_max else _clamp(jerk, -j_max, j_max))
    # Mostly there is room in plenty, which is quicker to see than how much acceleration it leaves:
    # see `_min_accel`.
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
        motion: (v, a, v_y, a_y) in m and s.
        a_next: acceleration along the road after the tick [m/s2].
        jerk: wanted j_y [m/s3]; NaN counts as zero.
        limits: the vehicle's limits.
        tick_s: length of the tick [s].
    """
    v, a, v_y, a_y = motion
    j_max, ratio, a_max = (
        limits.max_lateral_jerk_mps3,
        limits.max_slip_ratio,
        limits.max_lateral_accel_mps2,
    )
    step = j_max * tick_s
    ay_next = a_y + tick_s * (jerk if -j_max <= jerk <= j_max else _clamp(jerk, -j_max, j_max))
    # Room to either side of the slip limit is a speed too: ratio v -+ v_y >= 0.
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

    Position error asks for a speed, speed error for an acceleration, acceleration error for a
    jerk; each is saturated before it is passed on. It looks neither ahead nor behind; `keep_gap`
    does.

    Args:
        state: (s, v, a, y, v_y, a_y) in m and s, finite.
        reference: the cell now, `cell_state(lattice, cell, t_s)`.
        limits: the vehicle's limits; the result respects them as `limited_jerk` does.
        tick_s: length of the tick [s].
    """
    s, v, a, y, v_y, a_y = state
    cell_s, cell_v, _, cell_y, _, _ = reference
    catch_up = _CATCH_UP_SHARE * cell_v
    headroom = _ACCEL_SHARE * (limits.max_speed_mps - cell_v)
    wanted_v = cell_v + _clamp(_POSITION_GAIN * (cell_s - s), -catch_up, min(catch_up, headroom))
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


def keep_gap(
    state: State,
    jerk: Jerk,
    ahead: Iterable[tuple[float, float]],
    limits: Vehicle,
    min_gap_m: float,
    tick_s: float,
) -> Jerk:
    """Return `jerk`, or one that brakes more where that is needed to stay behind somebody.

    The safe speed after Gipps ("A behavioural car-following model for computer simulation",
    Transportation Research B 15, 1981): should the other one brake with b to standstill, this one,
    which brakes with b after the time T, comes to rest `min_gap_m` behind it,

        v T + v^2 / (2 b)  <=  gap - min_gap + v_other^2 / (2 b).

    b is the braking that the hold law asks for, too, so a row of vehicles that all drive by these
    laws is safe as a whole. T is the time in which limited jerk builds b up; the time and the speed
    that a vehicle gains until it has ended speeding up count, too.

    Two exceptions. Who is at least `min_gap_m` behind may always be as fast as the other one: a row
    at equal speed stays as it is, however tight, but closer than v T it relies on `min_gap_m` when
    the first one brakes. And who is closer than `min_gap_m` falls back. Time is discrete: with
    ticks of 0.1 s up to 0.1 m of the gap may lack, with ticks of 0.4 s up to 2 m (measured).

    Args:
        state: (s, v, a, y, v_y, a_y) in m and s, finite.
        jerk: wanted (j_s, j_y) [m/s3].
        ahead: (net gap [m], speed [m/s]) of each vehicle to stay behind.
        limits: the vehicle's limits; the result respects them as `limited_jerk` does.
        min_gap_m: net gap to keep [m].
        tick_s: length of the tick [s].
    """
    _, v, a, _, _, _ = state
    brake = -_BRAKE_SHARE * limits.min_accel_mps2
    # Who is speeding up goes on to do so until the jerk limit has brought that to an end.
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
    """Return the least rate after this tick from which a room can be kept >= 0.

    The room is a speed above its lower bound [m/s] and the rate its derivative [m/s2]. Raising the
    rate to zero from -x jerk tick_s, whole ticks at full jerk and a last part tick, costs
    jerk tick_s^2 / 2 times the linear interpolation of m^2 at x, and this tick costs the mean of
    both rates. The bound is where both together use up the room:

        x + interp(m^2)(x) = 2 (room + rate tick_s / 2) / (jerk tick_s^2)

    The interpolation is above x^2 by 1/4 at most: where the right side is more than x + x^2 + 1/4,
    a rate of -x jerk tick_s is above the bound.

    Args:
        share: the right side.
        step: jerk tick_s, the most that the rate changes in a tick [m/s2].
    """
    if share <= 0.0:
        return -share * step
    whole = math.floor((math.sqrt(1.0 + 4.0 * share) - 1.0) / 2.0)
    return -step * (whole + (share - whole * (whole + 1.0)) / (2.0 * (whole + 1.0)))
