"""`laneweave bench tracker`."""

from __future__ import annotations

import importlib
import json
from typing import Any

import numpy as np
import pytest

from laneweave.agents.driving.tracker import Tracker
from laneweave.launch.bench import tracker as tracker_bench
from laneweave.launch.bench.tracker import (
    NO_DAQP,
    Condensed,
    LqSolver,
    bench_tracker,
    solvers,
    tracker_table,
)
from laneweave.launch.bench.tracker_problems import FAMILIES, Recording, record
from laneweave.launch.cli.bench_command import measure_tracker
from laneweave.protocol.scenario.tables import Scenario

SCENARIO = Scenario()


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(SCENARIO, instances=1, seed=3)


def test_every_family_and_solver_gets_a_row() -> None:
    rows = bench_tracker(SCENARIO, instances=1, seed=3, repeats=1)
    names = list(dict.fromkeys(row["solver"] for row in rows))
    assert names == ["tracker", "no-shortcut", "osqp", "daqp", "lq"]
    assert [(row["family"], row["solver"]) for row in rows] == [
        (family, name) for family in FAMILIES for name in names
    ]
    for row in rows:
        if "missing" in row:
            continue
        assert row["problems"] > 10
        assert 0 < row["cpu_ms"]["p50"] <= row["cpu_ms"]["p99"] <= row["cpu_ms"]["max"]
        if row["solver"] != "lq":
            assert row["solved_share"] == 1.0
            assert row["first_jerk_difference_mps3"]["p99"] < 0.3
    assert tracker_table(rows).row_count == len(rows)


def test_recordings_repeat(recording: Recording) -> None:
    again = record(SCENARIO, instances=1, seed=3)
    for ours, theirs in zip(recording.episodes, again.episodes, strict=True):
        assert [p.jerk.tobytes() for p in ours] == [p.jerk.tobytes() for p in theirs]
        assert [p.state for p in ours] == [p.state for p in theirs]


def test_a_program_says_what_the_tracker_was_asked(recording: Recording) -> None:
    """Its rows hold for the recorded state: the dynamics lead from there to the same states."""
    condensed = Condensed.of(recording.parts)
    parts = recording.parts
    for problem in (episode[5] for episode in recording.episodes):
        at_rest = np.zeros(parts.jerks + parts.jerks // 2)
        states = condensed.drift @ problem.lower[: parts.states] + condensed.drive @ at_rest
        values = parts.rows @ np.concatenate([states, at_rest])
        np.testing.assert_allclose(values[: parts.states], problem.lower[: parts.states], atol=1e-9)
        tracker = Tracker(SCENARIO)
        tracker.solve(problem.state, problem.window, problem.gaps)
        _, _, lower, upper = tracker.last_program()
        assert lower.tobytes() == problem.lower.tobytes()
        assert upper.tobytes() == problem.upper.tobytes()


def test_solvers_agree(recording: Recording) -> None:
    ways = solvers(SCENARIO, recording.parts)
    if ways["daqp"] is None:
        pytest.skip(f"daqp is {NO_DAQP}")
    for episode in recording.episodes:
        for way in ways.values():
            assert way is not None
            way.reset()
        for problem in episode:
            off = {}
            for name, way in ways.items():
                assert way is not None
                answer = way.solve(way.prepare(problem))
                off[name] = float(np.abs(answer.first - problem.first).max())
                if isinstance(way, LqSolver) and not way.keeps_rows(problem):
                    # Then it is the answer to another problem.
                    del off[name]
            assert off["daqp"] < 1e-6
            assert off["osqp"] < 0.1
            assert off.get("lq", 0.0) < 0.1


def test_without_daqp_the_rest_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def absent(name: str) -> Any:  # noqa: ANN401
        if name == "daqp":
            raise ModuleNotFoundError(name=name)
        return importlib.import_module(name)

    monkeypatch.setattr(tracker_bench, "import_module", absent)
    measure_tracker(1, 3).show(as_json=True)
    shown = json.loads(capsys.readouterr().out)
    rows = shown["results"]
    assert {row["missing"] for row in rows if row["solver"] == "daqp"} == {NO_DAQP}
    assert all("cpu_ms" in row for row in rows if row["solver"] != "daqp")
    assert shown["goals"]["cpu_ms"] == {"p50": 0.2, "p99": 1.0, "max": 4.0}
    assert tracker_table(rows).row_count == len(rows)
