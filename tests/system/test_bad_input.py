"""Endpoints and folders that cannot be used: one line on stderr, status 2, nothing left running."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from support.harness import END_S, Ended, Lab
from support.service_lab import request
from support.variants import variants

NOBODY = "unixsock-stream/nobody.sock"


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
    "endpoint",
    [
        "nonsense",
        "ws/127.0.0.1:7447",
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


@pytest.mark.parametrize("role", variants(["plan", "bridge", "coordinator", "agent", "ping"], 2))
def test_an_endpoint_without_a_router_is_refused(lab: Lab, role: str) -> None:
    file = lab.path("request.json", json.dumps(request()))
    options: dict[str, list[object]] = {
        "plan": [file, "--connect", NOBODY],
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


@pytest.mark.more
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


@pytest.mark.parametrize(
    ("make", "out"), variants([(_full, "out"), (_file, "out"), (_file, "out/below")])
)
def test_folders_that_cannot_be_written(lab: Lab, make: Callable[[Path], None], out: str) -> None:
    make(lab.folder / "out")
    for command in (
        "run --duration 1 --transport zenoh",
        "run --duration 1 --transport simulated",
        f"bridge --endpoint {NOBODY}",
    ):
        assert f"--out: got '{out}'" in refused(lab, *command.split(), "--out", out)


@pytest.mark.parametrize(
    "command",
    ["run FILE --seed 1", "sweep FILE", "router --config FILE", "ping --config FILE",
     "coordinator --config FILE", "agent --config FILE", "bridge --config FILE",
     "watch --config FILE", "status --config FILE", "config check FILE",
     "plan REQUEST --config FILE", "certs init certs --config FILE"],
)  # fmt: skip
def test_every_command_names_all_errors_of_its_file(lab: Lab, command: str) -> None:
    text = (
        "\ufeffseed = -1\r\n[raod]\r\nlanes = 2\r\n[network]\r\nlease_s = 'x'\r\nendpiont = 1\r\n"
    )
    file, plan = lab.path("a.toml", text), lab.path("request.json", json.dumps(request()))
    places = {"FILE": file, "REQUEST": plan}
    ended = lab.run_forked(*(places.get(word, word) for word in command.split()))
    assert (ended.status, ended.out) == (2, ""), ended
    found = [(line.partition(":")[0], line[-2]) for line in ended.complaints]
    assert found == [
        ("seed", "1"),
        ("raod", "2"),
        ("network.lease_s", "5"),
        ("network.endpiont", "6"),
    ]
    for line, meant in zip(ended.complaints[1::2], ("road", "endpoint"), strict=True):
        assert f"; did you mean {meant}? (" in line
    lab.check_nothing_left()


@pytest.mark.more
def test_the_temporary_folder_is_too_deep_for_sockets(lab: Lab) -> None:
    deep = lab.folder / ("d" * 100)
    deep.mkdir()
    assert "TMPDIR" in refused_afresh(
        lab, "run", "--duration", "1", "--out", "out", TMPDIR=str(deep)
    )
