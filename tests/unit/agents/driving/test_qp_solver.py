"""The wrapper around OSQP: what it accepts, what it returns, what it forgets."""

from __future__ import annotations

import os
import signal
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from laneweave.agents.driving.qp_solver import QPScale, QPSettings, QuadraticProgram
from support.examples import examples

TIGHT = QPSettings(eps_abs=1e-8, max_iter=4000, tolerance=1e-6)


def box(n: int = 3, settings: QPSettings = TIGHT) -> QuadraticProgram:
    """Project zero onto a box: the solution is the nearest point of [lower, upper]."""
    eye = sparse.eye(n, format="csc")
    return QuadraticProgram(eye, eye, -np.ones(n), np.ones(n), settings=settings)


def infeasible() -> QuadraticProgram:
    """Set up x free, rows x <= 1 and x >= -1; a caller can make both contradict."""
    rows = sparse.csc_matrix(np.array([[1.0], [1.0]]))
    return QuadraticProgram(
        sparse.eye(1, format="csc"),
        rows,
        np.array([-np.inf, -1.0]),
        np.array([1.0, np.inf]),
        settings=TIGHT,
    )


@examples(60)
@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=6))
def test_solves_projections_onto_boxes(entries: list[tuple[float, float]]) -> None:
    lower, upper = np.sort(np.array(entries)).T.copy()
    program = box(len(entries))
    program.update(lower, upper)
    result = program.solve()
    assert result.usable
    assert result.violation <= 1e-6
    np.testing.assert_allclose(result.x, np.clip(0.0, lower, upper), atol=1e-5)


def test_uses_both_triangles_and_coupling_of_the_cost() -> None:
    cost = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, -1.0], [0.0, -1.0, 2.0]])
    lower, upper = np.array([1.0, -np.inf, -np.inf]), np.array([1.0, np.inf, np.inf])
    program = QuadraticProgram(
        sparse.csc_matrix(cost), sparse.eye(3, format="csc"), lower, upper, TIGHT
    )
    result = program.solve()
    assert result.usable
    others = np.linalg.solve(cost[1:, 1:], -cost[1:, 0])
    np.testing.assert_allclose(result.x, [1.0, *others], atol=1e-6)


def test_scales_change_neither_the_solution_nor_what_violates_a_row() -> None:
    cost = sparse.csc_matrix(np.array([[4.0, 1.0], [1.0, 3.0]]))
    rows = sparse.csc_matrix(np.array([[1.0, 1.0], [1.0, -2.0], [0.0, 1.0]]))
    lower, upper = np.array([1.0, -np.inf, -1.0]), np.array([1.0, 0.5, np.inf])
    scale = QPScale(np.array([20.0, 0.4, 1e-2]), np.array([0.3, 7.0]))
    plain = QuadraticProgram(cost, rows, lower, upper, TIGHT)
    scaled = QuadraticProgram(cost, rows, lower, upper, TIGHT, scale)
    for _ in range(2):
        expected, result = plain.solve(), scaled.solve()
        assert result.usable
        np.testing.assert_allclose(result.x, expected.x, atol=1e-5)
        upper = upper - (0.0, 0.7, 0.0)
        plain.update(lower, upper)
        scaled.update(lower, upper)
    short = QPSettings(eps_abs=1e-9, max_iter=1, check_termination=1)
    unfinished = QuadraticProgram(cost, rows, lower, upper, short, scale).solve()
    values = rows @ unfinished.x
    violation = max((values - upper).max(), (lower - values).max())
    assert unfinished.violation == pytest.approx(violation, abs=1e-12)


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_scales_that_are_not_positive_raise(bad: float) -> None:
    eye, ones = sparse.eye(2, format="csc"), np.ones(2)
    for scale in (QPScale(np.array([1.0, bad]), ones), QPScale(ones, np.array([bad, 1.0]))):
        with pytest.raises(ValueError, match="positive"):
            QuadraticProgram(eye, eye, -ones, ones, scale=scale)
    with pytest.raises(ValueError, match="constraint scale"):
        QuadraticProgram(eye, eye, -ones, ones, scale=QPScale(np.ones(3), ones))


def test_infinite_bounds_are_allowed_on_their_own_side() -> None:
    program = box()
    program.update(np.array([-np.inf, 2.0, -np.inf]), np.array([np.inf, np.inf, -3.0]))
    result = program.solve()
    assert result.usable
    np.testing.assert_allclose(result.x, [0.0, 2.0, -3.0], atol=1e-5)


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ([0.0, 0.0, NAN], [1.0, 1.0, 1.0]),
        ([0.0, 0.0, 0.0], [1.0, NAN, 1.0]),
        ([NAN, 0.0, 0.0], [NAN, 1.0, 1.0]),
        ([0.0, 2.0, 0.0], [1.0, 1.0, 1.0]),
        ([INF, 0.0, 0.0], [INF, 1.0, 1.0]),
        ([-INF, 0.0, 0.0], [-INF, 1.0, 1.0]),
        ([0.0, 0.0], [1.0, 1.0]),
        ([0.0], [1.0]),
        ([0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]),
        ([[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]),
    ],
)
def test_refuses_bad_vectors_and_stays_as_it_was(
    lower: list[float], upper: list[float], capfd: pytest.CaptureFixture[str]
) -> None:
    program, twin = box(), box()
    for each in (program, twin):
        each.update(np.array([0.5, -1.0, -2.0]), np.array([1.0, -0.5, 2.0]))
    with pytest.raises(ValueError, match="bounds"):
        program.update(np.array(lower), np.array(upper))
    result, expected = program.solve(), twin.solve()
    assert result.usable
    assert result.violation == expected.violation
    assert result.x.tobytes() == expected.x.tobytes()
    assert capfd.readouterr() == ("", "")


def test_refuses_bad_matrices() -> None:
    eye = sparse.eye(2, format="csc")
    zero = np.zeros(2)
    with pytest.raises(ValueError, match="cost"):
        QuadraticProgram(sparse.eye(3, format="csc"), eye, zero, zero)
    with pytest.raises(ValueError, match="constraints has entries"):
        QuadraticProgram(eye, eye * np.inf, zero, zero)
    with pytest.raises(ValueError, match="constraint 0"):
        QuadraticProgram(eye, eye, zero + 1.0, zero)


def test_infeasible_program_is_not_usable_and_leaves_nothing_behind(
    capfd: pytest.CaptureFixture[str],
) -> None:
    program, fresh = infeasible(), infeasible()
    program.update(np.array([-np.inf, 5.0]), np.array([1.0, np.inf]))
    result = program.solve()
    assert not result.usable
    assert result.status == 3
    assert result.violation == float("inf")

    bounds = np.array([-np.inf, 0.25]), np.array([1.0, np.inf])
    program.update(*bounds)
    fresh.update(*bounds)
    after, expected = program.solve(), fresh.solve()
    assert after.usable
    np.testing.assert_allclose(after.x, [0.25], atol=1e-6)
    np.testing.assert_allclose(after.x, expected.x, atol=1e-6)
    assert capfd.readouterr() == ("", "")


def test_reset_forgets_everything_when_rho_is_fixed() -> None:
    fixed = QPSettings(rho=0.3, adaptive_rho_interval=0)
    used, fresh = box(settings=fixed), box(settings=fixed)
    used.update(np.full(3, 3.0), np.full(3, 9.0))
    used.solve()
    used.reset()
    bounds = np.array([0.5, -1.0, -2.0]), np.array([1.0, -0.5, 2.0])
    for each in (used, fresh):
        each.update(*bounds)
    after, expected = used.solve(), fresh.solve()
    assert after.iterations == expected.iterations
    assert after.x.tobytes() == expected.x.tobytes()


def test_warm_start_saves_iterations() -> None:
    rng = np.random.default_rng(4)
    factor = rng.normal(size=(20, 20))
    program = QuadraticProgram(
        sparse.csc_matrix(factor @ factor.T + np.eye(20)),
        sparse.eye(20, format="csc"),
        rng.uniform(0.1, 0.2, size=20),
        np.full(20, np.inf),
        QPSettings(eps_abs=1e-6, max_iter=4000),
    )
    assert program.solve().iterations > program.solve().iterations


def test_out_of_iterations_counts_only_within_the_row_tolerance() -> None:
    """One iteration is not enough for anything; what it left behind decides."""
    lower, upper = np.full(3, 5.0), np.full(3, 6.0)
    results = {}
    for tolerance in (1e-9, 1e9):
        hasty = QPSettings(eps_abs=1e-12, max_iter=1, check_termination=1, tolerance=tolerance)
        program = box(settings=hasty)
        program.update(lower, upper)
        results[tolerance] = program.solve()
    strict, lax = results[1e-9], results[1e9]
    assert strict.status == lax.status
    assert strict.status != 1
    assert not strict.usable
    assert lax.usable == (lax.status in (2, 7))
    expected = np.max(np.maximum(lower - lax.x, lax.x - upper))
    assert lax.violation == pytest.approx(max(expected, 0.0))


def test_an_interrupt_during_a_solve_is_not_lost() -> None:
    """OSQP catches SIGINT while it works, and only stops; a long solve makes sure of that."""
    endless = QPSettings(eps_abs=1e-300, max_iter=2_000_000_000, tolerance=1e-6)
    program = box(200, settings=endless)
    program.update(np.linspace(-1.0, 5.0, 200) / 3.0, np.full(200, 6.0))
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        program.solve()
    timer.join()
