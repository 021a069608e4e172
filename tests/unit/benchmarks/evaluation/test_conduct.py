"""Rounds of the sweep: which runs are repeated, and which seeds begin within a budget."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from evaluation import conduct
from evaluation.conduct import SWEEP_FOLDER, Rounds
from evaluation.programme import points_of
from laneweave.launch.recordings.runs import Run, write_point
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point
from laneweave.protocol.summary import Ending, write_summary
from unit.benchmarks.evaluation.recorded import BASE, summary

LABELS = ("formations", "rule")
VOLUME = 1000.0


def record(
    out: Path, point: Point, ending: Ending | None, reason: str = "", wall_s: float = 60.0
) -> None:
    """Record a run of a point; `ending` None: it has no summary."""
    folder = out / SWEEP_FOLDER / point.name
    with SweepFolder(folder.parent):
        folder.mkdir()
    found = None if ending is None else summary(70.0, ending=ending.value)
    write_point(
        Run(folder, point.label, point.method, point.scenario, found, reason, wall_s), folder
    )
    (folder / "trips.parquet").touch()
    if found is not None:
        write_summary(folder, found)
    if point.keep_trajectories:
        (folder / "trajectories.parquet").touch()


def points(seed: int) -> dict[str, Point]:
    return {
        point.label: point
        for point in points_of(BASE, seed)
        if point.label in LABELS and point.volume_veh_per_lane_h == VOLUME
    }


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the names of points in the returned list instead of running them."""
    names: list[str] = []

    def run_sweep(chosen: Sequence[Point], *_: Any, **__: Any) -> None:  # noqa: ANN401 - not used
        names.extend(point.name for point in chosen)

    monkeypatch.setattr(conduct, "run_sweep", run_sweep)
    return names


def rounds(seeds: Sequence[int], budget_s: float | None = None, jobs: int = 1) -> Rounds:
    end_s = None if budget_s is None else time.monotonic() + budget_s
    return Rounds(LABELS, (VOLUME,), seeds, 600.0, jobs, end_s)


def test_jams_and_overlaps_of_reference_methods_are_results(
    tmp_path: Path, begun: list[str]
) -> None:
    seeds = range(2, 8)
    rule = [points(seed)["rule"] for seed in seeds]
    record(tmp_path, rule[0], Ending.STANDSTILL, "45 vehicles have stood still")
    record(tmp_path, rule[1], Ending.LIMIT, "the run is not complete")
    record(tmp_path, rule[2], Ending.COMPLETE, "1 pairs of vehicles overlapped")
    record(tmp_path, rule[3], Ending.UNFINISHED, "its process was ended by SIGKILL")
    record(tmp_path, rule[4], None, "its process ended with status 1")
    for seed in seeds:
        record(tmp_path, points(seed)["formations"], Ending.COMPLETE)
    assert rounds(seeds).run(tmp_path)
    assert begun == [point.name for point in rule[3:]]
    begun.clear()
    (tmp_path / SWEEP_FOLDER / rule[0].name / "trips.parquet").unlink()
    assert rounds(seeds).run(tmp_path)
    assert begun == [point.name for point in (rule[0], *rule[3:])]


def test_failures_of_formation_control_are_repeated_and_reported(
    tmp_path: Path, begun: list[str]
) -> None:
    for point in points(2).values():
        record(tmp_path, point, Ending.LIMIT, "the run is not complete")
    assert not rounds([2]).run(tmp_path)
    assert begun == [points(2)["formations"].name]
    assert not rounds([2], budget_s=1.0).run(tmp_path)
    assert len(begun) == 1


def test_seeds_begin_if_they_are_likely_to_end_in_time(
    tmp_path: Path, begun: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path, points(2)["formations"], Ending.COMPLETE, wall_s=1000.0)
    record(tmp_path, points(2)["rule"], Ending.STANDSTILL, "jam", wall_s=100.0)
    record(tmp_path, points(3)["rule"], None, "its process ended with status 1", wall_s=1e6)
    assert rounds([4], budget_s=1050.0).run(tmp_path)
    assert begun == []
    assert "seed 4 is likely to take 18 min, the budget leaves 17 min" in capsys.readouterr().err
    # Two processes are not faster than the longest run.
    assert rounds([4], budget_s=950.0, jobs=2).run(tmp_path)
    assert begun == []
    assert rounds([4], budget_s=1050.0, jobs=2).run(tmp_path)
    assert len(begun) == 2


def test_the_first_seed_begins_within_any_budget(tmp_path: Path, begun: list[str]) -> None:
    assert rounds([2], budget_s=1.0).run(tmp_path)
    assert len(begun) == 2
