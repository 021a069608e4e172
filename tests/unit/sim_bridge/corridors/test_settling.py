"""How vehicles that enter more slowly than v_F get into their cells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.protocol.scenario.fields import Vehicle
from laneweave.sim_bridge.corridors.corridor_ramps import _cruising_s, _shortest_s, _slow_mps
from laneweave.sim_bridge.corridors.settling import (
    COMFORTABLE_BRAKE_MPS2,
    LIMIT_SHARE,
    MAX_BEHIND_M,
    fall_back_m,
    settling_s,
)

SPEED_MPS = 25.0
CAR = Vehicle(max_accel_mps2=2.6, min_accel_mps2=-9.0, max_speed_mps=40.0)
TRUCK = Vehicle(max_accel_mps2=1.3, min_accel_mps2=-7.0, max_speed_mps=36.0)


def motion(ahead_m: float, slower_mps: float, time_s: float) -> np.ndarray:
    """Integrate the motion: (position ahead of the cell, relative speed, acceleration, jerk)."""
    # Coefficients of p with p, p', p'' given at both ends, solved independently of the module.
    t = time_s
    ends = np.array(
        [[t**3, t**4, t**5], [3 * t**2, 4 * t**3, 5 * t**4], [6 * t, 12 * t**2, 20 * t**3]]
    )
    start = np.array([ahead_m - slower_mps * t, -slower_mps, 0.0])
    c = np.linalg.solve(ends, -start)
    p = np.polynomial.Polynomial([ahead_m, -slower_mps, 0.0, *c])
    times = np.linspace(0.0, t, 301)
    return np.stack([p.deriv(n)(times) if n else p(times) for n in range(4)])


@settings(max_examples=200, deadline=None)
@given(st.floats(0.0, 60.0), st.floats(-2.0, 18.0), st.sampled_from([CAR, TRUCK]))
def test_a_vehicle_settles_within_its_limits_and_not_behind_its_cell(
    ahead_m: float, slower_mps: float, limits: Vehicle
) -> None:
    time_s = settling_s(ahead_m, slower_mps, SPEED_MPS, limits)
    if time_s is None:
        return
    position, speed, accel, jerk = motion(ahead_m, slower_mps, time_s)
    assert position.min() >= -MAX_BEHIND_M - 0.05
    assert accel.max() <= LIMIT_SHARE * limits.max_accel_mps2 + 0.02
    assert accel.min() >= -COMFORTABLE_BRAKE_MPS2 - 0.02
    assert abs(jerk).max() <= limits.max_jerk_mps3
    assert (speed + SPEED_MPS).min() >= -0.01
    assert abs(position[-1]) + abs(speed[-1]) < 1e-6


def test_the_time_is_the_shortest_one() -> None:
    assert settling_s(0.0, 0.0, SPEED_MPS, CAR) == 1.0
    time_s = settling_s(17.0, 5.6, SPEED_MPS, CAR)
    assert time_s is not None
    _, _, accel, _ = motion(17.0, 5.6, time_s - 0.5)
    position, _, faster, _ = motion(17.0, 5.6, time_s - 0.5)
    assert accel.max() > LIMIT_SHARE * CAR.max_accel_mps2 or position.min() < -MAX_BEHIND_M
    assert faster is not None


def test_a_weak_vehicle_needs_more_room() -> None:
    car, truck = (fall_back_m(6.0, SPEED_MPS, limits, 12.0) for limits in (CAR, TRUCK))
    assert 8.0 <= car < truck <= 30.0
    assert settling_s(car, 6.0, SPEED_MPS, CAR) is not None
    assert settling_s(0.0, 6.0, SPEED_MPS, CAR) is None


@given(st.floats(60.0, 400.0), st.floats(0.0, 30.0), st.floats(12.0, 22.0), st.floats(0.8, 2.0))
def test_advice_brings_a_vehicle_to_its_ramp_in_time(
    distance_m: float, delay_s: float, end_mps: float, accel_mps2: float
) -> None:
    shortest_s = _shortest_s(distance_m, end_mps, end_mps, accel_mps2)
    assert shortest_s == pytest.approx(distance_m / end_mps)
    time_s = shortest_s + delay_s
    slow_mps = _slow_mps(distance_m, time_s, end_mps, accel_mps2)
    if slow_mps is None:
        return
    assert 0.0 < slow_mps <= end_mps
    needed_s = _cruising_s(distance_m, slow_mps, end_mps, accel_mps2)
    lowest_mps = max(3.0, (max(end_mps**2 - 2.0 * accel_mps2 * distance_m, 0.0)) ** 0.5)
    # In time, or as slowly as it may be, or there is no room for more.
    assert needed_s == pytest.approx(time_s, abs=0.3) or slow_mps <= lowest_mps + 0.02
