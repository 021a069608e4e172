"""Trajectories and references: limits, exactness, and what is held when."""

from __future__ import annotations

import time

import numpy as np
import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.agents.driving.reference import Reference
from laneweave.agents.driving.trajectory import (
    InfeasibleTrajectoryError,
    Trajectory,
    move_profile,
    plan_trajectory,
    settling_trajectory,
)
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State, cell_state, integrate
from support.examples import examples

SCENARIO = Scenario()
MOVES = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
TICK_S, N = SCENARIO.runtime.tick_s, SCENARIO.timing.horizon_ticks
WEAK = evolve(
    SCENARIO,
    formation=evolve(SCENARIO.formation, speed_mps=25.0, gap_m=27.0, change_columns=False),
    vehicle=evolve(SCENARIO.vehicle, max_accel_mps2=2.6, max_speed_mps=36.0),
)
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
def test_moves_keep_all_limits_and_go_straight_to_rest_in_the_next_cell(dx: int, dy: int) -> None:
    profile = move_profile(SCENARIO, SCENARIO.vehicle, dx, dy)
    assert profile.states.shape == (39, 6)
    assert profile.jerks.shape == (38, 2)
    np.testing.assert_array_equal(profile.states[0], np.zeros(6))
    np.testing.assert_allclose(
        profile.states[-1], [15.0 * dx, 0.0, 0.0, 3.5 * dy, 0.0, 0.0], atol=1e-6
    )
    check_limits(profile)
    check_exact(profile.states, profile.jerks)
    for column, length in ((0, 15.0 * dx), (3, 3.5 * dy)):  # no overshoot
        way = profile.states[:, column] * np.sign(length)
        assert way.min() >= -1e-3
        assert way.max() <= abs(length) + 1e-3


def test_move_to_a_neighbouring_cell_is_planned_once_per_process() -> None:
    assert move_profile(SCENARIO, SCENARIO.vehicle, 1, -1) is move_profile(
        Scenario(), Scenario().vehicle, 1, -1
    )
    assert not move_profile(SCENARIO, SCENARIO.vehicle, 1, -1).states.flags.writeable
    with pytest.raises(ValueError, match="neighbouring"):
        move_profile(SCENARIO, SCENARIO.vehicle, 2, 0)


@pytest.mark.parametrize(
    "table",
    [
        {"formation": {"gap_m": 30.0, "cycle_s": 4.0}},
        {"formation": {"cycle_s": 4.0, "move_s": 2.0}},
        {"vehicle": {"max_jerk_mps3": 5.0}},
        {"vehicle": {"max_speed_mps": 16.0}, "formation": {"settle_s": 25.0}},
    ],
)
def test_impossible_moves_raise(table: dict[str, dict[str, float]]) -> None:
    with pytest.raises(InfeasibleTrajectoryError, match=r"15 m|30 m"):
        move_profile(parse_scenario(table), parse_scenario(table).vehicle, 1, 1)


@examples(25)
@given(st.sampled_from(MOVES), st.integers(38, 60))
def test_slower_moves_keep_all_limits_and_end_at_rest(move: tuple[int, int], ticks: int) -> None:
    profile = move_profile(SCENARIO, SCENARIO.vehicle, *move, ticks)
    assert profile.ticks == ticks
    end = [15.0 * move[0], 0.0, 0.0, 3.5 * move[1], 0.0, 0.0]
    np.testing.assert_allclose(profile.states[-1], end, atol=1e-3)
    check_limits(profile)


def planned(ticks: int, ds_m: float, dy_m: float) -> Trajectory:
    speed_mps = SCENARIO.formation.speed_mps
    return plan_trajectory(SCENARIO.vehicle, speed_mps, TICK_S, ticks, ds_m, dy_m)


def test_long_trajectories_obey_the_dynamics() -> None:
    trajectory = planned(90, 40.0, -7.0)
    check_limits(trajectory)
    check_exact(trajectory.states, trajectory.jerks)


@pytest.mark.parametrize(("ticks", "ds_m"), [(38, float("nan")), (2, 1.0), (1, 1.0)])
def test_impossible_trajectories_raise(ticks: int, ds_m: float) -> None:
    with pytest.raises(ValueError, match=r".+"):
        planned(ticks, ds_m, 0.0)


def test_reference_before_during_and_after_a_move() -> None:
    origin, target, start = (-3, 0), (-2, 1), 100
    reference = Reference.move(SCENARIO, SCENARIO.vehicle, origin, target, start)
    assert (reference.start_tick, reference.end_tick) == (100, 138)
    profile = move_profile(SCENARIO, SCENARIO.vehicle, 1, 1)
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
    reference = Reference.hold(SCENARIO, SCENARIO.vehicle, (4, 2))
    window = reference.window(-7)
    for k in (0, 40):
        expected = cell_state(SCENARIO.lattice, (4, 2), (k - 7) * TICK_S)
        np.testing.assert_allclose(window.states[k], expected, atol=1e-9)
    assert not window.jerks.any()
    window.states[:] = -1.0
    assert reference.window(-7).states[0, 1] == SCENARIO.formation.speed_mps  # nothing is shared


def test_reference_follows_any_trajectory() -> None:
    reference = Reference(SCENARIO, SCENARIO.vehicle, (0, 0), planned(70, 20.0, 3.5), 5)
    for tick in range(0, 120, 40):
        window = reference.window(tick)
        check_exact(window.states, window.jerks)
    end = reference.window(75).states[0] - cell_state(SCENARIO.lattice, (0, 0), 75 * TICK_S)
    np.testing.assert_allclose(end, [20.0, 0.0, 0.0, 3.5, 0.0, 0.0], atol=1e-6)


def test_window_is_cheap() -> None:
    reference = Reference.move(SCENARIO, SCENARIO.vehicle, (0, 0), (1, 1), 10)
    best = min(_window_time_s(reference) for _ in range(20))
    assert best < 15e-6


def _window_time_s(reference: Reference) -> float:
    start = time.thread_time()
    for tick in range(50):
        reference.window(tick)
    return (time.thread_time() - start) / 50


# --- settling ---------------------------------------------------------------------------------


def test_a_vehicle_settles_within_its_limits_if_it_has_little_time() -> None:
    """The trajectory of least jerk would exceed them."""
    start = np.array([40.0, -7.5, 0.0, 0.0, 0.0, 0.0])
    ticks = 68
    profile = settling_trajectory(WEAK, WEAK.vehicle, start, ticks)
    np.testing.assert_array_equal(profile.states[0], start)
    np.testing.assert_allclose(profile.states[-1], np.zeros(6), atol=1e-3)
    check_limits(profile, WEAK)
    assert profile.states[:, 0].min() >= -0.5
    unlimited = settling_trajectory(WEAK, evolve(WEAK.vehicle, max_accel_mps2=9.0), start, ticks)
    assert unlimited.states[:, 2].max() > WEAK.vehicle.max_accel_mps2


def test_a_vehicle_without_enough_time_gets_the_trajectory_of_least_jerk() -> None:
    start = np.array([2.0, -7.5, 0.0, 0.0, 0.0, 0.0])
    profile = settling_trajectory(WEAK, WEAK.vehicle, start, 30)
    np.testing.assert_allclose(profile.states[-1], np.zeros(6), atol=1e-6)
    assert profile.states[:, 2].max() > WEAK.vehicle.max_accel_mps2


def settling(cell: Cell, tick: int, end_tick: int) -> Reference:
    """Return the reference of a vehicle that is 60 m ahead of its cell, and slower."""
    s, v, a, y, v_y, a_y = cell_state(WEAK.lattice, cell, tick * TICK_S)
    return Reference.settling(
        WEAK, WEAK.vehicle, cell, (s + 60.0, v - 7.0, a, y, v_y, a_y), tick, end_tick
    )


@pytest.mark.parametrize("left_ticks", [25, 60])
def test_a_vehicle_changes_lanes_while_it_settles(left_ticks: int) -> None:
    """Along the road it goes on settling, also after the move; across it makes the move."""
    cell, target, tick = (4, 0), (4, 1), 100
    end_tick = tick + 80
    before = settling(cell, tick, end_tick)
    begin = end_tick - left_ticks
    move = Reference.move(WEAK, WEAK.vehicle, cell, target, begin)
    plain = Reference.move(WEAK, WEAK.vehicle, cell, target, begin)
    move.settle_meanwhile(before)
    assert move.rest_tick == max(plain.end_tick, end_tick)
    for now in range(begin - 3, move.rest_tick + 5):
        one, old, new = move.window(now), before.window(now), plain.window(now)
        np.testing.assert_allclose(one.states[:, 3:], new.states[:, 3:])
        np.testing.assert_allclose(one.jerks[:, 1], new.jerks[:, 1])
        if now >= begin:
            np.testing.assert_allclose(one.states[:, :3], old.states[:, :3], atol=1e-9)
            np.testing.assert_allclose(one.jerks[:, 0], old.jerks[:, 0])
            check_exact(one.states, one.jerks)
    goal = cell_state(WEAK.lattice, target, (move.rest_tick + 5) * TICK_S)
    np.testing.assert_allclose(move.window(move.rest_tick + 5).states[0], goal, atol=1e-3)


def test_a_settled_vehicle_moves_as_before() -> None:
    before = settling((4, 0), 100, 180)
    move, plain = (Reference.move(WEAK, WEAK.vehicle, (4, 0), (4, 1), 180) for _ in range(2))
    move.settle_meanwhile(before)
    np.testing.assert_array_equal(move.window(185).states, plain.window(185).states)
    assert move.rest_tick == plain.end_tick
