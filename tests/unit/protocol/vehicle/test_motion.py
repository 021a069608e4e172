"""Keeping behind the vehicle ahead, and when a motion has ended.

The other laws of `motion` are tested where they are used: tests/unit/agents, sim_bridge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import (
    ARRIVED_ACROSS_M,
    ARRIVED_ALONG_M,
    NEARLY_SETTLED_MPS,
    State,
    at_rest_in_cell,
    cell_state,
    displaced,
    hold_law,
    integrate,
    keep_gap,
    nearly_settled,
)
from support.examples import examples

SCENARIO = Scenario()
LIMITS, LATTICE = SCENARIO.vehicle, SCENARIO.lattice
TICK_S, SPEED_MPS = SCENARIO.runtime.tick_s, SCENARIO.formation.speed_mps
LANE = 1
MIN_GAP_M = SCENARIO.tracking.min_gap_m
COMFORT = 0.6 * LIMITS.min_accel_mps2
"""What the hold law asks for at most when it brakes [m/s2]."""
SHORT_M = 0.05
"""Jerk is limited and time is discrete: so much may lack of the gap."""

Motion = Callable[[float], tuple[float, float]]
"""(rear bumper [m], speed [m/s]) of the first vehicle at a time [s]."""


def body(s_m: float, v_mps: float = SPEED_MPS) -> State:
    return (s_m, v_mps, 0.0, LATTICE.cell_y_m(LANE), 0.0, 0.0)


def row(
    first: Motion,
    gaps: Sequence[float],
    *,
    seconds: float = 20.0,
    limits: Vehicle = LIMITS,
    v_mps: float = SPEED_MPS,
) -> tuple[list[list[float]], list[State], float]:
    """Let vehicles hold their cells behind the first one, each by its own sensing.

    Returns:
        The gaps before each of them after each tick; where they are at the end; the least
        acceleration of all.
    """
    rear, _ = first(0.0)
    states, length = [], limits.length_m
    for gap_m in gaps:
        states.append(body(rear - gap_m, v_mps))
        rear -= gap_m + length
    cells_s = [state[0] for state in states]
    history, least_accel = [], 0.0
    for tick in range(round(seconds / TICK_S)):
        t_s = tick * TICK_S
        ahead = [first(t_s), *((state[0] - length, state[1]) for state in states[:-1])]
        moved = []
        for state, home_m, (rear_m, other_v) in zip(states, cells_s, ahead, strict=True):
            jerk = hold_law(state, body(home_m + SPEED_MPS * t_s), limits, TICK_S)
            near = [(rear_m - state[0], other_v)]
            jerk = keep_gap(state, jerk, near, limits, MIN_GAP_M, TICK_S)
            moved.append(integrate(state, jerk, TICK_S))
        states = moved
        rears = [first(t_s + TICK_S)[0], *(state[0] - length for state in states[:-1])]
        history.append([rear_m - state[0] for rear_m, state in zip(rears, states, strict=True)])
        least_accel = min(least_accel, *(state[2] for state in states))
    return history, states, least_accel


def at_speed(v_mps: float) -> Motion:
    return lambda t_s: (200.0 + v_mps * t_s, v_mps)


def braking(decel_mps2: float, to_mps: float = 0.0) -> Motion:
    """Drive at v_F, brake at once and without any jerk limit, go on at another speed."""

    def motion(t_s: float) -> tuple[float, float]:
        braked_s = min(t_s, (SPEED_MPS - to_mps) / decel_mps2)
        v_mps = SPEED_MPS - decel_mps2 * braked_s
        way_m = SPEED_MPS * braked_s - decel_mps2 * braked_s**2 / 2
        return 200.0 + way_m + to_mps * (t_s - braked_s), v_mps

    return motion


def least(history: list[list[float]]) -> float:
    return min(map(min, history))


def test_stops_behind_a_stopped_vehicle() -> None:
    history, (end,), least_accel = row(at_speed(0.0), [100.0])
    assert least(history) >= MIN_GAP_M - SHORT_M
    assert history[-1] == pytest.approx([MIN_GAP_M], abs=0.2)
    assert end[1] == pytest.approx(0.0, abs=0.05)
    assert least_accel >= COMFORT - 1e-9


WEAK = evolve(LIMITS, min_accel_mps2=-4.0, max_jerk_mps3=3.0)


@pytest.mark.parametrize("limits", [LIMITS, WEAK], ids=["default", "weak"])
@pytest.mark.parametrize("v_mps", [1.0, 5.33, 12.0])
def test_stops_in_time_though_it_was_speeding_up(limits: Vehicle, v_mps: float) -> None:
    """It is behind its cell and accelerates, more or less, when it has to begin to brake."""
    for gap_m in np.arange(45.0, 110.0, 2.5):
        history, _, _ = row(at_speed(0.0), [float(gap_m)], v_mps=v_mps, limits=limits)
        assert least(history) >= MIN_GAP_M - SHORT_M


@given(
    gap_m=st.floats(0.0, 150.0),
    other_mps=st.floats(0.0, 20.0),
    v_mps=st.floats(0.0, 20.0),
)
@examples(150)
def test_never_hits_the_vehicle_ahead_where_that_can_be_avoided(
    gap_m: float, other_mps: float, v_mps: float
) -> None:
    """From a gap that is enough for the vehicle's braking, which takes 0.4 s to build up."""
    needed_m = 0.4 * v_mps + (v_mps**2 - other_mps**2) / (2 * -COMFORT)
    gap_m += MIN_GAP_M + max(needed_m, 0.0)
    history, _, least_accel = row(at_speed(other_mps), [gap_m], v_mps=v_mps)
    assert least(history) >= MIN_GAP_M - SHORT_M
    assert least_accel >= COMFORT - 1e-9


@pytest.mark.parametrize("gap_m", [10.0, MIN_GAP_M])
def test_a_row_at_equal_speed_stays_as_it_is(gap_m: float) -> None:
    history, states, _ = row(at_speed(SPEED_MPS), [gap_m] * 6)
    for gaps in history:
        assert gaps == pytest.approx([gap_m] * 6, abs=1e-6)
    for state in states:
        assert state[1:3] == pytest.approx((SPEED_MPS, 0.0), abs=1e-6)


@pytest.mark.parametrize(("decel_mps2", "to_mps"), [(2.0, 0.0), (6.0, 0.0), (6.0, 8.0)])
def test_a_row_is_safe_behind_a_vehicle_that_brakes_as_they_do(
    decel_mps2: float, to_mps: float
) -> None:
    history, states, least_accel = row(braking(decel_mps2, to_mps), [10.0] * 6)
    assert least(history) >= MIN_GAP_M - SHORT_M
    assert least_accel >= COMFORT - 1e-9
    for state in states:
        assert state[1] == pytest.approx(to_mps, abs=0.1)


def test_a_row_does_not_hit_a_vehicle_that_brakes_as_hard_as_possible() -> None:
    """Its first vehicle comes closer than it wants to; the others need not."""
    history, _, _ = row(braking(-LIMITS.min_accel_mps2), [18.0, 10.0, 10.0])
    firsts, *others = zip(*history, strict=True)
    assert 0.0 < min(firsts) < MIN_GAP_M
    assert min(map(min, others)) >= MIN_GAP_M - SHORT_M


def test_a_vehicle_that_is_too_close_falls_back() -> None:
    history, (end,), _ = row(at_speed(SPEED_MPS), [1.0], seconds=30.0)
    gaps = [gaps[0] for gaps in history]
    assert min(gaps) > 0.99
    assert gaps[-1] == pytest.approx(MIN_GAP_M, abs=0.3)
    assert end[1] == pytest.approx(SPEED_MPS, abs=0.1)


def test_without_a_vehicle_ahead_nothing_changes() -> None:
    state = body(0.0, 12.0)
    jerk = hold_law(state, body(3.0), LIMITS, TICK_S)
    assert keep_gap(state, jerk, (), LIMITS, MIN_GAP_M, TICK_S) == jerk
    assert keep_gap(state, jerk, [(100.0, 15.0)], LIMITS, MIN_GAP_M, TICK_S) == jerk


def test_the_nearest_of_several_counts() -> None:
    state, wanted = body(0.0), (0.0, 0.0)
    one = keep_gap(state, wanted, [(8.0, 5.0)], LIMITS, MIN_GAP_M, TICK_S)
    assert one[0] < 0.0
    for ahead in ([(8.0, 5.0), (80.0, 15.0)], [(80.0, 15.0), (8.0, 5.0)]):
        assert keep_gap(state, wanted, ahead, LIMITS, MIN_GAP_M, TICK_S) == one


@pytest.mark.parametrize(
    ("along_m", "across_m", "at_rest"),
    [
        (0.0, 0.0, True),
        (0.9 * ARRIVED_ALONG_M, -0.9 * ARRIVED_ACROSS_M, True),
        (-0.9 * ARRIVED_ALONG_M, 0.9 * ARRIVED_ACROSS_M, True),
        (1.1 * ARRIVED_ALONG_M, 0.0, False),
        (-1.1 * ARRIVED_ALONG_M, 0.0, False),
        (0.0, 1.1 * ARRIVED_ACROSS_M, False),
        (0.0, -1.1 * ARRIVED_ACROSS_M, False),
    ],
)
def test_at_rest_is_close_to_the_target(along_m: float, across_m: float, *, at_rest: bool) -> None:
    cell, t_s = (-3, 2), 17.0
    s, v, a, y, v_y, a_y = cell_state(LATTICE, cell, t_s)
    state = (s + along_m, v, a, y + across_m, v_y, a_y)
    assert at_rest_in_cell(state, LATTICE, cell, t_s) == at_rest


@pytest.mark.parametrize(
    ("ahead_m", "slower_mps", "nearly"),
    [
        (0.0, 0.0, True),
        (5.9, 0.9 * NEARLY_SETTLED_MPS, True),
        (6.1, 0.0, False),
        (-1.1 * ARRIVED_ALONG_M, 0.0, False),
        (3.0, 1.1 * NEARLY_SETTLED_MPS, False),
        (3.0, -1.0, False),
    ],
)
def test_a_body_that_settles_is_ready_before_it_is_in_its_cell(
    ahead_m: float, slower_mps: float, *, nearly: bool
) -> None:
    s, v, a, y, v_y, a_y = cell_state(LATTICE, (-3, 2), 17.0)
    state = (s + ahead_m, v - slower_mps, a, y, v_y, a_y)
    assert nearly_settled(state, LATTICE, (-3, 2), 17.0, 6.0) == nearly
    assert not nearly_settled((s, v, a, y + 0.5, v_y, a_y), LATTICE, (-3, 2), 17.0, 6.0)


def test_a_body_with_room_ahead_is_displaced_farther_ahead_only() -> None:
    s, *others = cell_state(LATTICE, (-3, 2), 17.0)

    def out(along_m: float, room_ahead_m: float) -> bool:
        return displaced((s + along_m, *others), LATTICE, (-3, 2), 17.0, room_ahead_m)  # type: ignore[arg-type]

    assert [out(along_m, 0.0) for along_m in (-1.1, -0.9, 0.9, 1.1)] == [True, False, False, True]
    assert [out(along_m, 6.0) for along_m in (-1.1, -0.9, 5.9, 6.1)] == [True, False, False, True]


def moving_back(before_s: float) -> Motion:
    """Hold the cell two columns ahead, then move into the next one, as a plan may ask for."""

    def motion(t_s: float) -> tuple[float, float]:
        move_s = SCENARIO.timing.move_s
        share = min(max((t_s - before_s) / move_s, 0.0), 1.0)
        way = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        speed = 30.0 * share**2 * (1.0 - share) ** 2 / move_s
        s_m = 200.0 + SPEED_MPS * t_s - LATTICE.pitch_m * way
        return s_m, SPEED_MPS - LATTICE.pitch_m * speed

    return motion


def test_a_vehicle_that_yields_to_a_planned_move_stays_in_its_cell() -> None:
    """It sees the other one brake, cannot know that this ends a pitch ahead, and yields for a time.

    Its body stays in its cell all the same (assumption 3 of docs/SAFETY.md), and so do the bodies
    of those behind it.
    """
    between_m = LATTICE.pitch_m - LIMITS.length_m
    first_m, _ = (move := moving_back(2.0))(0.0)
    history, states, _ = row(move, [LATTICE.pitch_m + between_m, between_m, between_m])
    for tick, gaps in enumerate(history, start=1):
        rear_m, _ = move(tick * TICK_S)
        for column, gap_m in enumerate(gaps, start=2):
            front_m = rear_m - gap_m
            home_m = first_m + LIMITS.length_m - column * LATTICE.pitch_m
            assert abs(home_m + SPEED_MPS * tick * TICK_S - front_m) < 0.5 * between_m
            rear_m = front_m - LIMITS.length_m
    assert min(gaps[0] for gaps in history) > 0.5 * between_m
    assert history[-1] == pytest.approx([between_m] * 3, abs=0.2)
    assert all(state[1] == pytest.approx(SPEED_MPS, abs=0.05) for state in states)
