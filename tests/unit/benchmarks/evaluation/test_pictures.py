"""Tests of the choice of figures: none loses points that it shows."""

from __future__ import annotations

from pathlib import Path

from evaluation.pictures import draw_pictures
from unit.benchmarks.evaluation.recorded import run, summary


def test_a_figure_is_drawn_if_no_needed_point_is_missing(tmp_path: Path) -> None:
    runs = [run("lc2013", 1000.0, seed, summary(67.0 + seed)) for seed in (1, 2)]
    missing = ("lc2013", 1300.0)
    of_another_figure = ("lc2013", 5.0)

    assert draw_pictures(runs, tmp_path, [("lc2013", 1000.0), missing]) == ()
    assert list(tmp_path.iterdir()) == []
    for needed in ([], [("lc2013", 1000.0)], [of_another_figure]):
        drawn = draw_pictures(runs, tmp_path, needed)
        assert [picture.name for picture in drawn] == ["evaluation-flows.png"]
        (file,) = tmp_path.iterdir()
        file.unlink()
