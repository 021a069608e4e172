"""Trajectories and references: limits, exactness, and what is held when."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.agents.driving.reference import (
    InfeasibleTrajectoryError,
    Leg,
    Reference,
    Trajectory,
    Waypoint,
    move_profile,
    plan_trajectory,
)
from laneweave.protocol.config.loading import parse_scenario
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import State, cell_state, integrate

SCENARIO = Scenario()
MOVES = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
TICK_S, N = SCENARIO.runtime.tick_s, SCENARIO.horizon_ticks
MARGIN = 0.97
"""Trajectories use 96 % of each limit; the tests allow a little more."""


def check_exact(states: np.ndarray, jerks: np.ndarray) -> None:
    """Compare each state with the exact integration of the one before."""
    for k in range(len(jerks)):
        now: State = tuple(states[k].tolist())
        following = integrate(now, (jerks[k, 0], jerks[k, 1]), TICK_S)
        np.testing.assert_allclose(states[k + 1], following, atol=1e-9)


def check_limits(trajectory: Trajectory, scenario: Scenario = SCENARIO) -> None:
    limits, v_f = scenario.vehicle, scenario.formation.speed_mps
    _, v, a, _, v_y, a_y = trajectory.states.T
    assert a.max() <= MARGIN * limits.max_accel_mps2
    assert a.min() >= MARGIN * limits.min_accel_mps2
    assert (v + v_f).max() <= limits.max_speed_mps
    assert (v + v_f).min() >= 0.0
    assert np.abs(trajectory.jerks[:, 0]).max() <= MARGIN * limits.max_jerk_mps3
    assert np.abs(trajectory.jerks[:, 1]).max() <= MARGIN * limits.max_lateral_jerk_mps3
    assert np.abs(a_y).max() <= MARGIN * limits.max_lateral_accel_mps2
    assert (np.abs(v_y) <= MARGIN * limits.max_slip_ratio * (v + v_f)).all()


@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_moves_keep_all_limits_and_end_at_rest_in_the_next_cell(dx: int, dy: int) -> None:
    profile = move_profile(SCENARIO, dx, dy)
    assert profile.states.shape == (39, 6)
    assert profile.jerks.shape == (38, 2)
    np.testing.assert_array_equal(profile.states[0], np.zeros(6))
    np.testing.assert_allclose(
        profile.states[-1], [15.0 * dx, 0.0, 0.0, 3.5 * dy, 0.0, 0.0], atol=1e-6
    )
    check_limits(profile)
    check_exact(profile.states, profile.jerks)


@pytest.mark.parametrize(("dx", "dy"), MOVES)
def test_moves_do_not_overshoot(dx: int, dy: int) -> None:
    states = move_profile(SCENARIO, dx, dy).states
    for column, length in ((0, 15.0 * dx), (3, 3.5 * dy)):
        way = states[:, column] * np.sign(length)
        assert way.min() >= -1e-3
        assert way.max() <= abs(length) + 1e-3


def test_a_quintic_would_break_the_limit_that_moves_keep() -> None:
    """The reason for the program: 15 m in 3.8 s as a minimum-jerk quintic."""
    assert SCENARIO.vehicle.max_accel_mps2 < 10.0 / 3.0**0.5 * 15.0 / 3.8**2


def test_move_is_planned_once_per_process() -> None:
    assert move_profile(SCENARIO, 1, -1) is move_profile(Scenario(), 1, -1)
    assert not move_profile(SCENARIO, 1, -1).states.flags.writeable


def test_move_beyond_the_neighbouring_cell_is_refused() -> None:
    with pytest.raises(ValueError, match="neighbouring"):
        move_profile(SCENARIO, 2, 0)


@pytest.mark.parametrize(
    "table",
    [
        {"formation": {"gap_m": 30.0}},
        {"formation": {"cycle_s": 4.0, "move_s": 2.0}},
        {"vehicle": {"max_jerk_mps3": 5.0}},
        {"vehicle": {"max_speed_mps": 16.0}, "formation": {"settle_s": 25.0}},
    ],
)
def test_impossible_moves_raise(table: dict[str, dict[str, float]]) -> None:
    with pytest.raises(InfeasibleTrajectoryError, match=r"15 m|30 m"):
        move_profile(parse_scenario(table), 1, 1)


def test_the_papers_slot_of_four_seconds_is_less_harsh() -> None:
    slow = move_profile(parse_scenario({"formation": {"cycle_s": 4.0, "move_s": 4.0}}), 1, 1)
    fast = move_profile(SCENARIO, 1, 1)
    assert np.square(slow.jerks).sum() < np.square(fast.jerks).sum()


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from(MOVES), min_size=1, max_size=4), st.data())
def test_plans_rest_at_every_waypoint(moves: list[tuple[int, int]], data: st.DataObject) -> None:
    tick, s, y = data.draw(st.integers(-50, 50)), 7.0, 1.75
    points = [Waypoint(tick, s, y)]
    for dx, dy in moves:
        tick, s, y = tick + data.draw(st.integers(38, 60)), s + 15.0 * dx, y + 3.5 * dy
        points.append(Waypoint(tick, s, y))
    plan = plan_trajectory(SCENARIO, points)
    assert plan.ticks == points[-1].tick - points[0].tick
    for point in points:
        np.testing.assert_allclose(
            plan.states[point.tick - points[0].tick],
            [point.position_m, 0.0, 0.0, point.lateral_m, 0.0, 0.0],
            atol=1e-3,
        )
    check_limits(plan)


def test_plan_of_one_leg_obeys_the_dynamics() -> None:
    plan = plan_trajectory(SCENARIO, [Waypoint(0, 0.0, 0.0), Waypoint(90, 40.0, -7.0)])
    check_limits(plan)
    check_exact(plan.states, plan.jerks)


@pytest.mark.parametrize(
    "points",
    [
        [],
        [Waypoint(0, 0.0, 0.0)],
        [Waypoint(5, 0.0, 0.0), Waypoint(5, 1.0, 0.0)],
        [Waypoint(0, 0.0, 0.0), Waypoint(38, float("nan"), 0.0)],
        [Waypoint(0, 0.0, 0.0), Waypoint(2, 1.0, 0.0)],
        [Waypoint(0, 0.0, 0.0), Waypoint(1, 1.0, 0.0)],
    ],
)
def test_bad_plans_raise(points: list[Waypoint]) -> None:
    with pytest.raises(ValueError, match=r".+"):
        plan_trajectory(SCENARIO, points)


def test_reference_before_during_and_after_a_move() -> None:
    origin, target, start = (-3, 0), (-2, 1), 100
    reference = Reference.move(SCENARIO, origin, target, start)
    assert (reference.start_tick, reference.end_tick) == (100, 138)
    profile = move_profile(SCENARIO, 1, 1)
    lattice = SCENARIO.lattice
    n_before = start - N
    for tick in (
        0, n_before - 1, n_before, n_before + 1, 99, 100, 101, 119, 137, 138, 139, 500, 100_000
    ):  # fmt: skip
        window = reference.window(tick)
        assert window.states.shape == (N + 1, 6)
        assert window.jerks.shape == (N, 2)
        for k in range(N + 1):
            n = tick + k
            expected = np.array(cell_state(lattice, origin, n * TICK_S))
            expected += profile.states[min(max(n - start, 0), 38)]
            np.testing.assert_allclose(window.states[k], expected, atol=1e-6)
            if k < N:
                inside = start <= n < start + 38
                jerk = profile.jerks[n - start] if inside else (0.0, 0.0)
                np.testing.assert_array_equal(window.jerks[k], jerk)


def test_reference_of_a_hold() -> None:
    reference = Reference.hold(SCENARIO, (4, 2))
    window = reference.window(-7)
    for k in (0, 40):
        expected = cell_state(SCENARIO.lattice, (4, 2), (k - 7) * TICK_S)
        np.testing.assert_allclose(window.states[k], expected, atol=1e-9)
    assert not window.jerks.any()


def test_reference_of_a_chain_is_exact_and_ends_in_the_last_cell() -> None:
    chain = [(20, (1, 1)), (60, (0, 2)), (98, (0, 1)), (150, (-1, 0))]
    reference = Reference.moves(SCENARIO, (0, 0), chain)
    for tick in range(0, 240, 40):
        window = reference.window(tick)
        check_exact(window.states, window.jerks)
    for tick, cell in ((59, (1, 1)), (98, (0, 2)), (140, (0, 1)), (188, (-1, 0))):
        expected = cell_state(SCENARIO.lattice, cell, tick * TICK_S)
        np.testing.assert_allclose(reference.window(tick).states[0], expected, atol=1e-6)


def test_overlapping_legs_are_refused() -> None:
    with pytest.raises(ValueError, match="begins before"):
        Reference.moves(SCENARIO, (0, 0), [(20, (1, 1)), (57, (2, 2))])
    with pytest.raises(ValueError, match="neighbouring"):
        Reference.moves(SCENARIO, (0, 0), [(20, (1, 1)), (58, (1, 3))])


def test_reference_follows_any_trajectory() -> None:
    plan = plan_trajectory(SCENARIO, [Waypoint(0, 0.0, 0.0), Waypoint(70, 20.0, 3.5)])
    reference = Reference(SCENARIO, (0, 0), [Leg(5, plan)])
    end = reference.window(75).states[0] - cell_state(SCENARIO.lattice, (0, 0), 75 * TICK_S)
    np.testing.assert_allclose(end, [20.0, 0.0, 0.0, 3.5, 0.0, 0.0], atol=1e-6)


def test_windows_do_not_share_states() -> None:
    reference = Reference.hold(SCENARIO, (0, 0))
    reference.window(3).states[:] = -1.0
    assert reference.window(3).states[0, 1] == SCENARIO.formation.speed_mps


def test_window_is_cheap() -> None:
    reference = Reference.move(SCENARIO, (0, 0), (1, 1), 10)
    best = min(_window_time_s(reference) for _ in range(20))
    assert best < 15e-6


def _window_time_s(reference: Reference) -> float:
    start = time.thread_time()
    for tick in range(50):
        reference.window(tick)
    return (time.thread_time() - start) / 50
