"""Limits, hold law and integration: what stands in for the tracker."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.agents.driving.reference import Reference
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import (
    Jerk,
    State,
    cell_state,
    hold_law,
    integrate,
    limited_jerk,
)
from support.examples import examples
from support.tables import for_each

SCENARIO = Scenario()
LIMITS = SCENARIO.vehicle
LATTICE = SCENARIO.lattice
TICK_S = SCENARIO.runtime.tick_s
MOVES = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0)]


def error(state: State, cell: Cell, tick: int) -> np.ndarray:
    return np.array(state) - cell_state(LATTICE, cell, tick * TICK_S)


JERK = st.floats(-40, 40)


def keepable_states() -> st.SearchStrategy[State]:
    """Return states that were reached from rest in the frame by limited jerks."""

    def walk(jerks: list[Jerk]) -> State:
        state = cell_state(LATTICE, (0, 1), 0.0)
        for jerk in jerks:
            for _ in range(4):
                state = integrate(state, limited_jerk(state, jerk, LIMITS, TICK_S), TICK_S)
        return state

    return st.lists(st.tuples(JERK, JERK), max_size=12).map(walk)


@examples(150)
@given(keepable_states(), st.tuples(JERK, JERK))
def test_limited_jerk_keeps_every_limit(state: State, wanted: Jerk) -> None:
    for _ in range(40):
        jerk = limited_jerk(state, wanted, LIMITS, TICK_S)
        state = integrate(state, jerk, TICK_S)
        _, v, a, _, v_y, a_y = state
        assert abs(jerk[0]) <= LIMITS.max_jerk_mps3 + 1e-6
        assert LIMITS.min_accel_mps2 - 1e-9 <= a <= LIMITS.max_accel_mps2 + 1e-9
        assert -1e-9 <= v <= LIMITS.max_speed_mps + 1e-9
        assert abs(a_y) <= LIMITS.max_lateral_accel_mps2 + 1e-9
        assert abs(v_y) <= LIMITS.max_slip_ratio * v + 0.05


def test_limited_jerk_is_the_jerk_itself_where_no_limit_is_near() -> None:
    state = cell_state(LATTICE, (0, 1), 0.0)
    assert limited_jerk(state, (3.0, -2.0), LIMITS, TICK_S) == pytest.approx((3.0, -2.0))
    assert limited_jerk(state, (99.0, -99.0), LIMITS, TICK_S) == pytest.approx((15.0, -8.0))
    assert limited_jerk(state, (math.nan, math.nan), LIMITS, TICK_S) == (0.0, 0.0)


@examples(60)
@given(keepable_states())
def test_hold_law_brings_the_vehicle_to_rest_in_the_cell(state: State) -> None:
    for tick in range(600):
        reference = cell_state(LATTICE, (0, 1), tick * TICK_S)
        jerk = hold_law(state, reference, LIMITS, TICK_S)
        state = integrate(state, jerk, TICK_S)
        assert abs(jerk[0]) <= LIMITS.max_jerk_mps3 + 1e-6
        assert -1e-9 <= state[1] <= LIMITS.max_speed_mps + 1e-9
    assert np.abs(error(state, (0, 1), 600)).max() < 0.02


@for_each(("dx", "dy"), MOVES)
@for_each("tick", [10, 19, 28])
def test_hold_law_takes_over_from_a_move_without_leaving_the_footprint(
    dx: int, dy: int, tick: int
) -> None:
    """Commands run out during a move: the vehicle goes on to its target, not far beyond."""
    window = Reference.move(SCENARIO, LIMITS, (0, 1), (dx, 1 + dy), 0).window(tick)
    state: State = tuple(window.states[0].tolist())
    worst_s = worst_y = 0.0
    for now in range(tick, tick + 300):
        reference = cell_state(LATTICE, (dx, 1 + dy), now * TICK_S)
        state = integrate(state, hold_law(state, reference, LIMITS, TICK_S), TICK_S)
        off = error(state, (dx, 1 + dy), now + 1)
        worst_s, worst_y = max(worst_s, dx * off[0]), max(worst_y, dy * off[3])
    assert worst_s < 2.5
    assert worst_y < 0.35
    assert np.abs(error(state, (dx, 1 + dy), tick + 300)).max() < 0.01


@examples(100)
@given(
    st.tuples(*[st.floats(-100, 100) for _ in range(6)]),
    st.tuples(JERK, JERK),
    st.integers(2, 8),
)
def test_integration_is_exact(state: State, jerk: Jerk, parts: int) -> None:
    """One tick equals its parts: true of the exact solution only."""
    small = state
    for _ in range(parts):
        small = integrate(small, jerk, TICK_S / parts)
    assert integrate(state, jerk, TICK_S) == pytest.approx(small, abs=1e-9)
