"""Bad command lines and files: one line on stderr that says what is wrong, and status 2."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from laneweave.launch.cli.main import MAX_LINES
from laneweave.protocol.scenario.deployment_fields import Service
from support.commands import Here
from support.tables import for_each

NOBODY = "unixsock-stream/nobody.sock"
LONG = "x" * 5000
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


@for_each(
    ("arguments", "named"),
    [
        (["fly"], "fly"),
        (["run", "--wings", "2"], "--wings"),
        (
            ["explain", ".", "v0001"],
            "RUN: got '.'; allowed: the folder of a run, with events.jsonl",
        ),
        (["run", "a.toml", "b.toml"], "b.toml"),
        (["run", "--volume", "-5"], "demand.volume_veh_per_lane_h: got -5.0; allowed: (0, 3600]"),
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
        (["run", "."], "a readable file"),
        (["run", "--out", "/dev/null/out"], "--out: got '/dev/null/out'"),
        (["plan"], "REQUEST.json"),
        (["plan", "missing.json"], "missing.json"),
        (["plan", "missing.json", "--format", "poem"], "poem"),
        (["router"], "network.endpoint"),
        (["ping"], "network.endpoint"),
        (["bridge", "--endpoint", NOBODY, "--pace", "0"], "--pace: got 0.0"),
        (["agent", "--endpoint", NOBODY, "--shard", "2/2"], "--shard: got '2/2'"),
        (["agent", "--endpoint", NOBODY, "*"], "VEHICLE: got '*'"),
        (["coordinator", "--endpoint", NOBODY, "--name", "c/1"], "--name: got 'c/1'"),
        (["coordinator", "--endpoint", NOBODY, "--drain", "-1"], "--drain: got -1.0"),
        (["coordinator", "--endpoint", NOBODY, "--drain", "nan"], "--drain: got nan"),
        (["coordinator", "--endpoint", NOBODY, "--solver", "magic"], "formation.solver: got"),
        (["bench", "planner", "--solver", "magic"], "--solver: got 'magic'"),
        (["report"], "DIR"),
        (["certs", "init", LONG], "file: got 'xxx"),
        (["run", "--out", LONG], "--out: got 'xxx"),
        (["run", "--faults", LONG], "--faults: got 'xxx"),
        (["run", "a\0b"], "SCENARIO.toml"),
        (["run", "--seed", "1e3"], "--seed: got '1e3'; allowed: an integer"),
        (["run", "--volume", "x"], "--volume: got 'x'; allowed: a number"),
        (["bench", "planner", "--deadline", "nan"], "--deadline: got 'nan'; allowed: [0.01, 3600]"),
        (["bench", "runtime", "--seed", "-1"], "--seed: got '-1'; allowed: at least 0"),
        (["simulate", "--shrink", "."], "--shrink: got '.'"),
        (["simulate", "--story", "something.txt"], "valid JSON"),
    ],
)
def test_command_lines(laneweave: Here, arguments: list[str], named: str) -> None:
    assert named in laneweave.refused(*arguments)


@for_each(
    ("words", "text", "named"),
    [
        ("run FILE", "a = " + "[" * 5000, "valid TOML"),
        ("run FILE", "[road]\nlane = 3", "road.lane: got an unknown key"),
        ("run FILE", "[road]\nlane_width_m = 2.0\n[vehicle]\nwidth_m = 2.5", "road.lane_width_m"),
        ("run --faults FILE", "[[kill]]\ntarget = 'c9'\nat_s = 1.0", "kill[0].target: got 'c9'"),
        (
            "run --faults FILE",
            "[[kill]]\ntarget = 'v9999'\nat_s = 1",
            "name of a vehicle of the run: v0001 to v0",
        ),
        ("run FILE", '"a\\nb" = 1', "a b: got an unknown key"),
        ("run FILE", '"" = 1', "'': got an unknown key"),
        ("plan FILE", "[" * 100_000, "valid JSON"),
        ("plan FILE", "null", "REQUEST.json: got None; allowed: a JSON object"),
        ("plan FILE", json.dumps(REQUEST | {"": 1}), "'': got 1; allowed: only known keys"),
        ("simulate --story FILE", "[" * 100_000, "valid JSON"),
        ("plan FILE", json.dumps(REQUEST | {"targets": [[0.5, 0]]}), "targets[0]"),
        ("plan FILE", json.dumps(REQUEST | {"deadline_s": float("nan")}), "deadline_s"),
    ],
)
def test_files(laneweave: Here, folder: Path, words: str, text: str, named: str) -> None:
    """One or two errors of each kind of file; the parsers' own tests have the others."""
    (folder / "FILE").write_text(text, encoding="utf-8")
    out = ("--out", "out") if words.startswith("run") else ()
    assert named in laneweave.refused(*words.split(), *out)
    assert not (folder / "out").exists()


@for_each("deadline", ["-1", "0", "nan", "inf"])
def test_deadlines_on_the_command_line(laneweave: Here, folder: Path, deadline: str) -> None:
    request = folder / "request.json"
    request.write_text(json.dumps(REQUEST), encoding="utf-8")
    assert "deadline_s" in laneweave.refused("plan", request, "--deadline", deadline)


def written(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@for_each(
    ("words", "text", "lines"),
    [
        (
            "run FILE",
            "seed = -1\nraod = 1\n[road]\nlanes = 99\n",
            ["seed: got -1", "raod: got an unknown key", "road.lanes: got 99"],
        ),
        (
            "run --faults FILE",
            "[[kill]]\nat_s = -1\n[[pause]]\nfor_s = 0\nat_s = 1\n[[kil]]\n",
            ["kill[0].at_s: got -1.0", "pause[0].for_s: got 0.0", "kil: got an unknown key"],
        ),
        ("config check FILE", "[network]\nlease = 1\nlease_s = 0\n", ["network.lease", "network"]),
        (
            "plan FILE --deadline 3 --solver tappa",
            json.dumps(REQUEST | {"mod": 1, "deadline_s": 0, "solver": "tapa"}, indent=1),
            ["mod: got an unknown key", "deadline_s: got 0.0", "solver: got 'tapa'"],
        ),
    ],
)
def test_all_errors_of_a_file_have_a_line_each(
    laneweave: Here, folder: Path, words: str, text: str, lines: list[str]
) -> None:
    written(folder, "FILE", text)
    status, out, errors = laneweave(*words.split())
    assert (status, out, len(errors)) == (2, "", len(lines))
    found = {re.sub(r".*\(FILE:(\d+)\)$", r"\1", error): error for error in errors}
    assert all(number.isdigit() for number in found)
    assert len(found) == len(lines)
    for start in lines:
        assert any(error.startswith(start) for error in errors), errors


def test_only_the_first_errors_of_a_file_are_printed(laneweave: Here, folder: Path) -> None:
    vehicles = [{"id": f"v{number}", "cell": [99, 0]} for number in range(30)]
    written(folder, "FILE", json.dumps(REQUEST | {"vehicles": vehicles}))
    _, _, errors = laneweave("plan", "FILE")
    assert len(errors) == MAX_LINES + 1
    assert errors[-1].startswith("and ")


@for_each("command", ["run", "plan"])
@for_each(
    ("content", "said"),
    [
        (b"\xff\xfe{\x00", "in UTF-8 (it is UTF-16)"),
        (b"\x00\x01\x02\xff", "in UTF-8 (byte 3 is not)"),
        (b" " * 2_000_000, "bytes"),
        (b"{" * 5000, "valid "),
    ],
)
def test_files_that_are_no_text(
    laneweave: Here, folder: Path, command: str, content: bytes, said: str
) -> None:
    assert said in laneweave.refused(command, written(folder, "FILE", content))


def test_a_request_given_twice_is_refused(laneweave: Here, folder: Path) -> None:
    text = json.dumps(REQUEST).replace('"targets"', '"mode": 1, "mode": 2, "targets"')
    line = laneweave.refused("plan", written(folder, "FILE", text))
    assert "key 'mode' is given more than once" in line


def test_the_size_of_a_request_is_limited_as_by_the_service(laneweave: Here, folder: Path) -> None:
    limit = Service().max_request_bytes
    text = json.dumps(REQUEST)
    assert laneweave("plan", written(folder, "FILE", text.ljust(limit)))[0] == 0
    line = laneweave.refused("plan", written(folder, "FILE", text.ljust(limit + 1)))
    assert line.endswith(f"allowed: at most {limit} bytes")
    small = written(folder, "small.toml", "[service]\nmax_request_bytes = 1024\n")
    big = written(folder, "FILE", text.ljust(1025))
    assert "at most 1024 bytes" in laneweave.refused(
        "plan", big, "--config", small, "--draw-road", "x.png"
    )


def test_a_byte_order_mark_is_read(laneweave: Here, folder: Path) -> None:
    text = json.dumps(REQUEST, indent=1).replace("\n", "\r\n")
    request = written(folder, "FILE", b"\xef\xbb\xbf" + text.encode())
    scenario = written(folder, "x.toml", b"\xef\xbb\xbf[road]\r\nlanes = 9\r\n")
    assert laneweave("plan", request)[0] == 0
    assert laneweave.refused("run", scenario).startswith("road.lanes: got 9")


@for_each(
    ("words", "meant"),
    [
        ("rum", "'run'"),
        ("run --sed 1", "'--seed'"),
        ("run --method formaton", "formation"),
        ("run --faults losy10", "lossy10"),
        ("simulate --profile gided", "guided"),
        ("bench plannr", "planner"),
        ("bench planner --families blok", "block"),
        ("run --solver tapa", "tappa"),
    ],
)
def test_what_was_probably_meant(laneweave: Here, words: str, meant: str) -> None:
    line = laneweave.refused(*words.split())
    assert f"id you mean {meant}?" in line
    assert "Value error" not in line


def test_a_wrong_environment_variable_is_named(
    laneweave: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LANEWEAVE_LOG", "jsn")
    line = laneweave.refused("coordinator")
    assert line.startswith("--log or LANEWEAVE_LOG: got 'jsn'; allowed: text, json")
