"""The plant keeps its limits, follows its set-points with exact lags, and brakes."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from attrs import evolve
from hypothesis import assume, given
from hypothesis import strategies as st

from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.emergency_brake import stopping_distance_m
from laneweave.protocol.vehicle.motion import Jerk, State, commanded_state, integrate
from laneweave.sim_bridge.bodies.plant import Plant
from support.driving import recovering
from support.examples import examples

LIMITS = Vehicle()
RIGID = evolve(LIMITS, actuator_lag_s=0.0, lateral_actuator_lag_s=0.0)
"""Without lags."""
TICK_S = 0.1
V_F = 15.0
CRUISE: State = (0.0, V_F, 0.0, 1.75, 0.0, 0.0)
JERKS = st.one_of(st.floats(-200.0, 200.0), st.just(math.nan), st.just(math.inf))
COMMANDS = st.lists(st.tuples(JERKS, JERKS), min_size=1, max_size=120)
SMALL = st.lists(st.tuples(st.floats(-4.0, 4.0), st.floats(-2.0, 2.0)), min_size=1, max_size=8)
"""Jerks that lead to no limit."""
LAGS = st.one_of(st.just(0.0), st.floats(0.01, 2.0))


def integrated(state: State, jerks: Iterable[Jerk], limits: Vehicle, parts: int = 400) -> State:
    """Integrate lag da/dt = u - a in small steps (by the midpoint), u going on from a."""
    lags = limits.actuator_lag_s, limits.lateral_actuator_lag_s
    ways = [list(state[:3]), list(state[3:])]
    setpoints = [state[2], state[5]]
    h = TICK_S / parts
    for jerk in jerks:
        for axis, (way, lag_s) in enumerate(zip(ways, lags, strict=True)):
            for _ in range(parts):
                s, v, a = way
                u = setpoints[axis] + jerk[axis] * h / 2.0
                middle = a + h / 2.0 * (setpoints[axis] - a) / lag_s
                way[:] = s + h * (v + h / 2.0 * a), v + h * middle, a + h * (u - middle) / lag_s
                setpoints[axis] += jerk[axis] * h
    return (*ways[0], *ways[1])  # type: ignore[return-value]


def within(state: State, limits: Vehicle = LIMITS) -> bool:
    _, v, a, _, v_y, a_y = state
    return (
        0.0 <= v <= limits.max_speed_mps + 1e-9
        and limits.min_accel_mps2 - 1e-9 <= a <= limits.max_accel_mps2 + 1e-9
        and abs(a_y) <= limits.max_lateral_accel_mps2 + 1e-9
        and abs(v_y) <= limits.max_slip_ratio * v + 1e-9
    )


# --- how it follows -------------------------------------------------------------------------------


@given(SMALL, st.floats(0.05, 1.0), st.floats(0.05, 1.0))
@examples(25)
def test_it_follows_its_set_point_as_a_first_order_lag_does(
    jerks: list[Jerk], lag_s: float, lateral_lag_s: float
) -> None:
    limits = evolve(LIMITS, actuator_lag_s=lag_s, lateral_actuator_lag_s=lateral_lag_s)
    plant = Plant(CRUISE, limits, TICK_S)
    for jerk in jerks:
        plant.step(*jerk)
    assert plant.setpoint == pytest.approx(
        (sum(j_s for j_s, _ in jerks) * TICK_S, sum(j_y for _, j_y in jerks) * TICK_S)
    )
    assert plant.state == pytest.approx(integrated(CRUISE, jerks, limits), abs=1e-4)


@given(SMALL, LAGS, LAGS, st.floats(0.0, 20.0))
@examples(100)
def test_what_it_pursues_moves_as_if_there_were_no_lag(
    jerks: list[Jerk], lag_s: float, lateral_lag_s: float, speed_mps: float
) -> None:
    """The body follows it with the distance of lag times relative speed."""
    limits = evolve(LIMITS, actuator_lag_s=lag_s, lateral_actuator_lag_s=lateral_lag_s)
    plant = Plant(CRUISE, limits, TICK_S)
    expected = commanded_state(plant.state, plant.setpoint, limits, 0.0)
    for jerk in jerks:
        plant.step(*jerk)
        expected = integrate(expected, jerk, TICK_S)
        pursued = commanded_state(plant.state, plant.setpoint, limits, 0.0)
        assert pursued == pytest.approx(expected, abs=1e-9)
    relative = commanded_state(plant.state, plant.setpoint, limits, speed_mps)
    assert relative[0] == pytest.approx(pursued[0] - lag_s * speed_mps)
    assert relative[1:] == pursued[1:]
    s, v, _, y, v_y, _ = plant.state
    assert relative[0] - s == pytest.approx(lag_s * (v - speed_mps), abs=1e-9)
    assert relative[3] - y == pytest.approx(lateral_lag_s * v_y, abs=1e-9)


# --- limits ---------------------------------------------------------------------------------------


SLIP_ROOM_MPS = 2.5


@given(COMMANDS, LAGS, LAGS)
@examples(150)
def test_limits_hold_whatever_is_commanded(
    commands: list[Jerk], lag_s: float, lateral_lag_s: float
) -> None:
    limits = evolve(LIMITS, actuator_lag_s=lag_s, lateral_actuator_lag_s=lateral_lag_s)
    plant, slid = Plant(CRUISE, limits, TICK_S), False
    for jerk in commands:
        before = plant.state
        _, v, _, _, v_y, _ = commanded_state(before, plant.setpoint, limits, 0.0)
        # With less room to the slip limit than any lateral motion needs to end, it may bind.
        slid = slid or limits.max_slip_ratio * v - abs(v_y) < SLIP_ROOM_MPS
        after = plant.step(*jerk)
        assert after[0] >= before[0] - 1e-9
        assert within(after)
        assert abs(after[2] - before[2]) <= LIMITS.max_jerk_mps3 * TICK_S + 1e-9
        if not slid:  # where the slip limit holds a body back, its lateral jerk gives way
            assert abs(after[5] - before[5]) <= LIMITS.max_lateral_jerk_mps3 * TICK_S + 1e-9


@given(st.lists(st.tuples(JERKS, JERKS, st.booleans()), min_size=1, max_size=100), LAGS)
@examples(100)
def test_emergencies_break_the_limit_on_jerk_only(
    ticks: list[tuple[float, float, bool]], lag_s: float
) -> None:
    limits = evolve(LIMITS, actuator_lag_s=lag_s)
    plant, emergency = Plant(CRUISE, limits, TICK_S), False
    for j_s, j_y, brakes in ticks:
        before, was_emergency = plant.state, emergency
        after = plant.brake(j_y) if brakes else plant.step(j_s, j_y)
        assert after[0] >= before[0] - 1e-9
        assert within(after)
        emergency = brakes or (was_emergency and recovering(plant, limits))
        if not (emergency or was_emergency):
            assert abs(after[2] - before[2]) <= LIMITS.max_jerk_mps3 * TICK_S + 1e-6


@pytest.mark.parametrize("limits", [RIGID, LIMITS], ids=["rigid", "lag"])
def test_it_brakes_to_a_standstill_within_its_jerk_limit_and_stays(limits: Vehicle) -> None:
    plant = Plant(CRUISE, limits, TICK_S)
    for _ in range(60):
        plant.step(-limits.max_jerk_mps3, 0.0)
    s, v, a, *_ = plant.state
    assert v == pytest.approx(0.0, abs=1e-6)
    assert a == pytest.approx(0.0, abs=1e-6)
    assert 15.0**2 / (2.0 * 10.0) < s < 30.0


# --- the emergency brake --------------------------------------------------------------------------


def test_braking_puts_the_set_point_to_the_limit_at_once() -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    plant.step(15.0, 0.0)
    assert not recovering(plant, LIMITS)
    plant.brake(1.0)
    assert plant.setpoint == pytest.approx((LIMITS.min_accel_mps2, 0.1))
    assert recovering(plant, LIMITS)
    rigid = Plant(CRUISE, RIGID, TICK_S)
    assert rigid.brake(0.0)[:3] == pytest.approx((15.0 * TICK_S - 0.05, 14.0, -10.0))


@given(st.floats(0.0, 25.0), st.floats(-10.0, 5.0), LAGS.filter(lambda lag_s: lag_s <= 0.5))
@examples(100)
def test_it_stops_where_its_commanded_state_does_and_does_not_go_back(
    speed_mps: float, accel_mps2: float, lag_s: float
) -> None:
    """With speed v and set-point at the limit b from now on: (v + lag a)^2 / (2 b) + lag v on."""
    pursued_mps = speed_mps + lag_s * accel_mps2
    assume(0.0 <= pursued_mps <= 25.0)
    limits = evolve(LIMITS, actuator_lag_s=lag_s)
    plant = Plant((0.0, speed_mps, accel_mps2, 1.75, 0.0, 0.0), limits, TICK_S)
    for _ in range(40 + round(20 * lag_s / TICK_S)):
        before = plant.state
        plant.brake(0.0)
        assert plant.state[0] >= before[0]
        assert plant.state[1] >= 0.0
    s, v, a, *_ = plant.state
    assert (v, a) == pytest.approx((0.0, 0.0), abs=1e-4)
    # It stops within a tick: up to b tick^2 / 8 farther than with b all the time.
    way_m = lag_s * speed_mps + pursued_mps**2 / 20.0
    assert way_m - 1e-4 <= s <= way_m + 10.0 * TICK_S**2 / 8.0 + 1e-4
    if accel_mps2 > -10.0:
        assert s >= stopping_distance_m(speed_mps, accel_mps2, 10.0, lag_s) - 1e-4


def test_an_emergency_ends_when_the_acceleration_changes_within_the_jerk_limit_again() -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    for _ in range(5):
        plant.brake(0.0)
    ticks, emergency = 0, True
    while emergency:
        before = plant.state[2]
        plant.step(15.0, 0.0)
        emergency = recovering(plant, LIMITS)
        ticks += 1
        assert ticks < 10
    assert abs(plant.state[2] - before) < 15.0 * TICK_S
    before = plant.state[2]
    plant.step(15.0, 0.0)
    assert abs(plant.state[2] - before) <= 15.0 * TICK_S + 1e-9


def test_without_lag_an_emergency_ends_with_the_braking() -> None:
    plant = Plant(CRUISE, RIGID, TICK_S)
    plant.brake(0.0)
    plant.step(0.0, 0.0)
    assert not recovering(plant, RIGID)


def test_it_does_not_slide_sideways_while_it_brakes_in_a_lane_change() -> None:
    plant = Plant(CRUISE, LIMITS, TICK_S)
    for _ in range(8):
        plant.step(0.0, 8.0)
    assert plant.state[4] > 1.5
    while plant.state[1] > 0.0 or plant.state[4] > 0.0:
        plant.brake(8.0)
        assert within(plant.state)
        assert plant.state[0] < 40.0
        if plant.state[1] < 1e-6:
            break
    assert plant.state[4] == pytest.approx(0.0, abs=1e-6)
