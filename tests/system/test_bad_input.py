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
        (["bridge", "--endpoint", NOBODY, "--out", "."], "--out: got '.'"),
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
def test_command_lines(lab: Lab, arguments: list[str], named: str) -> None:
    lab.path("something.txt", "")  # so that the folder is not empty
    assert named in refused(lab, *arguments)


@pytest.mark.parametrize(
    ("words", "text", "named"),
    [
        ("run FILE", "a = " + "[" * 5000, "valid TOML"),
        ("run FILE", "[road]\nlane = 3", "road.lane: got 'an unknown key'"),
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
def test_files(lab: Lab, words: str, text: str, named: str) -> None:
    """One or two errors of each kind of file; the parsers' own tests have the others."""
    file = lab.path("file", text)
    out = () if words.startswith("plan") else ("--out", "out")
    assert named in refused(lab, *words.replace("FILE", str(file)).split(), *out)
    assert not (lab.folder / "out").exists()


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
