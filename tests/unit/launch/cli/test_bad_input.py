"""Bad command lines and files: one line on stderr that says what is wrong, and status 2."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from support.commands import Here

NOBODY = "unixsock-stream/nobody.sock"
REQUEST: dict[str, Any] = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 4, "lanes": 2},
    "vehicles": [{"id": "a", "cell": [0, 0], "lane": 1}],
    "targets": [[1, 0], [1, 1]],
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder of the commands; it is not empty."""
    (tmp_path / "something.txt").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["fly"], "fly"),
        (["run", "--wings", "2"], "--wings"),
        (["run", "a.toml", "b.toml"], "b.toml"),
        (["run", "--volume", "-5"], "demand.volume_veh_per_lane_h: got -5.0; allowed: (0, 3600]"),
        (["run", "--volume", "much"], "--volume"),
        (["run", "--duration", "0"], "demand.duration_s: got 0.0"),
        (["run", "--seed", "-1"], "seed: got -1"),
        (["run", "--seed", "1.5"], "--seed"),
        (["run", "--vehicles-per-process", "0"], "runtime.vehicles_per_process: got 0"),
        (["run", "--coordinators", "0"], "runtime.coordinators: got 0"),
        (["run", "--method", "magic"], "magic"),
        (["run", "--method", "rule", "--faults", "lossy10"], "--faults: got 'lossy10'"),
        (["run", "--transport", "pigeon"], "pigeon"),
        (["run", "--solver", "magic"], "formation.solver: got 'magic'"),
        (["run", "--operation", "rolling", "--solver", "tappa"], "--solver: got 'tappa'; allowed"),
        (["run", "--method", "rule", "--solver", "tappa"], "--solver: got 'tappa'; allowed: none"),
        (["run", "--method", "rule", "--pace", "2"], "--pace: got '2.0'; allowed: none with"),
        (["run", "--method", "lc2013", "--transport", "zenoh"], "--transport: got 'zenoh'"),
        (["run", "--transport", "simulated", "--pace", "2"], "--pace: got '2.0'; allowed: none"),
        (["run", "--transport", "simulated", "--watch"], "`laneweave watch DIR` shows"),
        (["run", "--method", "rule", "--watch-listen", "[::1]:0"], "`laneweave watch DIR` shows"),
        (["run", "--transport", "simulated", "--endpoint", "tcp/a:1"], "--endpoint: got"),
        (["run", "--endpoint", "tcp/nowhere"], "network.endpoint: got 'tcp/nowhere'"),
        (["run", "--watch-listen", "8080"], "--watch-listen: got '8080'; allowed: HOST:PORT"),
        (["watch", "DIR", "--wait", "3"], "--wait: got '3.0'; allowed: none with DIR"),
        (["run", "--pace", "0"], "--pace: got 0.0"),
        (["run", "missing.toml"], "missing.toml"),
        (["run", "."], "a readable file"),
        (["run", "--faults", "missing.toml"], "missing.toml"),
        (["run", "--out", "/dev/null/out"], "--out: got '/dev/null/out'"),
        (["plan"], "REQUEST.json"),
        (["plan", "missing.json"], "missing.json"),
        (["plan", "."], "a readable file"),
        (["plan", "missing.json", "--format", "poem"], "poem"),
        (["router"], "network.endpoint"),
        (["coordinator"], "network.endpoint"),
        (["agent"], "network.endpoint"),
        (["bridge", "--out", "out"], "network.endpoint"),
        (["ping"], "network.endpoint"),
        (["bridge", "--endpoint", NOBODY, "--pace", "0"], "--pace: got 0.0"),
        (["agent", "--endpoint", NOBODY, "--shard", "2/2"], "--shard: got '2/2'"),
        (["agent", "--endpoint", NOBODY, "--shard", "-1/2"], "-1/2"),
        (["agent", "--endpoint", NOBODY, "--shard", "half"], "--shard: got 'half'"),
        (["agent", "--endpoint", NOBODY, "*"], "VEHICLE: got '*'"),
        (["coordinator", "--endpoint", NOBODY, "--name", "c/1"], "--name: got 'c/1'"),
        (["coordinator", "--endpoint", NOBODY, "--solver", "magic"], "formation.solver: got"),
        (["bench", "planner", "--solver", "magic"], "--solver: got 'magic'"),
        (["report"], "DIR"),
        (["report", "missing"], "DIR: got 'missing'"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, list) else "",
)
def test_command_lines(laneweave: Here, arguments: list[str], named: str) -> None:
    assert named in laneweave.refused(*arguments)


@pytest.mark.parametrize(
    ("words", "text", "named"),
    [
        ("run FILE", "a = " + "[" * 5000, "valid TOML"),
        ("run FILE", "[road]\nlane = 3", "road.lane: got an unknown key"),
        ("run FILE", "[road]\nlane_width_m = 2.0\n[vehicle]\nwidth_m = 2.5", "road.lane_width_m"),
        ("run --faults FILE", "[[kill]]\ntarget = 'c9'\nat_s = 1.0", "kill[0].target: got 'c9'"),
        (
            "run --faults FILE",
            "[[kill]]\ntarget = 'v9999'\nat_s = 1",
            "name of a vehicle of the run",
        ),
        ("plan FILE", "[" * 100_000, "valid JSON"),
        ("plan FILE", json.dumps(REQUEST | {"targets": [[0.5, 0]]}), "targets[0]"),
        ("plan FILE", json.dumps(REQUEST | {"deadline_s": float("nan")}), "deadline_s"),
    ],
    ids=range(8),
)
def test_files(laneweave: Here, folder: Path, words: str, text: str, named: str) -> None:
    """One or two errors of each kind of file; the parsers' own tests have the others."""
    (folder / "FILE").write_text(text, encoding="utf-8")
    out = () if words.startswith("plan") else ("--out", "out")
    assert named in laneweave.refused(*words.split(), *out)
    assert not (folder / "out").exists()


@pytest.mark.parametrize("deadline", ["-1", "0", "nan", "inf"])
def test_deadlines_on_the_command_line(laneweave: Here, folder: Path, deadline: str) -> None:
    request = folder / "request.json"
    request.write_text(json.dumps(REQUEST), encoding="utf-8")
    assert "deadline_s" in laneweave.refused("plan", request, "--deadline", deadline)
