"""The leader is killed in the middle of its work; another one goes on."""

from __future__ import annotations

from pathlib import Path

from support.harness import (
    DEMAND,
    RUN_S,
    Lab,
    check_safe_and_complete,
    events,
    final_lanes,
    log_lines,
    plans,
    summary,
)
from system.conftest import FinishedRun

KILLED_AT_S = 13.0


def test_another_leader_takes_over(finished_run: FinishedRun, lab: Lab, road: Path) -> None:
    faults = lab.path("faults.toml", f'[[kill]]\ntarget = "leader"\nat_s = {KILLED_AT_S}\n')
    folder = lab.folder / "out"

    # Slow enough that an election takes a second or two of road time, not ten.
    ended = lab.run("run", road, *DEMAND, "--faults", faults, "--pace", "5", "--out", folder)

    assert ended.status == 0, ended
    check_safe_and_complete(folder)
    assert final_lanes(folder) == final_lanes(finished_run("simulated"))
    leaders = [event["coordinator"] for event in events(folder, "leader")]
    assert len(set(leaders)) > 1
    recoveries = summary(folder)["failover"]["recovery_s"]
    assert len(recoveries) == 1
    assert 0 < recoveries[0] < RUN_S
    assert summary(folder)["failover"]["leader_changes"] >= 1
    # It was killed in the middle of it.
    made = plans(folder)
    planned_s = [event["t_s"] for event in made]
    assert min(planned_s) < KILLED_AT_S < max(planned_s)
    # Each of the two planned as the paper does, for formations, and every vehicle got its path.
    makers = {event["name"] for event in made}
    assert makers == set(leaders)
    assert {event["kind"] for event in made} == {"plan-made"}
    assert {(event["solver"], event["status"]) for event in made} == {("tappa", "optimal")}
    assert sum(event["vehicles"] for event in made) >= summary(folder)["vehicles"]["entered"]
    assert summary(folder)["planning"]["by_solver"]["tappa"] == len(made)
    assert [line for line in log_lines(folder) if line["level"] == "error"] == []


def test_a_killed_candidate_has_no_effect(finished_run: FinishedRun, lab: Lab, road: Path) -> None:
    faults = lab.path("faults.toml", f'[[kill]]\ntarget = "c3"\nat_s = {KILLED_AT_S}\n')
    folder = lab.folder / "out"

    ended = lab.run(
        *("run", road, *DEMAND, "--vehicles-per-process", "8"),
        *("--faults", faults, "--out", folder),
    )

    assert ended.status == 0, ended
    check_safe_and_complete(folder)
    assert final_lanes(folder) == final_lanes(finished_run("simulated"))
