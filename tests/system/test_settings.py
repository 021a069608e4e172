"""Roles with different files: those that do not fit do not act, and say what differs."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from functools import partial
from pathlib import Path

import pytest

from support.deployments import free_tcp, start_router, stop
from support.harness import END_S, ROAD, RUN_S, Lab, events, summary

REFUSED_WITHIN_S = 10.0
"""Nothing here takes a fifth of this on an idle machine."""
DEPLOYMENT = """
[demand]
volume_veh_per_lane_h = 1300.0
duration_s = 14.0

[network]
realm = "settings"
endpoint = "{endpoint}"

[runtime]
coordinators = 2
"""
OTHER_VALUES = {
    "formation.gap_m": ("fleet", "[formation]\ngap_m = 20.0"),
    "road.lane_width_m": ("fleet", "[road]\nlane_width_m = 5.0"),
    "formation.close": (
        "coordinator",
        '[formation]\nclose = "columns"\nentry = "interlaced"',
    ),
    "formation.operation": ("coordinator", '[formation]\noperation = "rolling"'),
}
"""A setting, the role whose file has another value, and its file's lines."""


def write(lab: Lab, name: str, endpoint: str, tables: str = "") -> Path:
    """Write the file of a role; `tables` has a first table that may be `road`."""
    road, rest = ROAD, tables
    if tables.startswith("[road]"):
        road, rest = f"{ROAD}{tables.removeprefix('[road]').strip()}\n", ""
    text = road + DEPLOYMENT.format(endpoint=endpoint) + rest
    return lab.path(f"{name}.toml", text)


def errors_of(log: Path) -> list[dict[str, object]]:
    """Return the errors in a log of JSON lines."""
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    entries = [json.loads(line) for line in lines if line.startswith("{")]
    return [entry for entry in entries if entry["level"] == "error"]


def has_started(log: Path) -> bool:
    return '"starting"' in log.read_text(encoding="utf-8")


def has_refused(log: Path) -> bool:
    return bool(errors_of(log))


def start_logged(lab: Lab, log: Path, *arguments: object) -> subprocess.Popen[str]:
    """Start a role whose log goes to a file."""
    with log.open("w", encoding="utf-8") as stream:
        return lab.start_with({"stderr": stream}, *arguments, "--log", "json")


@pytest.mark.more
def test_a_role_that_does_not_fit_says_so_and_does_not_act(lab: Lab) -> None:
    """Each row starts one role with another value beside a deployment that drives."""
    endpoint = free_tcp()
    config = write(lab, "right", endpoint)
    router = start_router(lab, config)
    right = [
        lab.start("coordinator", "--config", config, "--name", "c1"),
        lab.start("agent", "--config", config),
    ]
    bridge = lab.start("bridge", "--config", config, "--pace", "1", "--out", "out")
    lab.wait_until((lab.folder / "out" / "events.jsonl").exists, END_S)
    for number, (setting, (role, lines)) in enumerate(OTHER_VALUES.items()):
        other = write(lab, f"other{number}", endpoint, lines)
        log = lab.folder / f"{number}.log"
        # A lower name than that of the coordinator in charge: it would lead if it fitted.
        named = ("coordinator", "--name", "c0") if role == "coordinator" else ("agent",)
        process = start_logged(lab, log, *named, "--config", other)
        lab.wait_until(partial(has_started, log), END_S)
        began_s = time.monotonic()
        lab.wait_until(partial(has_refused, log), END_S)
        took_s = time.monotonic() - began_s
        (error,) = errors_of(log)
        # From the first line of its log on, which it writes before it connects; the bridge
        # publishes its settings every second.
        assert took_s < REFUSED_WITHIN_S
        shown = str(error)
        assert error["process"] == ("coordinator c0" if role == "coordinator" else "fleet 0-of-1")
        assert str(error["bridge"]).startswith("bridge ")
        assert f"{setting} is " in shown, shown
        assert " at the bridge" in shown
        process.send_signal(signal.SIGTERM)
        assert lab.finish(process, END_S).status == 0
    ended = lab.finish(bridge, RUN_S)
    assert ended.status == 0, ended
    stop(lab, *right, router)
    refused = events(lab.folder / "out", "settings-refused")
    assert [set(event["settings"]) & set(OTHER_VALUES) for event in refused]
    found = summary(lab.folder / "out")
    assert found["safety"]["overlaps"] == 0
    assert found["vehicles"]["on_preferred_lane"] == found["vehicles"]["demanded"]
    assert found["failover"]["leader_changes"] == 0
    assert not events(lab.folder / "out", "caretaker-took-over")


@pytest.mark.more
def test_vehicles_of_a_fleet_that_does_not_fit_are_driven_around(lab: Lab) -> None:
    endpoint = free_tcp()
    config = write(lab, "right", endpoint)
    other = write(lab, "other", endpoint, OTHER_VALUES["formation.gap_m"][1])
    router = start_router(lab, config)
    roles = [
        lab.start("coordinator", "--config", config),
        lab.start("agent", "--config", config, "--shard", "0/2"),
    ]
    log = lab.folder / "other.log"
    misfit = start_logged(lab, log, "agent", "--config", other, "--shard", "1/2")
    bridge = lab.start("bridge", "--config", config, "--pace", "5", "--out", "out")
    lab.wait_until(partial(has_refused, log), END_S)
    ended = lab.finish(bridge, RUN_S)
    assert ended.status == 0, ended
    misfit.send_signal(signal.SIGTERM)
    assert lab.finish(misfit, END_S).status == 0
    stop(lab, *roles, router)
    found = summary(lab.folder / "out")
    assert found["safety"]["overlaps"] == found["safety"]["emergency_brakes"] == 0
    assert found["safety"]["min_gap_m"] > 5.0
    assert found["vehicles"]["left"] == found["vehicles"]["demanded"]
    # The road does not wait for agents that no process starts.
    assert found["runtime"]["tick_ms"]["p99"] < 1000.0
    (refused,) = events(lab.folder / "out", "settings-refused")
    assert refused["process"] == "fleet 1-of-2"
    assert refused["settings"]["formation.gap_m"] == ["15.0", "20.0"]
