"""Sweeps with real runs: their files, continuation, and failed runs."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

import psutil
import pyarrow.parquet as pq
import pytest

from laneweave.launch.run_methods import affects
from laneweave.protocol.config.scenario_files import to_tables
from laneweave.protocol.scenario.fields import Scenario
from support.commands import Here
from support.sharing import made_once
from support.sweeping import command, results, short_road, sweep
from support.waiting import wait_until

pytestmark = pytest.mark.slow

LISTS = ("--volumes", "1200,1600", "--seeds", "1:3")


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return short_road(tmp_path_factory.mktemp("scenario"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an undisturbed sweep with two processes. It is to be left as it is."""
    return made_once(tmp_path_factory, "whole-sweep", _sweep)


def _sweep(out: Path) -> None:
    done = sweep(short_road(out.parent), out, *LISTS, "--jobs", 2)
    assert done.returncode == 0, done.stderr
    warning, *points = done.stderr.splitlines()
    assert warning == "8 s of arrivals give no travel times, which leave out the first 60 s"
    assert len(points) == 4


@pytest.mark.more
def test_the_files_of_a_sweep(whole: Path) -> None:
    rows = pq.read_table(whole / "results.parquet").to_pylist()
    assert [(row["label"], row["volume_veh_per_lane_h"], row["seed"]) for row in rows] == [
        ("formation", 1200.0, 1),
        ("formation", 1200.0, 2),
        ("formation", 1600.0, 1),
        ("formation", 1600.0, 2),
    ]
    for row in rows:
        folder = whole / f"formation-{row['volume_veh_per_lane_h']:g}-{row['seed']}"
        summary = json.loads((folder / "summary.json").read_text())
        assert (row["status"], row["reason"]) == ("done", "")
        assert row["vehicles_left"] == summary["vehicles"]["left"] > 0
        assert row["planning_solve_ms_p95"] == summary["planning"]["solve_ms"]["p95"]
        assert row["travel_time_s_mean"] is summary["travel_time_s"]["mean"] is None
        assert row["wall_s"] > row["runtime_wall_s"] > 0.0
        kept = {"point.json", "summary.json", "trips.parquet", "events.jsonl"}
        if row["seed"] == 1:
            kept.add("trajectories.parquet")
        assert {path.name for path in folder.iterdir()} == kept
    assert {path.name for path in whole.iterdir() if path.is_file()} == {
        "results.parquet",
        "sweep.json",
    }


@pytest.mark.more
def test_an_interrupted_sweep_is_continued(whole: Path, scenario: Path, tmp_path: Path) -> None:
    out = tmp_path / "sweep"
    process = subprocess.Popen(
        command(scenario, out, *LISTS, "--jobs", 1),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert "no travel times" in process.stderr.readline()
    assert ": done in " in process.stderr.readline()
    children = running_points(process.pid)
    process.send_signal(signal.SIGTERM)
    last_words = process.stderr.read()
    assert process.wait(120) == 1
    assert last_words.splitlines()[-1] == "interrupted"
    assert not any(child.is_running() for child in children)
    finished = sorted(path.name for path in out.iterdir() if path.is_dir())
    assert 1 <= len(finished) < 4
    assert len(results(out)) == len(finished)
    times = {name: (out / name / "summary.json").stat().st_mtime_ns for name in finished}

    done = sweep(scenario, out, *LISTS, "--jobs", 1)

    assert done.returncode == 0, done.stderr
    assert f"{len(finished)} of 4 runs were already finished" in done.stderr
    for name, time_ns in times.items():
        assert (out / name / "summary.json").stat().st_mtime_ns == time_ns
    assert results(out) == results(whole)


def running_points(sweep_pid: int) -> list[psutil.Process]:
    """Return the processes of a sweep's points, once there are some."""
    return wait_until(psutil.Process(sweep_pid).children, 120.0)


@pytest.mark.more
def test_a_run_whose_process_dies_is_a_failed_row_and_tried_again(
    scenario: Path, tmp_path: Path
) -> None:
    out, lists = tmp_path / "sweep", ("--volumes", "1200", "--seeds", "1:2")
    process = subprocess.Popen(
        command(scenario, out, *lists), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    running_points(process.pid)[0].kill()
    shown, _ = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "FAILED: formation-1200-1: its process was ended by SIGKILL" in shown
    (row,) = pq.read_table(out / "results.parquet").to_pylist()
    assert (row["status"], row["reason"]) == ("failed", "its process was ended by SIGKILL")

    assert sweep(scenario, out, *lists).returncode == 0
    assert [row["status"] for row in results(out)] == ["done"]


@pytest.mark.more
def test_a_run_that_breaks_a_promise_is_a_failed_row_with_its_numbers(tmp_path: Path) -> None:
    scenario = short_road(tmp_path)
    scenario.write_text(scenario.read_text() + "\n[runtime]\nmax_road_s = 8.0\n")
    done = sweep(scenario, tmp_path / "sweep", "--volumes", "1600", "--seeds", "1:2")
    assert done.returncode == 1
    (row,) = results(tmp_path / "sweep")
    assert row["status"] == "failed"
    assert "the run is not complete: limit" in row["reason"]
    assert row["vehicles_left"] < row["vehicles_demanded"]
    assert (tmp_path / "sweep" / "formation-1600-1" / "log.txt").is_file()


@pytest.mark.more
def test_other_settings_are_refused(laneweave: Here, whole: Path, scenario: Path) -> None:
    line = laneweave.refused(*command(scenario, whole, *LISTS, "--duration", 7)[1:])
    assert line.startswith("demand.duration_s: got 7.0; allowed: 8.0, as recorded in ")


@pytest.mark.more
def test_settings_that_do_not_affect_a_method_may_differ(whole: Path, tmp_path: Path) -> None:
    scenario = short_road(tmp_path)
    scenario.write_text(scenario.read_text() + '\n[rule]\ngap = "net"\n')
    done = sweep(scenario, whole, *LISTS)
    assert done.returncode == 0, done.stderr
    assert "4 of 4 runs were already finished" in done.stderr


@pytest.mark.parametrize(
    ("field", "method", "matters"),
    [
        ("formation.operation", "formation", True),
        ("formation.operation", "lc2013", False),
        ("formation.speed_mps", "lc2013", True),
        ("formation.speed_mps", "rule", True),
        ("network.lease_s", "formation", True),
        ("network.lease_s", "rule", False),
        ("rule.gap", "rule", True),
        ("rule.gap", "lc2013", False),
        ("rule.gap", "formation", False),
        ("road.s3_m", "rule", True),
        ("seed", "lc2013", True),
        ("entrance", "rule", True),
        ("exit", "lc2013", True),
        ("vehicle_type", "lc2013", True),
    ],
)
def test_which_settings_affect_a_method(field: str, method: str, matters: bool) -> None:
    assert affects(field, method) is matters


def test_settings_affect_a_method_unless_it_is_known_not_to_read_them() -> None:
    """Reference methods do not read the settings of formation control and of other methods."""
    ignored = {
        "formation": {"rule", "lc2013"},
        "rule": {"lc2013", "formation", "sensing", "braking", "tracking", "network", "radio"},
        "lc2013": {"rule", "formation", "sensing", "braking", "tracking", "network", "radio"},
    }
    tables = set(to_tables(Scenario()))
    for method, names in ignored.items():
        without_effect = {name for name in tables if not affects(name, method)}
        assert without_effect == names | {"security", "service", "observation"}


def test_other_folders_are_refused(laneweave: Here, scenario: Path, tmp_path: Path) -> None:
    (tmp_path / "letter.txt").touch()
    line = laneweave.refused(*command(scenario, tmp_path)[1:])
    assert "allowed: a new or empty folder, or that of a sweep" in line
    assert {path.name for path in tmp_path.iterdir()} == {"letter.txt"}
