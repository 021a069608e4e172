"""The roles started one by one, as a deployment does."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import socket
import subprocess
from pathlib import Path
from typing import Any

import pytest

from laneweave.protocol.runtime.transport import Delivery, TokenUp
from laneweave.protocol.security.access import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import BRIDGE_ALIVE, Keys
from support.harness import (
    END_S,
    ROAD,
    RUN_S,
    Ended,
    Lab,
    check_safe_and_complete,
    events,
    final_lanes,
    summary,
)
from system.conftest import FinishedRun

REQUEST: dict[str, Any] = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 6, "lanes": 3},
    "vehicles": [
        {"id": "a", "cell": [0, 0], "lane": 2},
        {"id": "b", "cell": [1, 1], "lane": 0},
        {"id": "c", "cell": [2, 2], "lane": 1},
    ],
    "targets": [[2, 0], [2, 1], [3, 2], [3, 0]],
}
SLOW: dict[str, Any] = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 12, "lanes": 4},
    "vehicles": [
        {"id": f"v{i}", "cell": [i // 4 * 2, i % 4], "lane": 3 - i % 4} for i in range(20)
    ],
    "targets": [[column, lane] for column in range(12) for lane in range(4)],
    "deadline_s": 600.0,
}


def free_tcp() -> str:
    """Return an endpoint on a port that was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


def deployment(lab: Lab, endpoint: str) -> Path:
    """Write a deployment's configuration."""
    text = f"""{ROAD}
[demand]
volume_veh_per_lane_h = 1300.0
duration_s = 14.0

[network]
realm = "test"
endpoint = "{endpoint}"
"""
    return lab.path("deployment.toml", text)


def start_router(lab: Lab, config: Path) -> subprocess.Popen[str]:
    """Start a router and wait until clients can connect."""
    router = lab.start("router", "--config", config)
    lab.wait_until(lambda: _ping(lab, config).status == 0, END_S)
    return router


def _ping(lab: Lab, config: Path) -> Ended:
    return lab.finish(lab.start("ping", "--config", config), END_S)


def stop(lab: Lab, *processes: subprocess.Popen[str]) -> None:
    """End processes with SIGTERM; they must end in order and without errors."""
    for process in processes:
        process.send_signal(signal.SIGTERM)
    for process in processes:
        ended = lab.finish(process, END_S)
        assert (ended.status, ended.out, ended.complaints) == (0, "", []), ended


def test_roles_by_hand(finished_run: FinishedRun, lab: Lab) -> None:
    # The other tests here use TCP.
    config = deployment(lab, "unixsock-stream/router.sock")
    router = start_router(lab, config)
    coordinators = [
        lab.start("coordinator", "--config", config, "--name", name) for name in ("c1", "c2")
    ]
    agents = [lab.start("agent", "--config", config, "--shard", f"{i}/2") for i in range(2)]
    # Somebody must lead before vehicles come: the answer to a question shows it.
    lab.wait_until(lambda: _ask(lab, config, REQUEST).status == 0, END_S)

    bridge = lab.start("bridge", "--config", config, "--pace", "20", "--out", "out")
    ended = lab.finish(bridge, RUN_S)

    assert (ended.status, ended.complaints) == (0, []), ended
    stop(lab, *agents, *coordinators)
    assert _ping(lab, config).status == 0
    stop(lab, router)
    check_safe_and_complete(lab.folder / "out")
    assert final_lanes(lab.folder / "out") == final_lanes(finished_run("simulated"))


def _ask(lab: Lab, config: Path, request: dict[str, Any], *options: str) -> Ended:
    endpoint = config.read_text(encoding="utf-8").partition('endpoint = "')[2].partition('"')[0]
    path = lab.path("request.json", json.dumps(request))
    asked = lab.start("plan", path, "--connect", endpoint, "--realm", "test", *options)
    return lab.finish(asked, RUN_S)


def test_the_planning_service(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    router = start_router(lab, config)
    # A network without a coordinator is told from a network that is not there.
    assert _ask(lab, config, REQUEST).status == 2
    coordinator = lab.start("coordinator", "--config", config, "--solver", "branching")
    lab.wait_until(lambda: _ask(lab, config, REQUEST).status == 0, END_S)

    there = json.loads(_ask(lab, config, REQUEST).out)
    here = json.loads(lab.finish(lab.start("plan", lab.folder / "request.json"), RUN_S).out)
    assert there["schema"] == "laneweave.plan.response/1"
    assert there["status"] == here["status"] == "optimal"
    assert there["cost"] == here["cost"] == here["lower_bound"]
    assert (there["solver"], here["solver"]) == ("branching", "tappa")
    table = _ask(lab, config, REQUEST, "--format", "table", "--solver", "tappa").out
    assert "planned by tappa" in table
    assert (
        table
        == lab.finish(
            lab.start("plan", lab.folder / "request.json", "--format", "table"), RUN_S
        ).out
    )
    assert f"cost {here['cost']}" in table
    assert len(table.splitlines()) > 3

    infeasible = REQUEST | {"targets": [[2, 0]], "vehicles": REQUEST["vehicles"][:1]}
    assert json.loads(_ask(lab, config, infeasible).out)["status"] == "infeasible"
    stop(lab, coordinator, router)
    lab.check_nothing_left()


def test_an_end_does_not_wait_for_a_long_computation(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    router = start_router(lab, config)
    coordinator = lab.start("coordinator", "--config", config)
    lab.wait_until(lambda: _ask(lab, config, REQUEST).status == 0, END_S)
    path = lab.path("slow.json", json.dumps(SLOW))
    endpoint = config.read_text(encoding="utf-8").partition('endpoint = "')[2].partition('"')[0]
    client = lab.start("plan", path, "--connect", endpoint, "--realm", "test")
    with pytest.raises(subprocess.TimeoutExpired):
        client.wait(2.0)

    stop(lab, coordinator)

    # Who asked is told that nobody answers, in one line.
    ended = lab.finish(client, END_S)
    assert ended.status == 2
    assert len(ended.err.splitlines()) == 1
    stop(lab, router)


def test_the_bridge_ends_while_it_waits_for_agents(lab: Lab) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    tokens: queue.SimpleQueue[Delivery] = queue.SimpleQueue()
    router = start_router(lab, config)
    bridge = lab.start("bridge", "--config", config, "--pace", "100", "--out", "out")
    with contextlib.closing(ZenohTransport(Access(endpoint), tokens.put)) as transport:
        transport.watch(Keys("test").all_of(BRIDGE_ALIVE))
        assert isinstance(tokens.get(timeout=END_S), TokenUp)

    bridge.send_signal(signal.SIGTERM)
    ended = lab.finish(bridge, END_S)

    # It did what it was asked to do, and says what came of it.
    assert (ended.status, ended.complaints) == (0, []), ended
    assert "FAILED: the run is not complete: interrupted" in ended.out
    last = events(lab.folder / "out")[-1]
    assert (last["kind"], last["ending"]) == ("run-ended", "interrupted")
    assert summary(lab.folder / "out")["ending"] == "interrupted"
    stop(lab, router)
    lab.check_nothing_left()


def test_roles_end_while_the_router_is_away(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    router = start_router(lab, config)
    coordinator = lab.start("coordinator", "--config", config)
    agent = lab.start("agent", "--config", config)
    lab.wait_until(lambda: _ask(lab, config, REQUEST).status == 0, END_S)
    router.kill()
    router.wait(END_S)

    stop(lab, coordinator, agent)
    lab.finish(router, END_S)
    lab.check_nothing_left()


def test_roles_wait_for_their_router(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    text = config.read_text(encoding="utf-8")
    config.write_text(f"{text}connect_timeout_s = 60.0\n", encoding="utf-8")
    impatient = lab.path("impatient.toml", f"{text}connect_timeout_s = 0.5\n")
    coordinator, agent = lab.start("coordinator", "--config", config), _agent(lab, config)
    # Who has waited for as long as it was told to gives up, in one line.
    gave_up = lab.finish(_agent(lab, impatient), END_S)
    assert gave_up.status == 2
    assert len(gave_up.complaints) == 1
    for process in (coordinator, agent):
        assert process.stderr is not None
        assert "waiting for the router" in process.stderr.readline()

    # Who is asked to end meanwhile ends.
    stop(lab, agent)
    router = start_router(lab, config)
    lab.wait_until(lambda: _ask(lab, config, REQUEST).status == 0, END_S)

    stop(lab, coordinator, router)
    lab.check_nothing_left()


def _agent(lab: Lab, config: Path) -> subprocess.Popen[str]:
    return lab.start("agent", "--config", config)


def test_a_coordinator_ends_while_it_compiles(lab: Lab) -> None:
    cache = lab.folder / "cache"
    config = deployment(lab, free_tcp())
    coordinator = lab.start("coordinator", "--config", config, NUMBA_CACHE_DIR=str(cache))
    lab.wait_until(lambda: next(cache.rglob("*.nbi"), None) is not None, END_S)

    coordinator.terminate()

    stop_result = lab.finish(coordinator, END_S)
    assert (stop_result.status, stop_result.complaints) == (0, []), stop_result
    lab.check_nothing_left()
