"""Bad input: one line on stderr that says what is wrong, status 2, and nothing is left running."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from support.harness import END_S, Ended, Lab

NOBODY = "unixsock-stream/nobody.sock"

REQUEST: dict[str, Any] = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 4, "lanes": 2},
    "vehicles": [{"id": "a", "cell": [0, 0], "lane": 1}],
    "targets": [[1, 0], [1, 1]],
}


def refused(lab: Lab, *arguments: object) -> str:
    """Run a command that must be refused, and return its one line."""
    return the_line(lab.run_forked(*arguments))


def refused_afresh(lab: Lab, *arguments: object, **environment: str) -> str:
    """As `refused`, in a process that loads what it needs."""
    return the_line(lab.run(*arguments, within_s=END_S, **environment))


def the_line(ended: Ended) -> str:
    """Return the one line of a command that must have been refused."""
    assert ended.status == 2, ended
    assert ended.out == ""
    (line,) = ended.complaints
    return line


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["fly"], "fly"),
        (["run", "--wings", "2"], "--wings"),
        (["run", "a.toml", "b.toml"], "b.toml"),
        (["run", "--volume", "-5"], "demand.volume_veh_per_lane_h: got -5.0; allowed: (0, 3600]"),
        (["run", "--volume", "5000"], "demand.volume_veh_per_lane_h: got 5000.0"),
        (["run", "--volume", "nan"], "demand.volume_veh_per_lane_h: got nan"),
        (["run", "--volume", "much"], "--volume"),
        (["run", "--duration", "0"], "demand.duration_s: got 0.0"),
        (["run", "--duration", "inf"], "demand.duration_s: got inf"),
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
        (["run", "--pace", "0"], "--pace: got 0.0"),
        (["run", "--pace", "nan"], "--pace: got nan"),
        (["run", "missing.toml"], "missing.toml"),
        (["run", "."], "a readable file"),
        (["run", "--faults", "missing.toml"], "missing.toml"),
        (["run", "--faults", "lossy99"], "blackout, everything, leader-chaos, lossy10, lossy50"),
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
        (["bridge", "--endpoint", NOBODY, "--out", "."], "--out: got '.'"),
        (["agent", "--endpoint", NOBODY, "--shard", "2/2"], "--shard: got '2/2'"),
        (["agent", "--endpoint", NOBODY, "--shard", "0/0"], "--shard: got '0/0'"),
        (["agent", "--endpoint", NOBODY, "--shard", "-1/2"], "-1/2"),
        (["agent", "--endpoint", NOBODY, "--shard", "half"], "--shard: got 'half'"),
        (["agent", "--endpoint", NOBODY, "v/1"], "VEHICLE: got 'v/1'"),
        (["agent", "--endpoint", NOBODY, "*"], "VEHICLE: got '*'"),
        (["coordinator", "--endpoint", NOBODY, "--name", "c/1"], "--name: got 'c/1'"),
        (["coordinator", "--endpoint", NOBODY, "--solver", "magic"], "formation.solver: got"),
        (["bench", "planner", "--solver", "magic"], "--solver: got 'magic'"),
        (["coordinator", "--endpoint", NOBODY, "--name", ""], "--name: got ''"),
        (["coordinator", "--endpoint", NOBODY, "--name", "c" * 65], "--name: got 'ccc"),
        (["report"], "DIR"),
        (["report", "missing"], "DIR: got 'missing'"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, list) else "",
)
def test_command_lines(lab: Lab, arguments: list[str], named: str) -> None:
    lab.path("something.txt", "")  # so that the folder is not empty
    assert named in refused(lab, *arguments)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("sped = 1", "sped: got 'an unknown key'"),
        ("[road]\nlane = 3", "road.lane: got 'an unknown key'"),
        ("seed = true", "seed: got True"),
        ("[road]\nlane_width_m = nan", "road.lane_width_m: got nan"),
        ("[road]\nlane_width_m = 2.0\n[vehicle]\nwidth_m = 2.5", "road.lane_width_m: got 2.0"),
        ("[demand]\nlane_shares = [1.0, 1.0]", "demand.lane_shares: got [1.0, 1.0]"),
        ("schema = 'laneweave.scenario/9'", "schema"),
        ("a = " + "[" * 5000, "valid TOML"),
        ("\x00", "valid TOML"),
    ],
    ids=range(9),
)
def test_scenarios(lab: Lab, text: str, named: str) -> None:
    line = refused(lab, "run", lab.path("scenario.toml", text), "--out", "out")

    assert named in line
    assert not (lab.folder / "out").exists()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[[kill]]\ntarget = 'c9'\nat_s = 1.0", "kill[0].target: got 'c9'"),
        ("[[kill]]\ntarget = 'v1'\nat_s = 1.0", "leader, c1, c2, c3"),
        ("[[kill]]\nat_s = 1.0\n[[kill]]\nat_s = -1.0", "kill[1].at_s: got -1.0"),
        ("[[kill]]\nat_s = 1.0\nhow = 'softly'", "kill[0].how: got 'an unknown key'"),
        ("[[pause]]\nat_s = 1.0", "pause[0].for_s: got 'nothing'"),
        ("[[blame]]\nat_s = 1.0", "blame: got 'an unknown key'"),
        ("[[kill]]\ntarget = 'v9999'\nat_s = 1.0", "or the name of a vehicle of the run"),
        ("[[messages]]\nloss = 2.0", "messages[0].loss: got 2.0; allowed: [0, 1]"),
    ],
    ids=range(8),
)
def test_faults(lab: Lab, text: str, named: str) -> None:
    faults = lab.path("faults.toml", text)
    assert named in refused(lab, "run", "--faults", faults, "--out", "out")


def test_a_refused_run_leaves_no_folder(lab: Lab) -> None:
    faults = lab.path("faults.toml", "[[pause]]\ntarget = 'router'\nat_s = 1.0\nfor_s = 1.0")
    options = ("--transport", "simulated", "--faults", faults, "--out", "out")
    assert "pause[0].target: got 'router'" in refused(lab, "run", *options)
    assert not (lab.folder / "out").exists()


def _change(**changes: object) -> str:
    return json.dumps(REQUEST | changes)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "valid JSON"),
        ("[" * 100_000, "valid JSON"),
        ("[]", "a JSON object"),
        (_change(schema="other"), "schema"),
        (_change(hurry=True), "hurry"),
        (_change(mode=3), "mode"),
        (_change(grid={"columns": 10**9, "lanes": 2}), "grid.columns"),
        (_change(targets=[[0.5, 0]]), "targets[0]"),
        (_change(vehicles=[{"id": "a", "cell": [0, 0]}] * 2), "vehicles[1]"),
        (_change(deadline_s=float("nan")), "deadline_s"),
    ],
    ids=range(10),
)
def test_plan_requests(lab: Lab, text: str, named: str) -> None:
    assert named in refused(lab, "plan", lab.path("request.json", text))


def test_deadlines_on_the_command_line(lab: Lab) -> None:
    request = lab.path("request.json", json.dumps(REQUEST))
    for deadline in ("-1", "0", "nan", "inf"):
        assert "deadline_s" in refused(lab, "plan", request, "--deadline", deadline)


@pytest.mark.parametrize(
    "endpoint",
    [
        "nonsense",
        "udp/127.0.0.1:7447",
        "tcp/",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:port",
        "tcp/127.0.0.1:99999",
        "tcp/no-such-host.invalid:7447",
        "unixsock-stream/",
        "unixsock-stream/missing/folder/router.sock",
    ],
)
def test_endpoints_that_cannot_be(lab: Lab, endpoint: str) -> None:
    for role in ("router", "ping"):
        told = refused(lab, role, "--endpoint", endpoint)
        assert f"network.endpoint: got '{endpoint}'" in told


@pytest.mark.parametrize("role", ["coordinator", "agent", "bridge", "ping", "plan"])
def test_an_endpoint_without_a_router_is_refused(lab: Lab, role: str) -> None:
    request = lab.path("request.json", json.dumps(REQUEST))
    options: dict[str, list[object]] = {
        "plan": [request, "--connect", NOBODY],
        "bridge": ["--endpoint", NOBODY, "--out", "out"],
    }
    line = refused_afresh(lab, role, *options.get(role, ["--endpoint", NOBODY]))
    assert NOBODY in line


@pytest.fixture
def silent_server() -> Iterator[str]:
    """Return the endpoint of somebody who accepts connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        kept: list[socket.socket] = []

        def accept() -> None:
            while True:
                try:
                    kept.append(server.accept()[0])
                except OSError:
                    return

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        yield f"tcp/127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
        thread.join()
        for connection in kept:
            connection.close()


def test_an_endpoint_of_another_server_is_refused(lab: Lab, silent_server: str) -> None:
    started = [lab.start(role, "--endpoint", silent_server) for role in ("ping", "router")]
    for process in started:
        assert silent_server in the_line(lab.finish(process, END_S))
    lab.check_nothing_left()


def _full(folder: Path) -> None:
    folder.mkdir()
    (folder / "summary.json").write_text("{}")


def _file(path: Path) -> None:
    path.write_text("")


@pytest.mark.parametrize(("make", "out"), [(_full, "out"), (_file, "out"), (_file, "out/below")])
def test_folders_that_cannot_be_written(lab: Lab, make: Callable[[Path], None], out: str) -> None:
    make(lab.folder / "out")
    for transport in ("zenoh", "simulated"):
        line = refused(lab, "run", "--duration", "1", "--transport", transport, "--out", out)
        assert f"--out: got '{out}'" in line


def test_the_temporary_folder_is_too_deep_for_sockets(lab: Lab) -> None:
    deep = lab.folder / ("d" * 100)
    deep.mkdir()
    assert "TMPDIR" in refused_afresh(
        lab, "run", "--duration", "1", "--out", "out", TMPDIR=str(deep)
    )


def test_a_folder_that_is_no_run(lab: Lab) -> None:
    folder = lab.folder / "torn"
    folder.mkdir()
    (folder / "trajectories.parquet").write_bytes(b"PAR1 torn")
    assert "DIR: got 'torn'" in refused_afresh(lab, "report", "torn")
