"""A running deployment is looked at: status, health of one role, metrics, logs."""

from __future__ import annotations

import json
import re
import signal
import socket
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from laneweave.launch.cli.status_command import listen
from laneweave.launch.observe.observed import BRIDGE, COORDINATOR, Expected
from laneweave.launch.observe.process_view import label_of
from laneweave.launch.observe.status import Status
from laneweave.protocol.config.scenario_files import load_scenario
from support.deployments import deployment, free_tcp, ping, start_router, stop
from support.harness import END_S, Ended, Lab

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "DEPLOYMENT.md"
LOOK_S = "0.6"
"""Longer than some heartbeats, and than a tick at any pace here."""


def status(lab: Lab, config: Path, *options: str) -> Ended:
    return lab.run_forked("status", "--config", config, "--seconds", LOOK_S, *options, alone=False)


def wait_for_health(lab: Lab, config: Path, *options: str) -> Ended:
    """Repeat the command until it finds health: on a busy machine one look may receive nothing."""
    looks: list[Ended] = []

    def is_healthy() -> bool:
        looks.append(status(lab, config, *options))
        return looks[-1].status == 0

    lab.wait_until(is_healthy, END_S)
    return looks[-1]


def seen(config: Path, process: str | None = None, **expected: Any) -> Status:  # noqa: ANN401
    """Return what the command would print, without the start of a process."""
    return listen(load_scenario(config), float(LOOK_S), Expected(**expected), process)


def metrics(address: str) -> dict[str, float]:
    """Return a process's own metrics, those with a topic under its name."""
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=END_S) as answer:
        text = answer.read().decode()
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            topic = sample.labels.get("topic")
            if sample.name.startswith("laneweave_"):
                found[sample.name + (f" {topic}" if topic else "")] = sample.value
    return found


def documented() -> set[str]:
    return set(re.findall(r"^\| `(laneweave_\w+)", DOCUMENT.read_text("utf-8"), re.MULTILINE))


def names(found: dict[str, float]) -> set[str]:
    return {name.partition(" ")[0] for name in found}


@pytest.mark.more
def test_status_of_a_deployment(lab: Lab) -> None:
    # Longer than the test takes; and c1 leads until it is killed, even on a busy machine.
    config = deployment(lab, free_tcp(), "election_s = 3.0\n\n[runtime]\ncoordinators = 2\n")
    text = config.read_text("utf-8").replace("duration_s = 14.0", "duration_s = 900.0")
    config.write_text(text, encoding="utf-8")
    nobody = status(lab, config)
    assert (nobody.status, nobody.out) == (2, "")
    assert nobody.complaints[0].startswith("network.endpoint: got ")

    router = start_router(lab, config)
    assert seen(config).problem == "there is no leader: no coordinators found"
    first = lab.start("coordinator", "--config", config, "--name", "c1")
    second = lab.start("coordinator", "--config", config, "--name", "c2")
    shards = [lab.start("agent", "--config", config, "--shard", f"{i}/2") for i in range(2)]
    lab.wait_until(
        lambda: seen(config, label_of(COORDINATOR, "c2"), coordinators=("c2",)).healthy, END_S
    )
    lab.wait_until(lambda: seen(config).leader == "c1", END_S)
    bridge = lab.start("bridge", "--config", config, "--pace", "5", "--out", "out")
    ended = status(lab, config, "--role", "coordinator", "--name", "c3")
    assert (ended.status, ended.out) == (1, "")
    assert ended.complaints == ["not healthy: no coordinator c3 found: start it"]

    def flows(found: Status) -> bool:
        """Tell whether c1 leads and the road advances."""
        rates = found.messages_per_s
        return (
            (found.leader, found.claims) == ("c1", ("c1",))
            and {one.coordinator for one in found.candidates} == {"c1", "c2"}
            and found.vehicles.agents >= found.vehicles.attended > 5
            and found.road is not None
            and found.road.advanced_s > 0.0
            and rates.get("state", 0.0) > rates.get("clock", 0.0) > 0.0
        )

    lab.wait_until(lambda: flows(seen(config)), END_S)
    lab.wait_until(lambda: seen(config, BRIDGE, bridge=True).healthy, END_S)
    table = wait_for_health(lab, config)
    assert table.complaints == []
    for row in (
        r"leader +c1",
        r"term +\d+",
        r"candidate c1 +term \d+, heard [\d.]+ s ago, claims to lead",
        r"road time +[\d.]+ s",
        r"pace +[\d.]+",
        r"vehicles on the road +\d+",
        r"state messages +[\d.]+/s",
    ):
        assert re.search(f"^{row} *$", table.out, re.MULTILINE), table.out
    shard = wait_for_health(lab, config, "--role", "agent", "--shard", "1/2")
    assert (shard.out, shard.complaints) == ("healthy\n", [])

    first.kill()
    lab.finish(first, END_S)
    lab.wait_until(lambda: seen(config).leader == "c2", END_S)
    # Elsewhere nothing of all this is there.
    other = status(lab, config, "--realm", "other", "--json")
    assert other.status == 1
    found_there = json.loads(other.out)
    assert (found_there["schema"], found_there["realm"]) == ("laneweave.status/1", "other")
    assert (found_there["candidates"], found_there["road"]) == ([], None)
    problems = "; ".join(f"{one['what']}: {one['advice']}" for one in found_there["findings"])
    assert other.complaints == [f"not healthy: {problems}"]
    assert problems.startswith(found_there["problem"])

    bridge.send_signal(signal.SIGTERM)
    assert lab.finish(bridge, END_S).status == 0
    stop(lab, *shards, second, router)
    lab.check_nothing_left()


@pytest.mark.more
def test_metrics_of_a_coordinator(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    address, router_address = (free_tcp().removeprefix("tcp/") for _ in range(2))
    router = lab.start("router", "--config", config, "--metrics", router_address)
    lab.wait_until(lambda: ping(lab, config).status == 0, END_S)
    coordinator = lab.start(
        "coordinator", "--config", config, "--metrics", address, LANEWEAVE_LOG="json"
    )
    lab.wait_until(lambda: seen(config).healthy, END_S)

    found = metrics(address)
    assert (found["laneweave_coordinator_leading"], found["laneweave_coordinator_term"]) == (1, 1)
    assert found["laneweave_node_received_total heartbeat"] > 0
    assert (
        metrics(address)["laneweave_node_published_total"]
        >= (found["laneweave_node_published_total"])
    )
    # Whoever has looked may not have gone yet.
    lab.wait_until(lambda: metrics(router_address)["laneweave_router_sessions"] == 1, END_S)
    at_router = metrics(router_address)
    shown = names(found) | names(at_router)
    assert "laneweave_service_waiting" in shown
    assert shown <= documented()

    taken = lab.finish(lab.start("agent", "--config", config, "--metrics", address), END_S)
    assert (taken.status, taken.out) == (2, "")
    (line,) = taken.complaints
    assert line.startswith("observation.metrics: got ")

    host, port = address.split(":")
    with socket.create_connection((host, int(port))) as open_end:
        open_end.sendall(b"GET /metrics HTTP/1.1\r\n")
        metrics(address)
        coordinator.send_signal(signal.SIGTERM)
        ended = lab.finish(coordinator, END_S)
    assert (ended.status, ended.out) == (0, "")
    entries = [json.loads(line) for line in ended.err.splitlines()]
    news = [entry["event"] for entry in entries if entry["level"] == "info"]
    assert news == ["starting", "leader-elected", "stopping", "leader-stepped-down"]
    assert not [entry for entry in entries if entry["level"] == "error"]
    assert {(entry["role"], entry["name"]) for entry in entries} == {("coordinator", "c1")}
    stop(lab, router)
    lab.check_nothing_left()
