"""Vehicles that break down and lanes that are closed while vehicles drive: whole runs."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

import laneweave
from laneweave.protocol.summary import RunSummary
from laneweave.protocol.wire.events import (
    ENTERED,
    LEFT_LATTICE,
    PART_CLOSED,
    PART_OPENED,
    STREAM_PLANNED,
)
from support.deployments import deployment, free_tcp, start_router, stop
from support.harness import Ended, Lab, check_safe_and_complete, events, summary
from support.variants import variants

ROAD = {
    "road": {"s1_m": 50.0, "s2_m": 100.0, "s3_m": 750.0},
    "demand": {"volume_veh_per_lane_h": 1000.0, "duration_s": 80.0},
    "formation": {"operation": "rolling"},
    "tracking": {"shortcut": True},
    "seed": 3,
}
BREAKDOWN = {"at_s": 45.0, "lane": 1, "at_m": 500.0, "for_s": 30.0}
EVENT = {"lane": 1, "from_m": 550.0, "to_m": 600.0, "at_s": 15.0, "until_s": 45.0}


def run(out: Path, faults: dict[str, Any] | None = None, **overrides: object) -> RunSummary:
    scenario = laneweave.load_scenario(ROAD, **overrides)
    found = laneweave.run(scenario, out=out, transport="simulated", faults=faults)
    assert found.safety.overlaps == 0
    return found


@pytest.mark.parametrize(
    "loss", [0.0, pytest.param(0.3, marks=pytest.mark.more)], ids=["", "30 % loss"]
)
def test_the_others_drive_around_a_vehicle_that_breaks_down(tmp_path: Path, loss: float) -> None:
    faults: dict[str, Any] = {"breakdown": [BREAKDOWN]}
    if loss:
        faults["messages"] = [{"loss": loss}]
    found = run(tmp_path / "run", faults)
    assert found.vehicles.left == found.vehicles.demanded
    assert found.obstacles is not None
    (obstacle,) = found.obstacles
    assert (obstacle.cause, obstacle.lane) == ("breakdown", 1)
    assert obstacle.opened_s is not None
    assert obstacle.opened_s >= obstacle.since_s + 30.0
    assert obstacle.vehicle
    # Those that have room to plan for drive around it.
    entered_s = {event["vehicle"]: event["t_s"] for event in events(tmp_path / "run", ENTERED)}
    stopped = {event["vehicle"] for event in events(tmp_path / "run", LEFT_LATTICE)}
    assert len(stopped) == obstacle.stopped + 1
    late = [name for name in stopped if entered_s[name] > obstacle.since_s]
    assert len(late) <= 2 < len(entered_s) - len(late)
    closed = [(one["from_m"], one["to_m"]) for one in events(tmp_path / "run", PART_CLOSED)]
    # While the vehicle slows down, its part is extended: at most to the vehicle ahead.
    assert 2 <= len(closed) <= 5
    assert {from_m for from_m, _ in closed} == {closed[0][0]}
    ends_m = [to_m for _, to_m in closed]
    assert ends_m == sorted(ends_m)
    assert ends_m[-1] - closed[0][0] < 15.0**2 / (2.0 * 3.0) + 10.0
    assert len(events(tmp_path / "run", PART_OPENED)) == 1
    if not loss:  # otherwise the event may be lost
        # The road is planned anew within two seconds.
        planned_s = [event["t_s"] for event in events(tmp_path / "run", STREAM_PLANNED)]
        assert min(t_s for t_s in planned_s if t_s >= obstacle.since_s) <= obstacle.since_s + 2.0


def test_a_part_that_is_closed_ahead_stops_nobody_and_is_used_again(tmp_path: Path) -> None:
    found = run(tmp_path / "run", road__events=(EVENT,))
    assert found.obstacles is not None
    (obstacle,) = found.obstacles
    assert (obstacle.cause, obstacle.stopped, obstacle.opened_s) == ("closed", 0, 45.0)
    recorded = laneweave.load_run(tmp_path / "run").trajectories().to_pydict()
    in_part = [
        t_s
        for t_s, s_m, lane in zip(*(recorded[key] for key in ("t_s", "s_m", "lane")), strict=True)
        if lane == 1 and 550.0 < s_m < 600.0 and t_s > obstacle.since_s
    ]
    assert 45.0 <= min(in_part) <= 55.0


def mean_s(found: RunSummary) -> float:
    assert found.travel_time_s.mean is not None
    return found.travel_time_s.mean


@pytest.mark.more
@pytest.mark.parametrize(("from_m", "speed_mps"), [(500.0, 6.0), (500.0, 10.0)])
def test_the_others_pass_a_slow_vehicle(tmp_path: Path, from_m: float, speed_mps: float) -> None:
    event = {"lane": 1, "from_m": from_m, "to_m": from_m + 7.0, "at_s": 30.0, "for_s": 30.0}
    found = run(tmp_path / "run", road__events=(event | {"speed_mps": speed_mps},))
    alone = run(tmp_path / "alone")
    assert found.vehicles.left == found.vehicles.demanded
    assert found.obstacles is not None
    (obstacle,) = found.obstacles
    assert (obstacle.cause, obstacle.vehicle) == ("passing", "other-1")
    assert obstacle.lowest_speed_mps == speed_mps
    assert obstacle.stopped <= 6
    assert mean_s(found) - mean_s(alone) < 4.0


@pytest.mark.parametrize(
    ("operation", "loss"),
    variants(
        [("rolling", 0.0), ("formations", 0.0), ("rolling", 0.3), ("formations", 0.3)], count=1
    ),
)
def test_the_lane_is_cleared_before_a_fast_vehicle(
    tmp_path: Path, operation: str, loss: float
) -> None:
    event = {"lane": 1, "from_m": 0.0, "to_m": 7.0, "at_s": 30.0, "speed_mps": 25.0}
    faults = {"messages": [{"loss": loss}]} if loss else None
    found = run(tmp_path / "run", faults, road__events=(event,), formation__operation=operation)
    assert found.obstacles is not None
    (obstacle,) = found.obstacles
    assert obstacle.stopped == 0
    assert found.vehicles.left == found.vehicles.demanded
    assert obstacle.opened_s is not None
    # At 25 m/s the road takes 36 s, at the speed of the others 60 s.
    assert obstacle.opened_s - obstacle.since_s < 42.0
    assert obstacle.lowest_speed_mps is not None
    assert obstacle.lowest_speed_mps > 18.0


@pytest.mark.more
def test_equal_seeds_give_equal_runs(tmp_path: Path) -> None:
    faults = {"breakdown": [{"at_s": 20.0, "count": 2, "for_s": 10.0}]}
    first, second = (run(tmp_path / name, faults) for name in ("a", "b"))
    assert first.obstacles == second.obstacles
    assert first.travel_time_s == second.travel_time_s


def test_vehicles_that_do_not_break_down_are_a_failure(lab: Lab) -> None:
    road = lab.path("road.toml", "[demand]\nvolume_veh_per_lane_h = 600\nduration_s = 10\n")
    faults = lab.path("faults.toml", "[[breakdown]]\nat_s = 20\nlane = 1\nat_m = 2000\n")
    ended = lab.run(
        "run", road, "--faults", faults, "--transport", "simulated", "--out", lab.folder / "run"
    )
    assert ended.status == 1
    assert "breakdown: only 0 of 1 vehicles that fit were on the road" in " ".join(
        ended.out.split()
    )


@pytest.mark.parametrize("operation", ["rolling", "formations"])
@pytest.mark.more
def test_with_processes_when_the_leader_is_killed_at_the_same_time(
    lab: Lab, operation: str
) -> None:
    text = f"""seed = 4
[road]
s1_m = 50.0
s2_m = 100.0
s3_m = 600.0
[demand]
volume_veh_per_lane_h = 1000.0
duration_s = 40.0
[formation]
operation = "{operation}"
[runtime]
vehicles_per_process = 1
"""
    road = lab.path("road.toml", text)
    faults = lab.path(
        "faults.toml",
        "[[breakdown]]\nat_s = 25\nlane = 1\nat_m = 250\nfor_s = 20\n"
        '[[kill]]\ntarget = "leader"\nat_s = 25\n',
    )
    folder = lab.folder / "run"
    ended = lab.run("run", road, "--faults", faults, "--out", folder)
    assert (ended.status, ended.complaints) == (0, []), ended
    check_safe_and_complete(folder)
    found = summary(folder)
    assert found["vehicles"]["left"] == found["vehicles"]["demanded"]
    (obstacle,) = found["obstacles"]
    assert obstacle["opened_s"] >= obstacle["since_s"] + 20.0


@pytest.mark.more
def test_an_operator_closes_a_lane_and_opens_it_again(lab: Lab) -> None:
    text = """seed = 3
[road]
s1_m = 50.0
s2_m = 100.0
s3_m = 750.0
[demand]
volume_veh_per_lane_h = 900.0
duration_s = 60.0
[formation]
operation = "rolling"
[tracking]
shortcut = true
[runtime]
vehicles_per_process = 40
max_pace = 3.0
"""
    road, folder = lab.path("road.toml", text), lab.folder / "run"
    run = lab.start("run", road, "--out", folder, "--no-progress", "--pace", "3")
    lab.wait_until(lambda: bool(list(lab.sockets.glob("laneweave-*/router.sock"))))
    at = ("--config", road, "--endpoint", lab.router_endpoint)
    lab.wait_until(lambda: road_time_s(lab, at) > 1.0)
    part = ("--lane", 1, "--from", 600, "--to", 650)
    closed = beside(lab, "road", "close", *part, *at)
    assert closed.status == 0, closed
    assert "lane 1, 600 to 650 m, is closed from" in closed.out
    again = beside(lab, "road", "close", *part, *at)
    assert again.status == 2
    assert "lane 1 is not, 600 to 650 m (closed)" in again.err
    lab.wait_until(lambda: road_time_s(lab, at) > 25.0)
    opened = beside(lab, "road", "open", "--lane", 1, *at)
    assert opened.status == 0, opened
    assert "lane 1, 600 to 650 m, is open again" in opened.out
    nothing = beside(lab, "road", "open", "--lane", 2, *at)
    assert (nothing.status, nothing.err) == (1, "no part of lane 2 is closed there\n")
    ended = lab.finish(run)
    assert ended.status == 0, ended
    check_safe_and_complete(folder)
    (obstacle,) = summary(folder)["obstacles"]
    assert (obstacle["cause"], obstacle["from_m"]) == ("closed", 600.0)
    assert obstacle["opened_s"] > 20.0


def beside(lab: Lab, *arguments: object) -> Ended:
    """Run a command while other processes of the test run."""
    return lab.run_forked(*arguments, alone=False)


def road_time_s(lab: Lab, at: Iterable[object]) -> float:
    """Return the road time that `laneweave status` reports."""
    found = beside(lab, "status", *at, "--seconds", 0.5, "--json")
    road = json.loads(found.out)["road"] if found.out else None
    return float(road["t_s"]) if road else 0.0


def test_a_request_without_a_bridge_or_router_ends_with_one_line(lab: Lab) -> None:
    part = ("--lane", 1, "--from", 600, "--to", 650)
    nobody = beside(lab, "road", "close", *part, "--endpoint", free_tcp())
    assert (nobody.status, len(nobody.err.splitlines())) == (2, 1)
    endpoint = free_tcp()
    config = deployment(lab, endpoint)
    router = start_router(lab, config)
    ended = beside(lab, "road", "close", *part, "--config", config)
    assert (ended.status, ended.out) == (1, "")
    assert ended.err.startswith(f"no bridge answers at {endpoint}, realm ")
    stop(lab, router)
