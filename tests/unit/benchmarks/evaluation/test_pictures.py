"""Tests of the choice of figures: none loses points that it shows."""

from __future__ import annotations

from pathlib import Path

from evaluation.pictures import draw_pictures
from evaluation.points import SeedKey
from laneweave.launch.recordings.runs import Run, scenario_of
from support.straight_runs import make_run
from unit.benchmarks.evaluation.recorded import run, scenario, summary


def test_a_figure_is_drawn_if_no_needed_run_is_missing(tmp_path: Path) -> None:
    runs = [run("lc2013", 1000.0, 1, summary(67.0)), run("lc2013", 1000.0, 2, summary(68.0))]
    own = [("lc2013", 1000.0, 1), ("lc2013", 1000.0, 2)]
    for missing in (("lc2013", 1300.0, 1), ("lc2013", 1000.0, 3), ("rule", 1000.0, 1)):
        assert draw_pictures(runs, tmp_path, [*own, missing]) == ()
        assert list(tmp_path.iterdir()) == []
    of_no_figure = ("lc2013", 5.0, 1)
    for needed in ([], own, [*own, of_no_figure]):
        drawn = draw_pictures(runs, tmp_path, needed)
        assert [picture.name for picture in drawn] == ["evaluation-flows.png"]
        (file,) = tmp_path.iterdir()
        file.unlink()


def test_a_figure_of_trajectories_needs_one_run_for_each_point(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    base = scenario_of(folder / "trips.parquet")
    runs = [
        Run(folder, "formations", "formation", scenario(1600.0, 1, base), summary(67.0)),
        run("lc2013", 1600.0, 1, summary(68.0)),  # without trajectories
    ]

    def drawn(*needed: SeedKey) -> set[str]:
        return {picture.name for picture in draw_pictures(runs, tmp_path, needed)}

    spacing = "evaluation-spacing.png"
    assert spacing in drawn(("formations", 1600.0, 7))
    assert spacing not in drawn(("formations", 1600.0, 7), ("lc2013", 1600.0, 1))
