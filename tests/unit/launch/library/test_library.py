"""Runs, plans and recorded runs from Python."""

from __future__ import annotations

import gc
import json
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

import laneweave
from laneweave.launch.library import runs
from laneweave.protocol.config.scenario_files import to_tables
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.scenario.fields import Scenario
from support.commands import run
from support.tables import for_each

CASE_STUDY = Path(__file__).resolve().parents[4] / "docs" / "examples" / "case-study.json"
SHORT: dict[str, Any] = {
    "road": {"s1_m": 20.0, "s2_m": 150.0, "s3_m": 350.0},
    "demand": {"duration_s": 5.0},
}


def test_scenarios_come_from_tables_files_and_scenarios(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("seed = 7\n[demand]\nduration_s = 5.0\n", encoding="utf-8")
    for source in (path, str(path), {"seed": 7, "demand": {"duration_s": 5.0}}):
        found = laneweave.load_scenario(source, demand__volume_veh_per_lane_h=600)
        assert (found.seed, found.demand.duration_s) == (7, 5.0)
        assert found.demand.volume_veh_per_lane_h == 600
        assert to_tables(laneweave.load_scenario(found, seed=8)) == to_tables(found) | {"seed": 8}
    assert laneweave.load_scenario() == Scenario()
    with pytest.raises(laneweave.BadInputError, match="magic"):
        laneweave.load_scenario({"magic": 1})


@for_each(
    ("arguments", "said"),
    [
        ({"method": "magic"}, "method: got 'magic'; allowed: one of formation, rule, lc2013"),
        ({"transport": "pigeon"}, "transport: got 'pigeon'; allowed: zenoh or simulated"),
        ({"pace": 0.0}, "pace: got 0.0"),
        ({"pace": 2.0, "transport": "simulated"}, "pace: got 2.0"),
        ({"method": "rule", "transport": "simulated"}, "transport: got 'simulated'"),
        ({"method": "lc2013", "faults": "lossy10"}, "faults: got 'lossy10'"),
        ({"formation__solver": "magic"}, "formation.solver: got 'magic'"),
        ({"demand__magic": 1}, "magic"),
    ],
)
def test_bad_arguments_are_exceptions(
    arguments: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(laneweave.BadInputError) as error:
        laneweave.run(SHORT, **arguments)
    assert said in str(error.value)
    assert not list(tmp_path.iterdir())


def test_plans_come_from_requests_mappings_and_files() -> None:
    data = json.loads(CASE_STUDY.read_text(encoding="utf-8"))
    request = laneweave.PlanRequest.from_dict(data)
    for source in (request, data, CASE_STUDY, str(CASE_STUDY)):
        assert (laneweave.plan(source).status, laneweave.plan(source).cost) == ("optimal", 7)
    with pytest.raises(laneweave.BadInputError, match="deadline_s"):
        laneweave.plan(request, deadline_s=-1.0)
    with pytest.raises(laneweave.BadInputError, match=r"request: got 'gone\.json'"):
        laneweave.plan("gone.json")
    with pytest.raises(laneweave.BadInputError, match="schema"):
        laneweave.plan({})


@pytest.mark.slow
def test_a_run_is_read(tmp_path: Path) -> None:
    thresholds = gc.get_threshold()
    summary = laneweave.run(SHORT, out=tmp_path / "run", transport="simulated")
    assert gc.get_threshold() == thresholds
    recorded = laneweave.load_run(tmp_path / "run")
    assert recorded.summary == summary
    assert summary.folder == recorded.folder == tmp_path / "run"
    assert recorded.scenario == laneweave.load_scenario(SHORT)
    trips = recorded.trips()
    assert trips.num_rows == summary.vehicles.left > 0
    assert len(recorded.events("left")) == trips.num_rows < len(recorded.events())
    assert recorded.trajectories(["s_m", "t_s"]).column_names == ["s_m", "t_s"]
    assert recorded.ticks().num_rows > 100
    with pytest.raises(laneweave.BadInputError, match="columns: got 'magic'"):
        recorded.trajectories(["magic"])
    (tmp_path / "run" / "trajectories.parquet").unlink()
    with pytest.raises(laneweave.BadInputError, match="--keep-trajectories all"):
        recorded.trajectories()
    for missing in (tmp_path, tmp_path / "gone"):
        with pytest.raises(laneweave.BadInputError, match="the folder of a finished run"):
            laneweave.load_run(missing)
    with pytest.raises(laneweave.BadInputError, match="new or empty folder"):
        laneweave.run(SHORT, out=tmp_path / "run", transport="simulated")


@pytest.mark.slow
def test_a_failed_run_is_an_exception(tmp_path: Path) -> None:
    with pytest.raises(laneweave.RunFailedError, match="did not leave the road") as error:
        laneweave.run(SHORT, out=tmp_path / "run", method="rule", runtime__max_road_s=20.0)
    assert "the run is not complete: limit (runtime.max_road_s)" in error.value.problems
    assert error.value.summary is not None
    assert laneweave.load_run(error.value.folder).summary.ending == "limit"


def test_only_one_run_at_a_time_is_in_this_process(tmp_path: Path) -> None:
    failed: list[Exception] = []

    def start() -> None:
        try:
            laneweave.run(SHORT, out=tmp_path / "run", method="rule")
        except CommandFailedError as error:
            failed.append(error)

    with runs._only_run():
        thread = threading.Thread(target=start)
        thread.start()
        thread.join()
    assert [str(error) for error in failed] == ["another run is under way in this process"]
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.more
def test_a_script_without_a_guard_runs_once_and_in_any_thread(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        f"""
import sys, threading
sys.path[:0] = {[entry for entry in sys.path if entry]!r}
import laneweave
print("script")
def work():
    summary = laneweave.run({SHORT!r}, out="run")
    print(summary.vehicles.left, summary.runtime.processes)
thread = threading.Thread(target=work)
thread.start()
thread.join()
print(sorted(laneweave.load_run("run").summary.planning.by_solver))
""",
        encoding="utf-8",
    )
    done = run(sys.executable, script, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    first, counts, last = done.stdout.splitlines()
    assert (first, last) == ("script", "['branching', 'tappa']")
    left, processes = map(int, counts.split())
    assert left > 0
    assert processes > left  # router, coordinators, bridge and an agent per vehicle
