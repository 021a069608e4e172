"""A running deployment is looked at: status, health of one role, metrics, logs."""

from __future__ import annotations

import json
import re
import signal
import socket
import urllib.request
from pathlib import Path
from typing import Any

from prometheus_client.parser import text_string_to_metric_families

from system.harness import END_S, Ended, Lab
from system.test_deployment import deployment, free_tcp, start_router, stop

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "DEPLOYMENT.md"
LOOK_S = "0.6"
"""Longer than some heartbeats, and than a tick at any pace here."""


def status(lab: Lab, config: Path, *options: str) -> Ended:
    looked = lab.start("status", "--config", config, "--seconds", LOOK_S, *options)
    return lab.finish(looked, END_S)


def told(lab: Lab, config: Path, *options: str) -> dict[str, Any]:
    """Return a status as JSON; it is well if and only if the exit status says so."""
    ended = status(lab, config, "--json", *options)
    found: dict[str, Any] = json.loads(ended.out)
    assert found["schema"] == "laneweave.status/1"
    assert ended.status == (0 if found["healthy"] else 1)
    assert ended.err == ("" if found["healthy"] else f"not healthy: {found['problem']}\n")
    return found


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


def is_well(lab: Lab, config: Path, *options: str) -> bool:
    return status(lab, config, *options).status == 0


def test_status_of_a_deployment(lab: Lab) -> None:
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    nobody = status(lab, config)
    assert (nobody.status, nobody.out) == (2, "")
    assert nobody.err.startswith("network.endpoint: got ")

    router = start_router(lab, config)
    found = told(lab, config)
    assert found["problem"] == "nobody leads: no coordinator is there"
    first = lab.start("coordinator", "--config", config, "--name", "c1")
    second = lab.start("coordinator", "--config", config, "--name", "c2")
    shards = [lab.start("agent", "--config", config, "--shard", f"{i}/2") for i in range(2)]
    health = ("--role", "coordinator", "--name")
    lab.wait_until(lambda: is_well(lab, config, *health, "c2"), END_S)
    lab.wait_until(lambda: told(lab, config)["leader"] == "c1", END_S)
    assert is_well(lab, config, *health, "c1")
    assert not is_well(lab, config, *health, "c3")
    assert status(lab, config, "--role", "bridge").err == "not healthy: no bridge is there\n"

    bridge = lab.start("bridge", "--config", config, "--pace", "4", "--out", "out")
    lab.wait_until(lambda: (told(lab, config)["road"] or {"on_road": 0})["on_road"] > 5, END_S)
    found = told(lab, config)
    assert (found["healthy"], found["leader"], found["claims"]) == (True, "c1", ["c1"])
    assert {one["coordinator"] for one in found["candidates"]} == {"c1", "c2"}
    assert found["road"]["advanced_s"] > 0.0
    assert found["vehicles"]["attended"] > 5
    assert found["vehicles"]["agents"] >= found["vehicles"]["attended"]
    assert found["messages_per_s"]["state"] > found["messages_per_s"]["clock"] > 1.0
    assert found["loss"]["clock"] < 0.5
    assert found["loss"]["state"] < 0.5
    assert is_well(lab, config, "--role", "bridge")
    assert is_well(lab, config, "--role", "agent", "--shard", "1/2")
    text = status(lab, config)
    assert (text.status, text.err) == (0, "")
    assert re.search(r"^leader +c1, term \d+", text.out, re.MULTILINE)
    assert re.search(r"^road +[\d.]+ s, pace [\d.]+; \d+ on the road", text.out, re.MULTILINE)

    first.kill()
    lab.finish(first, END_S)
    lab.wait_until(lambda: told(lab, config)["leader"] == "c2", END_S)
    # Elsewhere nothing of all this is there.
    assert told(lab, config, "--realm", "other")["candidates"] == []

    bridge.send_signal(signal.SIGTERM)
    assert lab.finish(bridge, END_S).status == 0
    stop(lab, *shards, second, router)
    lab.check_nothing_left()


def test_metrics_of_a_coordinator(lab: Lab) -> None:
    config = deployment(lab, free_tcp())
    address, router_address = (free_tcp().removeprefix("tcp/") for _ in range(2))
    router = lab.start("router", "--config", config, "--metrics", router_address)
    lab.wait_until(lambda: lab.finish(lab.start("ping", "--config", config)).status == 0, END_S)
    coordinator = lab.start(
        "coordinator", "--config", config, "--metrics", address, LANEWEAVE_LOG="json"
    )
    lab.wait_until(lambda: is_well(lab, config), END_S)

    found = metrics(address)
    assert (found["laneweave_coordinator_leading"], found["laneweave_coordinator_term"]) == (1, 1)
    assert found["laneweave_node_received_total heartbeat"] > 0
    assert (
        metrics(address)["laneweave_node_published_total"]
        >= (found["laneweave_node_published_total"])
    )
    at_router = metrics(router_address)
    assert at_router["laneweave_router_sessions"] == 1
    shown = names(found) | names(at_router)
    assert "laneweave_service_waiting" in shown
    assert shown <= documented()

    taken = lab.finish(lab.start("agent", "--config", config, "--metrics", address), END_S)
    assert (taken.status, taken.out) == (2, "")
    assert taken.err.startswith("observation.metrics: got ")
    assert len(taken.err.splitlines()) == 1

    host, port = address.split(":")
    with socket.create_connection((host, int(port))) as open_end:
        open_end.sendall(b"GET /metrics HTTP/1.1\r\n")
        metrics(address)
        coordinator.send_signal(signal.SIGTERM)
        ended = lab.finish(coordinator, END_S)
    assert (ended.status, ended.out) == (0, "")
    entries = [json.loads(line) for line in ended.err.splitlines()]
    assert [entry["event"] for entry in entries] == ["starting", "leader-elected", "stopping"]
    assert {(entry["role"], entry["name"]) for entry in entries} == {("coordinator", "c1")}
    stop(lab, router)
    lab.check_nothing_left()
