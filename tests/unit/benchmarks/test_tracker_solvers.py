"""`benchmarks/tracker_solvers.py`: all solvers solve the same recorded programs."""

from __future__ import annotations

import numpy as np
import pytest

from laneweave.agents.driving.tracker import Tracker
from laneweave.protocol.scenario.fields import Scenario
from tracker_solvers import (
    FAMILIES,
    Condensed,
    LqSolver,
    Recording,
    compare,
    record,
    solvers,
)

SCENARIO = Scenario()


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(SCENARIO, instances=1, seed=3)


@pytest.mark.slow
@pytest.mark.more
def test_every_family_and_solver_gets_a_row() -> None:
    rows = compare(SCENARIO, instances=1, seed=3, repeats=1)
    names = list(dict.fromkeys(row["solver"] for row in rows))
    assert names == ["tracker", "shortcut", "osqp", "daqp", "lq"]
    assert [(row["family"], row["solver"]) for row in rows] == [
        (family, name) for family in FAMILIES for name in names
    ]
    for row in rows:
        assert row["problems"] > 10
        assert 0 < row["cpu_ms"]["p50"] <= row["cpu_ms"]["p99"] <= row["cpu_ms"]["max"]
        if row["solver"] != "lq":
            assert row["solved_share"] == 1.0
            assert row["first_jerk_difference_mps3"]["p99"] < 0.3


@pytest.mark.more
@pytest.mark.slow
def test_a_recorded_program_is_that_of_its_tick(recording: Recording) -> None:
    """The dynamics' bounds lead from the recorded state to the predicted states."""
    condensed, parts = Condensed.of(recording.parts), recording.parts
    for problem in (episode[5] for episode in recording.episodes):
        no_input = np.zeros(parts.jerks + parts.jerks // 2)
        states = condensed.drift @ problem.lower[: parts.states] + condensed.drive @ no_input
        values = parts.rows @ np.concatenate([states, no_input])
        np.testing.assert_allclose(values[: parts.states], problem.lower[: parts.states], atol=1e-9)
        tracker = Tracker(SCENARIO, SCENARIO.vehicle)
        tracker.solve(problem.state, problem.window, problem.gaps)
        assert tracker.program.low.all.tobytes() == problem.lower.tobytes()
        assert tracker.program.high.all.tobytes() == problem.upper.tobytes()


@pytest.mark.more
@pytest.mark.slow
def test_solvers_agree(recording: Recording) -> None:
    by_name = solvers(SCENARIO, recording.parts)
    for episode in recording.episodes:
        for solver in by_name.values():
            solver.reset()
        for problem in episode:
            off = {}
            for name, solver in by_name.items():
                answer = solver.solve(solver.prepare(problem))
                off[name] = float(np.abs(answer.first - problem.first).max())
                if isinstance(solver, LqSolver) and not solver.keeps_rows(problem):
                    del off[name]  # it solves another problem
            assert off["daqp"] < 1e-6
            assert off["osqp"] < 0.1
            assert off.get("lq", 0.0) < 0.1
