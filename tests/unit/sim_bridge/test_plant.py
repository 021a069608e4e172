"""The plant keeps its limits and integrates exactly."""

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


def test_it_brakes_to_a_standstill_and_stays() -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    for _ in range(60):
        plant.step(-LIMITS.max_jerk_mps3, 0.0)
    s, v, a, *_ = plant.state
    assert v == pytest.approx(0.0, abs=1e-6)
    assert a == pytest.approx(0.0, abs=1e-6)
    assert 15.0**2 / (2.0 * 10.0) < s < 30.0
