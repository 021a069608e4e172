"""The tracker's shortcut is the program's solution, and gaps on both sides are kept."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest
from attrs import evolve, frozen
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg

from laneweave.agents.driving import tracking_problem as program_module
from laneweave.agents.driving.reference import Reference, Window
from laneweave.agents.driving.regulator import (
    JERK_WEIGHT,
    LATERAL_WEIGHTS,
    WEIGHTS,
    axis_matrices,
)
from laneweave.agents.driving.tracker import Tracker, TrackResult
from laneweave.agents.driving.tracking_problem import Gaps
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State, cell_state, integrate

SCENARIO = Scenario()
LIMITS, LATTICE, TICK_S = SCENARIO.vehicle, SCENARIO.lattice, SCENARIO.runtime.tick_s
N = SCENARIO.timing.horizon_ticks
SHORTCUT = evolve(SCENARIO, tracking=evolve(SCENARIO.tracking, shortcut=True))
TIMES_S = TICK_S * np.arange(N + 1)
MOVES = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
SPREAD = (0.25, 0.2, 0.3, 0.08, 0.08, 0.1)
"""Of the errors of half of the problems; the other half has ten times as much."""


@frozen(eq=False)
class Problem:
    state: State
    window: Window
    gaps: Gaps


def problems(count: int, seed: int = 2) -> Iterator[Problem]:
    rng = random.Random(seed)
    for number in range(count):
        dx, dy = rng.choice(MOVES)
        reference = Reference.move(SCENARIO, LIMITS, (0, 1), (dx, 1 + dy), 0)
        window = reference.window(rng.randrange(-5, 45))
        scale = 10.0 if number % 2 else 1.0
        state = tuple(
            now + rng.gauss(0.0, scale * each)
            for now, each in zip(window.states[0].tolist(), SPREAD, strict=True)
        )
        yield Problem(state, window, random_gaps(rng, window, scale))


def random_gaps(rng: random.Random, window: Window, scale: float) -> Gaps:
    """Return gaps that the reference keeps, so that it need not yield."""
    sides = rng.choice(("", "", "ahead", "behind", "both"))
    s = window.states[:, 0]
    play = scale * np.abs(rng.gauss(0.0, 0.6)) + rng.uniform(0.0, 0.2) * TIMES_S
    latest = s + play if sides in {"ahead", "both"} else None
    earliest = s - play - rng.uniform(0.0, 1.0) if sides in {"behind", "both"} else None
    return Gaps(earliest, latest)


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> Tracker:
    """Return a tracker with tight tolerances."""
    tight = evolve(program_module.SETTINGS, eps_abs=1e-7, max_iter=20_000, tolerance=1e-3)
    monkeypatch.setattr(program_module, "SETTINGS", tight)
    return Tracker(SCENARIO, LIMITS)


def states_of(problem: Problem, result: TrackResult) -> np.ndarray:
    """Return the states (N, 6) that follow from a plan."""
    state, way = problem.state, []
    for along, across in result.jerk.tolist():
        state = integrate(state, (along, across), TICK_S)
        way.append(state)
    return np.array(way)


def least_slack(problem: Problem, result: TrackResult) -> float:
    """Return the least distance to a limit or gap; negative: it is violated."""
    s, v, a, _, v_y, a_y = states_of(problem, result).T
    slacks = [
        v, LIMITS.max_speed_mps - v, a - LIMITS.min_accel_mps2, LIMITS.max_accel_mps2 - a,
        LIMITS.max_lateral_accel_mps2 - np.abs(a_y), LIMITS.max_slip_ratio * v - np.abs(v_y),
        LIMITS.max_jerk_mps3 - np.abs(result.jerk[:, 0]),
        LIMITS.max_lateral_jerk_mps3 - np.abs(result.jerk[:, 1]),
    ]  # fmt: skip
    if problem.gaps.latest is not None:
        slacks.append(problem.gaps.latest[1:] - s)
    if problem.gaps.earliest is not None:
        slacks.append(s - problem.gaps.earliest[1:])
    return min(float(slack.min()) for slack in slacks)


def regulated(problem: Problem) -> np.ndarray:
    """Return the jerks (N, 2) of the linear-quadratic regulator, from scipy's Riccati equation."""
    transition, effect = axis_matrices(TICK_S)
    jerks = problem.window.jerks.copy()
    error = np.array(problem.state) - problem.window.states[0]
    for axis, weights in enumerate((WEIGHTS, LATERAL_WEIGHTS)):
        weight = np.array([[JERK_WEIGHT]])
        cost = linalg.solve_discrete_are(transition, effect, weights, weight)
        gain = np.linalg.solve(weight + effect.T @ cost @ effect, effect.T @ cost @ transition)
        now = error[3 * axis : 3 * axis + 3]
        for k in range(N):
            correction = -gain @ now
            jerks[k, axis] += correction[0]
            now = transition @ now + effect @ correction
    return jerks


@pytest.mark.more
@pytest.mark.slow
def test_the_shortcut_gives_the_programs_solution_where_no_row_binds(exact: Tracker) -> None:
    fast, usual = Tracker(SHORTCUT, LIMITS), Tracker(SCENARIO, LIMITS)
    taken, refused = 0, 0
    for problem in problems(200):
        result = fast.solve(problem.state, problem.window, problem.gaps)
        free = evolve(result, jerk=regulated(problem))
        slack = least_slack(problem, free)
        if result.iterations == 0:
            taken += 1
            assert result.usable
            assert slack >= -1e-6
            np.testing.assert_allclose(result.jerk, free.jerk, atol=1e-4)
            solved = usual.solve(problem.state, problem.window, problem.gaps)
            assert solved.iterations == 1
            np.testing.assert_allclose(result.jerk, solved.jerk, atol=1e-3)
            if taken % 6:
                continue  # tight tolerances take their time
            expected = exact.solve(problem.state, problem.window, problem.gaps)
            assert expected.usable
            assert expected.iterations > 0
            np.testing.assert_allclose(result.jerk, expected.jerk, atol=5e-3)
        else:
            refused += 1
            assert slack < 1e-6
    assert min(taken, refused) >= 40


@pytest.mark.parametrize(
    "change",
    [
        (0.0, 0.0, 0.0, 0.0, 0.0, 2.6),
        (0.0, 0.0, 4.8, 0.0, 0.0, 0.0),
        (-7.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 3.9, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 2.0, 0.0, 0.0),
    ],
)
def test_the_shortcut_is_not_taken_where_a_limit_binds(change: tuple[float, ...]) -> None:
    window = Reference.hold(SCENARIO, LIMITS, (0, 1)).window(0)
    state = tuple(a + b for a, b in zip(cell_state(LATTICE, (0, 1), 0.0), change, strict=True))
    assert Tracker(SHORTCUT, LIMITS).solve(state, window).iterations > 1  # type: ignore[arg-type]


# --- gaps -----------------------------------------------------------------------------------------


def at_rest() -> tuple[State, Window]:
    return cell_state(LATTICE, (0, 1), 0.0), Reference.hold(SCENARIO, LIMITS, (0, 1)).window(0)


def first_metres(gaps: Gaps, ticks: int = 15) -> float:
    """Return how far it gets ahead of its reference in some ticks."""
    state, window = at_rest()
    result = Tracker(SCENARIO, LIMITS).solve(state, window, gaps)
    assert result.usable
    problem = Problem(state, window, gaps)
    return float(states_of(problem, result)[ticks - 1, 0] - window.states[ticks, 0])


def test_vehicles_behind_push_but_not_far() -> None:
    state, window = at_rest()
    s = window.states[:, 0]
    assert abs(first_metres(Gaps(earliest=s - 0.5))) < 1e-3
    assert first_metres(Gaps(earliest=s + 0.8)) > 0.3
    one, far = (
        Tracker(SCENARIO, LIMITS).solve(state, window, Gaps(earliest=s + by)) for by in (1.0, 9.0)
    )
    assert (one.jerk == far.jerk).all()
    assert first_metres(Gaps(earliest=s + 9.0), N) < 1.1


def test_gaps_ahead_take_precedence_over_gaps_behind() -> None:
    state, window = at_rest()
    s = window.states[:, 0]
    alone = Tracker(SCENARIO, LIMITS).solve(state, window, Gaps(latest=s - 1.5))
    squeezed = Tracker(SCENARIO, LIMITS).solve(
        state, window, Gaps(earliest=s + 0.9, latest=s - 1.5)
    )
    assert squeezed.usable
    assert squeezed.jerk[0, 0] < -0.5
    problem = Problem(state, window, Gaps())
    ends = [states_of(problem, result)[-1, 0] - s[-1] for result in (alone, squeezed)]
    assert max(ends) < -1.0


def test_gaps_on_both_sides_are_kept_where_possible() -> None:
    _, window = at_rest()
    s = window.states[:, 0]
    assert first_metres(Gaps(earliest=s + 0.2, latest=s + 0.7), N) == pytest.approx(0.2, abs=0.1)


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 6),
    st.sampled_from([(0, 0), (-40, 1), (7, 2)]),
    st.integers(0, 4000),
)
def test_at_rest_the_jerks_are_the_same_without_the_program(
    shares: tuple[float, ...], cell: tuple[int, int], tick: int
) -> None:
    """Whatever the errors for which rows are not looked at: none of them binds."""
    tracker = Tracker(SHORTCUT, LIMITS)
    goal = cell_state(LATTICE, cell, tick * TICK_S)
    state: State = tuple(  # type: ignore[assignment]
        at + 0.999 * share * most
        for at, share, most in zip(goal, shares, tracker.unconstrained_errors, strict=True)
    )
    quick = tracker.rest(state, goal)
    whole = tracker.solve(state, Reference.hold(SCENARIO, LIMITS, cell).window(tick))
    assert quick is not None
    assert whole.iterations == 0
    np.testing.assert_allclose(quick.jerk, whole.jerk, atol=1e-9)


def test_a_vehicle_farther_from_its_cell_is_not_at_rest() -> None:
    tracker = Tracker(SHORTCUT, LIMITS)
    goal = cell_state(LATTICE, (0, 0), 0.0)
    for axis, most in enumerate(tracker.unconstrained_errors):
        state = tuple(at + 1.01 * most * (index == axis) for index, at in enumerate(goal))
        assert tracker.rest(state, goal) is None  # type: ignore[arg-type]
