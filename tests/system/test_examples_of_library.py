"""The scripts and example packages for users of the library, as the documents tell to run them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import pytest

import laneweave
from support.commands import LANEWEAVE, run

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
SHORT = {
    "road": {"s1_m": 20.0, "s2_m": 150.0, "s3_m": 350.0},
    "demand": {"volume_veh_per_lane_h": 900.0, "duration_s": 20.0},
}
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Install the example packages in a folder; return the environment that finds them."""
    folder = tmp_path_factory.mktemp("installed")
    for package in ("planner-plugin", "method-plugin"):
        options = ("--no-deps", "--no-build-isolation", "--no-index", "--target", folder)
        done = run(sys.executable, "-m", "pip", "install", *options, EXAMPLES / package)
        assert done.returncode == 0, done.stderr
    path = [str(folder), *(entry for entry in sys.path if entry)]
    return dict(os.environ) | {"PYTHONPATH": os.pathsep.join(path)}


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """Return the file of a scenario that takes a few seconds."""
    lines = []
    for table, fields in SHORT.items():
        lines += [f"[{table}]", *(f"{name} = {value}" for name, value in fields.items())]
    path = tmp_path / "short.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def command(environment: Mapping[str, str], *words: object) -> subprocess.CompletedProcess[str]:
    done = run(LANEWEAVE, *words, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def script(name: str, *arguments: object) -> str:
    environment = dict(os.environ) | {"PYTHONWARNINGS": "error", "MPLBACKEND": "agg"}
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = run(sys.executable, EXAMPLES / name, *arguments, env=environment | {"PYTHONPATH": path})
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.more
def test_run_and_read(tmp_path: Path) -> None:
    out = tmp_path / "run"
    lines = script("run_and_read.py", out).splitlines()
    recorded = laneweave.load_run(out)
    assert lines[0] == f"{recorded.summary.vehicles.left} vehicles left, 0 overlaps"
    assert lines[1].startswith("minute 0: ")
    named = lines[-1].removeprefix("changed lanes twice:").split()
    trips = recorded.trips().to_pylist()
    far = {one["vehicle"] for one in trips if abs(one["final_lane"] - one["arrival_lane"]) == 2}
    assert far <= set(named)
    assert (out / "mean-speed.png").stat().st_size > 5000


def test_plan_from_python() -> None:
    printed = script("plan_from_python.py")
    assert printed.startswith("optimal: cost ")
    assert "red takes target " in printed


@pytest.mark.more
def test_a_planner_of_a_user_plans(
    installed: dict[str, str], scenario: Path, tmp_path: Path
) -> None:
    study = ROOT / "docs" / "examples" / "case-study.json"
    answer = json.loads(command(installed, "plan", study, "--solver", "prioritized").stdout)
    assert (answer["solver"], answer.get("fallback", False)) == ("prioritized", False)
    assert answer["lower_bound"] <= 7 <= answer["cost"]

    out = tmp_path / "run"
    options = ("--transport", "simulated", "--solver", "prioritized", "--out", out)
    command(installed, "run", scenario, *options)
    summary = laneweave.load_run(out).summary
    assert summary.planning.by_solver is not None
    assert summary.planning.by_solver["prioritized"] > 0
    assert sum(summary.planning.by_solver.values()) == summary.planning.plans
    assert summary.plug_ins == ["laneweave-prioritized 0.1.0"]
    assert summary.safety.overlaps == 0


@pytest.mark.more
def test_a_planner_of_a_user_plans_in_coordinators(
    installed: dict[str, str], scenario: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    command(installed, "run", scenario, "--solver", "prioritized", "--out", out)
    summary = laneweave.load_run(out).summary
    assert summary.planning.by_solver is not None
    assert summary.planning.by_solver["prioritized"] > 0


@pytest.mark.more
def test_methods_of_a_user_are_swept_and_reported(
    installed: dict[str, str], scenario: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    command(installed, "run", scenario, "--method", "mobil", "--out", out)
    summary = laneweave.load_run(out).summary
    assert (summary.method, summary.ending, summary.safety.overlaps) == ("mobil", "complete", 0)
    assert summary.plug_ins == ["laneweave-mobil 0.1.0"]

    sweep = tmp_path / "sweep"
    points = ("--methods", "mobil,mobil-polite,rule", "--volumes", 1600, "--seeds", "1:2")
    command(installed, "sweep", scenario, *points, "--out", sweep, "--no-progress")
    point = json.loads((sweep / "mobil-1600-1" / "point.json").read_text(encoding="utf-8"))
    assert (point["method"], point["plug_in"]) == ("mobil", "laneweave-mobil 0.1.0")
    # Each method changes lanes in its own way.
    found = {
        name: laneweave.load_run(sweep / f"{name}-1600-1").trajectories()
        for name in ("mobil", "mobil-polite", "rule")
    }
    for one, other in combinations(found.values(), 2):
        assert not one.equals(other)

    # Reports need no plug-in.
    command(os.environ, "report", sweep)
    page = (sweep / "report.html").read_text(encoding="utf-8")
    assert "mobil-polite" in page
