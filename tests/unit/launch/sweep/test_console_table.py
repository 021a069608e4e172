"""The table that a sweep prints: no label and no value is shortened or wrapped."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from laneweave.launch.recordings.results_over_seeds import PREFERRED
from laneweave.launch.sweep import sweep
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point


@pytest.mark.parametrize("label", ["lc2013-cooperative-4s", "a_plug_in_with_a_name_" + 40 * "x"])
def test_labels_and_values_are_whole(label: str, monkeypatch: pytest.MonkeyPatch) -> None:
    row = {
        "label": label,
        "volume_veh_per_lane_h": 1600.0,
        "runs": 1,
        f"{sweep.COUNTED}_sum": 12345,
        "travel_time_s_mean_mean": 167.25,
        "throughput_veh_per_lane_h_mean": 1598.25,
        f"{PREFERRED}_mean": 100.0,
    }
    monkeypatch.setattr(sweep, "results_table", lambda _: None)
    monkeypatch.setattr(sweep, "over_seeds", lambda *_: [row])
    run = SimpleNamespace(label=label, volume_veh_per_lane_h=1600.0, reason="")
    folder: Any = SimpleNamespace(out=Path("out"), runs={"p": run}, is_finished=lambda _: True)
    console = Console(file=io.StringIO(), width=80)
    points = [cast("Point", SimpleNamespace(name="p"))]
    sweep.print_results(points, cast("SweepFolder", folder), console)
    lines = cast("io.StringIO", console.file).getvalue().splitlines()
    found = next(line for line in lines if line.startswith(label))
    assert found.split() == [label, "1600", "100.00", "167.25", "1598.25", "12345", "1/1"]
    assert len(found) <= 80 or len(label) > 30
