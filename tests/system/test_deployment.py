"""The roles started one by one, as a deployment does."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import subprocess

import pytest

from laneweave.protocol.runtime.transport import Delivery, TokenUp
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import BRIDGE_ALIVE, PROCESS_ALIVE, Keys
from support.deployments import REALM, ask, deployment, free_tcp, ping, start_router, stop
from support.extras import only_for
from support.harness import END_S, RUN_S, Lab, check_safe_and_complete, events, final_lanes, summary
from support.service_lab import request, slow_request
from system.conftest import FinishedRun

REQUEST = request()


@pytest.mark.more
def test_roles_by_hand(finished_run: FinishedRun, lab: Lab) -> None:
    # The other tests here use TCP. Each role has only the packages of its image.
    config = deployment(lab, "unixsock-stream/router.sock")
    router = start_router(lab, config, **only_for("router"))
    coordinator = lab.start("coordinator", "--config", config, **only_for("coordinator"))
    agents = [
        lab.start("agent", "--config", config, "--shard", f"{i}/2", **only_for("agent"))
        for i in range(2)
    ]
    # Somebody must lead before vehicles come: the answer to a question shows it.
    lab.wait_until(lambda: ask(lab, config, REQUEST).status == 0, END_S)

    bridge = ("bridge", "--config", config, "--pace", "20", "--out", "out")
    ended = lab.finish(lab.start(*bridge, **only_for("bridge")), RUN_S)

    assert (ended.status, ended.complaints) == (0, []), ended
    assert (lab.folder / "out" / "report.html").stat().st_size > 0
    stop(lab, *agents, coordinator)
    assert ping(lab, config).status == 0
    stop(lab, router)
    check_safe_and_complete(lab.folder / "out")
    assert final_lanes(lab.folder / "out") == final_lanes(finished_run("simulated"))


@pytest.mark.more
def test_the_planning_service(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    router = start_router(lab, config)
    # A network without a coordinator is told from a network that is not there.
    assert ask(lab, config, REQUEST).status == 2
    coordinator = lab.start("coordinator", "--config", config, "--solver", "tappa")
    lab.wait_until(lambda: ask(lab, config, REQUEST).status == 0, END_S)

    there = json.loads(ask(lab, config, REQUEST).out)
    path = lab.folder / "request.json"
    here = json.loads(lab.finish(lab.start("plan", path), RUN_S).out)
    assert there["schema"] == "laneweave.plan.response/1"
    assert there["status"] == here["status"] == "optimal"
    assert there["cost"] == here["cost"] == here["lower_bound"]
    assert (there["solver"], here["solver"]) == ("tappa", "branching")
    table = ask(lab, config, REQUEST, "--format", "table", "--solver", "branching").out
    assert "planned by branching" in table
    assert table == lab.finish(lab.start("plan", path, "--format", "table"), RUN_S).out
    assert f"cost {here['cost']}" in table
    assert len(table.splitlines()) > 3

    infeasible = request(targets=[[2, 0]])
    assert json.loads(ask(lab, config, infeasible).out)["status"] == "infeasible"
    stop(lab, coordinator, router)
    lab.check_nothing_left()


@pytest.mark.more
def test_an_end_does_not_wait_for_a_long_computation(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    router = start_router(lab, config)
    coordinator = lab.start("coordinator", "--config", config)
    lab.wait_until(lambda: ask(lab, config, REQUEST).status == 0, END_S)
    path = lab.path("slow.json", json.dumps(slow_request("slow", 600.0)))
    client = lab.start("plan", path, "--config", config)
    with pytest.raises(subprocess.TimeoutExpired):
        client.wait(2.0)

    stop(lab, coordinator)

    # The client waits until its own deadline: another coordinator may come.
    with pytest.raises(subprocess.TimeoutExpired):
        client.wait(1.0)
    client.send_signal(signal.SIGINT)
    assert lab.finish(client, END_S).status != 0
    stop(lab, router)


@pytest.mark.more
def test_the_bridge_ends_while_it_waits_for_agents(lab: Lab) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    tokens: queue.SimpleQueue[Delivery] = queue.SimpleQueue()
    router = start_router(lab, config)
    bridge = lab.start("bridge", "--config", config, "--pace", "100", "--out", "out")
    with contextlib.closing(ZenohTransport(Access(endpoint), tokens.put)) as transport:
        transport.watch(Keys(REALM).all_of(BRIDGE_ALIVE))
        assert isinstance(tokens.get(timeout=END_S), TokenUp)

    bridge.send_signal(signal.SIGTERM)
    ended = lab.finish(bridge, END_S)

    # It did what it was asked to do, and says what came of it.
    assert (ended.status, len(ended.complaints)) == (0, 1), ended
    assert ended.complaints[0].endswith("s of road time; the data so far: out")
    assert "FAILED" not in ended.out
    last = events(lab.folder / "out")[-1]
    assert (last["kind"], last["ending"]) == ("run-ended", "interrupted")
    assert summary(lab.folder / "out")["ending"] == "interrupted"
    stop(lab, router)
    lab.check_nothing_left()


@pytest.mark.more
def test_roles_end_while_the_router_is_away(lab: Lab) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    tokens: queue.SimpleQueue[Delivery] = queue.SimpleQueue()
    router = start_router(lab, config)
    coordinator = lab.start("coordinator", "--config", config)
    agent = lab.start("agent", "--config", config)
    lab.wait_until(lambda: ask(lab, config, REQUEST).status == 0, END_S)
    with contextlib.closing(ZenohTransport(Access(endpoint), tokens.put)) as transport:
        transport.watch(Keys(REALM).all_of(PROCESS_ALIVE))
        for _ in (coordinator, agent):
            assert isinstance(tokens.get(timeout=END_S), TokenUp)
    router.kill()
    router.wait(END_S)

    stop(lab, coordinator, agent)
    lab.finish(router, END_S)
    lab.check_nothing_left()


@pytest.mark.more
def test_roles_wait_for_their_router(lab: Lab) -> None:
    config = deployment(lab, free_tcp(), "connect_timeout_s = 60.0\n")
    text = config.read_text(encoding="utf-8").replace("connect_timeout_s = 60.0\n", "")
    impatient = lab.path("impatient.toml", f"{text}connect_timeout_s = 0.5\n")
    coordinator, agent = (lab.start(role, "--config", config) for role in ("coordinator", "agent"))
    # Who has waited for as long as it was told to gives up, in one line.
    gave_up = lab.finish(lab.start("agent", "--config", impatient), END_S)
    assert gave_up.status == 2
    assert len(gave_up.complaints) == 1
    for process in (coordinator, agent):
        assert process.stderr is not None
        assert any("waiting for the router" in line for line in process.stderr)

    # Who is asked to end meanwhile ends.
    stop(lab, agent)
    router = start_router(lab, config)
    lab.wait_until(lambda: ask(lab, config, REQUEST).status == 0, END_S)

    stop(lab, coordinator, router)
    lab.check_nothing_left()


@pytest.mark.parametrize("operation", ["formations", "rolling"])
@pytest.mark.more
def test_a_coordinator_ends_while_it_compiles(lab: Lab, operation: str) -> None:
    cache = lab.folder / "cache"
    config = deployment(lab, free_tcp(), f'[formation]\noperation = "{operation}"\n')
    router = start_router(lab, config)
    coordinator = lab.start("coordinator", "--config", config, NUMBA_CACHE_DIR=str(cache))
    lab.wait_until(lambda: next(cache.rglob("*.nbi"), None) is not None, END_S)

    stop(lab, coordinator)

    assert [one.pid for one in lab.processes()] == [router.pid]
    stop(lab, router)
