"""The plant keeps its limits, integrates exactly, and brakes at once when it must."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.protocol.motion import State, integrate
from laneweave.protocol.scenario import Vehicle
from laneweave.sim_bridge.overlap import pose_of
from laneweave.sim_bridge.plant import Plant

LIMITS = Vehicle()
TICK_S = 0.1
CRUISE: State = (0.0, 15.0, 0.0, 1.75, 0.0, 0.0)
JERKS = st.one_of(st.floats(-200.0, 200.0), st.just(math.nan), st.just(math.inf))
COMMANDS = st.lists(st.tuples(JERKS, JERKS), min_size=1, max_size=120)


def test_a_jerk_within_the_limits_is_integrated_exactly() -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    assert plant.step(3.0, -2.0) == pytest.approx(integrate(CRUISE, (3.0, -2.0), TICK_S))
    assert plant.pose == pose_of(plant.state)
    assert plant.max_jerk_mps3 == pytest.approx(3.0)
    assert plant.max_accel_mps2 == pytest.approx(0.3)
    assert plant.min_accel_mps2 == 0.0


@given(COMMANDS)
@settings(max_examples=100, deadline=None)
def test_limits_hold_whatever_is_commanded(commands: list[tuple[float, float]]) -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    for jerk_s, jerk_y in commands:
        s_before = plant.state[0]
        s, v, a, _, v_y, a_y = plant.step(jerk_s, jerk_y)
        assert s >= s_before - 1e-9
        assert -1e-9 <= v <= LIMITS.max_speed_mps + 1e-9
        assert LIMITS.min_accel_mps2 - 1e-9 <= a <= LIMITS.max_accel_mps2 + 1e-9
        assert abs(a_y) <= LIMITS.max_lateral_accel_mps2 + 1e-9
        assert abs(v_y) <= LIMITS.max_slip_ratio * v + 1e-6
    assert plant.max_jerk_mps3 <= LIMITS.max_jerk_mps3 + 1e-9
    assert LIMITS.min_accel_mps2 - 1e-9 <= plant.min_accel_mps2 <= 0.0
    assert 0.0 <= plant.max_accel_mps2 <= LIMITS.max_accel_mps2 + 1e-9


def test_the_emergency_brake_stops_within_the_braking_distance() -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    for _ in range(30):
        plant.step(15.0, 0.0, brake=True)
    s, v, a, *_ = plant.state
    assert s == pytest.approx(15.0**2 / (2.0 * 10.0))
    assert v == pytest.approx(0.0, abs=1e-9)
    assert a == pytest.approx(0.0, abs=1e-9)
    assert plant.min_accel_mps2 == -10.0
    assert plant.max_jerk_mps3 == pytest.approx(100.0)


@given(
    st.lists(st.tuples(JERKS, JERKS, st.booleans()), min_size=1, max_size=120),
)
@settings(max_examples=100, deadline=None)
def test_braking_at_any_time_keeps_the_vehicle_sound(
    commands: list[tuple[float, float, bool]],
) -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    for jerk_s, jerk_y, brake in commands:
        before = plant.state
        s, v, a, y, v_y, _ = plant.step(jerk_s, jerk_y, brake=brake)
        assert s >= before[0] - 1e-3  # a release just above standstill may roll back by less
        assert 0.0 <= v <= LIMITS.max_speed_mps + 1e-6
        assert a >= LIMITS.min_accel_mps2 - 1e-9
        assert abs(v_y) <= LIMITS.max_slip_ratio * v
        assert abs(y - before[3]) <= 0.1 * max(abs(v_y), abs(before[4])) + 0.02
        assert abs(plant.pose[2]) <= math.atan(LIMITS.max_slip_ratio) + 1e-9
        if brake:
            assert a == pytest.approx(max(-10.0, -before[1] / TICK_S), abs=1e-9)


def test_standstill_is_reached_from_the_middle_of_a_lane_change() -> None:
    plant = Plant((0.0, 15.0, 0.0, 1.75, 1.6, 2.0), LIMITS, TICK_S)
    for _ in range(40):
        plant.step(0.0, 8.0, brake=True)
    _, v, a, _, v_y, a_y = plant.state
    assert (v, v_y) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert (a, a_y) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert plant.pose[2] == pytest.approx(0.0, abs=1e-9)
