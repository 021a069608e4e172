"""The folder of a sweep: its settings, and how it is read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.launch.recordings.runs import Run, write_point
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.deployment_fields import Security
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Road
from laneweave.protocol.summary import read_summary, write_summary
from support.summaries import make_summary


def record(out: Path, seed: int, scenario: Scenario) -> Path:
    """Record a point without trajectories."""
    folder = out / f"formation-1600-{seed}"
    folder.mkdir(parents=True)
    (out / "sweep.json").touch()
    scenario = evolve(scenario, seed=seed)
    write_point(Run(folder, "formation", "formation", scenario, None, "", 1.0), folder)
    write_summary(folder, make_summary(seed=seed))
    (folder / "trips.parquet").touch()
    return folder


def test_tables_without_effect_may_differ_from_the_recorded_ones(tmp_path: Path) -> None:
    """A recorded fleet is a key that the default scenario does not have."""
    fleets = Security(fleets={"red": ("v0001",)})
    record(tmp_path, 1, Scenario(security=fleets))
    with SweepFolder(tmp_path) as folder:
        folder.check_settings(Scenario())
        folder.check_settings(Scenario(security=fleets))
        with pytest.raises(BadInputError, match=r"road\.lanes"):
            folder.check_settings(Scenario(road=Road(lanes=2)))


def test_each_summary_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(1, 6):
        record(tmp_path, seed, Scenario())
    read: list[Path] = []

    def counted(folder: Path) -> object:
        read.append(folder)
        return read_summary(folder)

    monkeypatch.setattr("laneweave.launch.recordings.runs.read_summary", counted)
    with SweepFolder(tmp_path) as folder:
        for _ in range(3):
            folder.write_results()
    assert len(read) == 5


def test_a_point_is_recorded_as_json(tmp_path: Path) -> None:
    data = json.loads((record(tmp_path, 3, Scenario()) / "point.json").read_text())
    assert (data["schema"], data["status"]) == ("laneweave.sweep.point/1", "done")
    assert data["scenario"]["seed"] == 3
