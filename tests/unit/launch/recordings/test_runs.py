"""Which runs are averaged: those that differ only in volume and seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from laneweave.launch.recordings.runs import SWEEP_FILE, Comparison, Run
from laneweave.protocol.config.scenario_files import load_scenario
from support.summaries import make_summary


def run(folder: Path, label: str = "formation", method: str = "formation", **fields: Any) -> Run:  # noqa: ANN401 - any field
    return Run(folder, label, method, load_scenario(None, **fields), None)


def labels_of(*runs: Run) -> list[str]:
    return [run.label for run in Comparison.of(runs).runs]


def test_seeds_and_volumes_have_one_label(tmp_path: Path) -> None:
    """Settings that do not affect the method may differ."""
    runs = [
        run(tmp_path / "a", "rule", "rule", seed=1),
        run(tmp_path / "b", "rule", "rule", seed=2, network__lease_s=2.0),
        run(tmp_path / "c", "rule", "rule", seed=2, demand__volume_veh_per_lane_h=900.0),
    ]
    assert labels_of(*runs) == ["rule"] * 3
    assert len(Comparison.of(runs).at("rule", 900.0)) == 1


def test_runs_over_zenoh_have_networks_of_their_own(tmp_path: Path) -> None:
    """The launcher chooses the endpoint of a local run."""
    endpoint = "unixsock-stream//tmp/x/router.sock"
    fields: dict[str, Any] = {"network__endpoint": endpoint, "runtime__max_pace": 50.0}
    runs = [run(tmp_path / "a"), run(tmp_path / "b", seed=2, **fields)]
    assert labels_of(*runs) == ["formation", "formation"]


def test_only_repetitions_are_labelled_by_their_folders(tmp_path: Path) -> None:
    runs = [run(tmp_path / name, seed=seed) for name, seed in (("a", 1), ("b", 2), ("c", 2))]
    assert sorted(labels_of(*runs)) == ["b", "c", "formation"]


@pytest.mark.parametrize(
    "fields",
    [
        {"seed": 2, "formation__operation": "rolling"},
        {"seed": 2, "demand__duration_s": 90.0},
        {"demand__volume_veh_per_lane_h": 900.0, "network__lease_s": 2.0},
        {},
    ],
)
def test_others_are_labelled_by_their_folders(tmp_path: Path, fields: dict[str, Any]) -> None:
    runs = [run(tmp_path / "a"), run(tmp_path / "b", **fields)]
    assert sorted(labels_of(*runs)) == ["a", "b"]
    runs[1] = run(tmp_path / "x" / "a", **fields)
    assert sorted(labels_of(*runs)) == [str(tmp_path / "a"), str(tmp_path / "x" / "a")]


def test_runs_with_other_faults_are_not_averaged(tmp_path: Path) -> None:
    runs = []
    kills = [{"fault": "kill[0]", "t_s": t_s, "killed": "agent-1"} for t_s in (1.0, 2.0)]
    for name, seed, injected in (
        ("a", 1, kills[:1]), ("b", 2, kills[1:]), ("c", 3, []), ("d", 4, None)
    ):  # fmt: skip
        one = Run(
            tmp_path / name,
            "formation",
            "formation",
            load_scenario(None, seed=seed),
            make_summary(**({} if injected is None else {"faults": {"injected": injected}})),
        )
        runs.append(one)
    assert labels_of(*runs[:2]) == ["formation", "formation"]
    for other, name in ((runs[2], "c"), (runs[3], "d")):
        assert labels_of(runs[0], other) == ["a", name]


def test_runs_of_sweeps_keep_their_labels_beside_the_sweep(tmp_path: Path) -> None:
    runs = []
    for sweep, duration_s in (("short", 60.0), ("long", 90.0)):
        for seed in (1, 2):
            folder = tmp_path / sweep / f"formation-{seed}"
            folder.mkdir(parents=True)
            (tmp_path / sweep / SWEEP_FILE).touch()
            runs.append(run(folder, seed=seed, demand__duration_s=duration_s))
    short, long = "formation (short)", "formation (long)"
    assert sorted(labels_of(*runs)) == [long, long, short, short]
    assert labels_of(*runs[:2]) == ["formation", "formation"]


def test_a_folder_that_is_named_twice_is_one_run(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    assert labels_of(run(tmp_path / "a"), run(tmp_path / "a" / ".." / "a")) == ["formation"]
