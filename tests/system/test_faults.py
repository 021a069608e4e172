"""Faults on real processes: messages, kills, pauses, partitions. Nobody collides, runs go on."""

from __future__ import annotations

import re
import signal
from pathlib import Path
from typing import Any

import psutil
import pytest

from laneweave.protocol.scenario.deployment_fields import Shard
from support.deployments import ask, deployment, free_tcp, start_router, stop
from support.harness import (
    DEMAND,
    END_S,
    RUN_S,
    SHORT_ROAD,
    Lab,
    check_safe_and_complete,
    events,
    final_lanes,
    log_lines,
    plans,
    summary,
)
from support.service_lab import request
from system.conftest import FinishedRun

BLACKOUT_ROAD = """\
schema = "laneweave.scenario/1"

[road]
s2_m = 20.0
s3_m = 160.0

[runtime]
agent_start_s = 1.0
agent_silent_s = 1.0
tick_deadline_s = 0.1
"""
"""Short: when nobody answers, a road second takes a second."""
QUICK_TICKS = """
[runtime]
tick_resend_s = 0.005
tick_deadline_s = 0.02
"""
"""At 50 % loss each tick takes as long as it may."""


@pytest.fixture
def short(lab: Lab) -> Path:
    """A scenario with a shorter road."""
    return lab.path("short.toml", SHORT_ROAD)


def run_with(lab: Lab, road: Path, faults: str | Path, *options: str) -> dict[str, Any]:
    """Run with faults, check the promises, and return the summary."""
    folder = lab.folder / "out"
    ended = lab.run("run", road, *DEMAND, *options, "--faults", faults, "--out", folder)
    assert ended.status == 0, ended
    check_safe_and_complete(folder)
    return summary(folder)


def injected(found: dict[str, Any], verb: str) -> list[str]:
    return [one[verb] for one in found["faults"]["injected"] if verb in one]


def test_half_of_all_messages_are_lost(lab: Lab) -> None:
    road = lab.path("quick.toml", SHORT_ROAD + QUICK_TICKS)

    found = run_with(lab, road, "lossy50", "--duration", "7")

    # A message has one receiver or more, and the reports that count those published are lost too.
    published, dropped = found["messages"]["published"], found["messages"]["dropped_by_faults"]
    assert dropped > published / 4
    assert found["faults"]["injected"] == []


def test_messages_by_radio(lab: Lab) -> None:
    """A loaded channel loses many; fleets decide for each of their vehicles."""
    radio = '\n[radio]\ntechnology = "802.11p"\nother_senders_per_km = 400.0\n'
    road, folder = lab.path("radio.toml", SHORT_ROAD + radio), lab.folder / "out"

    options = ("--duration", "12", "--vehicles-per-process", "4", "--pace", "5")
    ended = lab.run("run", road, *DEMAND, *options, "--out", folder)

    assert ended.status == 0, ended
    check_safe_and_complete(folder)
    found = summary(folder)
    vehicles, messages = found["vehicles"], found["messages"]
    assert vehicles["on_preferred_lane"] == vehicles["left"] > 0
    for channel in ("sidelink", "cellular"):
        assert 0 < messages[f"{channel}_lost"] < messages[channel] / 2
    assert messages["dropped_by_faults"] == 0


@pytest.mark.more
def test_nothing_arrives_from_the_start(lab: Lab) -> None:
    road = lab.path("blackout.toml", BLACKOUT_ROAD)
    faults = lab.path("faults.toml", "[[messages]]\nloss = 1.0\n")

    found = run_with(lab, road, faults, "--duration", "7")

    # Cells are safe without a word; nobody was told where to go.
    assert found["planning"]["plans"] == 0
    assert found["messages"]["dropped_by_faults"] > 0


def test_a_leader_that_is_killed_is_replaced(
    finished_run: FinishedRun, lab: Lab, road: Path
) -> None:
    killed_at_s = 13.0
    faults = lab.path("faults.toml", f"[[kill]]\nat_s = {killed_at_s}\n")
    folder = lab.folder / "out"

    # Slow enough that an election takes a second or two of road time, not ten.
    found = run_with(lab, road, faults, "--pace", "5", "--vehicles-per-process", "4")

    assert final_lanes(folder) == final_lanes(finished_run("simulated"))
    leaders = {event["coordinator"] for event in events(folder, "leader")}
    assert len(leaders) > 1
    (recovery_s,) = found["failover"]["recovery_s"]
    assert 0 < recovery_s < RUN_S
    assert found["failover"]["leader_changes"] >= 1
    # It was killed while plans were made.
    made = plans(folder)
    planned_s = [event["t_s"] for event in made]
    assert min(planned_s) < killed_at_s < max(planned_s)
    # Both leaders planned for formations, and every vehicle got its path.
    makers = {event["name"] for event in made}
    assert 1 < len(makers) <= len(leaders)
    assert makers <= leaders
    assert {event["kind"] for event in made} == {"plan-made"}
    assert {(event["solver"], event["status"]) for event in made} == {("branching", "optimal")}
    assert sum(event["vehicles"] for event in made) >= found["vehicles"]["entered"]
    assert found["planning"]["by_solver"]["branching"] == len(made)
    assert [line for line in log_lines(folder) if line["level"] == "error"] == []


@pytest.mark.more
def test_agents_are_killed_and_all_but_one_started_again(lab: Lab, short: Path) -> None:
    """An agent that stays dead is no failure of the run."""
    faults = lab.path(
        "faults.toml",
        '[[kill]]\ntarget = "v0003"\nat_s = 7\n'
        '[[kill]]\ntarget = "agent"\ncount = 3\nbetween_s = [8, 20]\nrestart_after_s = 0.2\n',
    )

    found = run_with(lab, short, faults, "--pace", "6")

    folder = lab.folder / "out"
    dead, *restarted = injected(found, "killed")
    assert dead == "agent-v0003"
    assert len(set(restarted)) == 3
    taken_over = {event["vehicle"] for event in events(folder, "agent-took-over")}
    assert taken_over >= {name.removeprefix("agent-") for name in restarted}
    assert "v0003" not in taken_over
    assert "v0003" in {event["vehicle"] for event in events(folder, "caretaker-took-over")}


@pytest.mark.more
def test_a_leader_that_is_paused_is_replaced_and_comes_back(
    finished_run: FinishedRun, lab: Lab, road: Path
) -> None:
    """Its buffers fill while it sleeps; nobody may wait for it, and it comes back as a zombie.

    Before that, a coordinator that does not lead is killed, which changes nothing.
    """
    faults = lab.path(
        "faults.toml",
        '[[kill]]\ntarget = "c3"\nat_s = 11\n[[pause]]\nat_s = 12\nfor_s = 2.5\n',
    )

    found = run_with(lab, road, faults, "--pace", "5")

    assert injected(found, "killed") == ["c3"]
    assert injected(found, "paused") == ["c1"]
    (recovery_s,) = found["failover"]["recovery_s"]
    assert recovery_s > 0.0
    leaders = [event["coordinator"] for event in events(lab.folder / "out", "leader")]
    assert len(set(leaders)) > 1
    # To another one and back again, once.
    assert found["failover"]["leader_changes"] <= 2
    assert events(lab.folder / "out", "agent-silent") == []
    assert final_lanes(lab.folder / "out") == final_lanes(finished_run("simulated"))


@pytest.mark.more
def test_the_router_is_killed_and_two_groups_are_cut_from_each_other(lab: Lab, short: Path) -> None:
    faults = lab.path(
        "faults.toml",
        '[[kill]]\ntarget = "router"\nat_s = 9\nrestart_after_s = 1\n'
        '[[partition]]\nbetween = ["vehicles", "coordinators"]\nfrom_s = 14\nuntil_s = 20\n',
    )

    found = run_with(lab, short, faults, "--pace", "6")

    assert injected(found, "killed") == ["router"]
    # The network came back: somebody was told where to go after it.
    planned_s = [event["t_s"] for event in plans(lab.folder / "out")]
    assert max(planned_s) > 9.0
    assert found["faults"]["partition_methods"] == {"partition[0]": "messages"}
    assert found["messages"]["dropped_by_faults"] > 0


@pytest.mark.more
def test_each_group_is_cut_off_for_some_time(lab: Lab, short: Path) -> None:
    windows = {"coordinators": (8, 12), "vehicles": (14, 15), "bridge": (18, 19)}
    faults = lab.path(
        "faults.toml",
        "".join(
            f'[[partition]]\nbetween = ["{group}", "others"]\nfrom_s = {begin}\nuntil_s = {end}\n'
            for group, (begin, end) in windows.items()
        ),
    )
    before = sorted(path.name for path in Path("/sys/class/net").iterdir())

    found = run_with(lab, short, faults, "--pace", "4", "--vehicles-per-process", "8")

    assert injected(found, "partition") == ["began", "ended"] * 3
    assert sorted(path.name for path in Path("/sys/class/net").iterdir()) == before
    methods = set(found["faults"]["partition_methods"].values())
    if reason := found["faults"].get("why_no_namespaces"):
        assert methods == {"messages"}
        pytest.skip(f"ran with messages, since no network namespaces can be had here: {reason}")
    assert methods == {"namespaces"}
    # Links are cut below the messages: none was taken by a rule.
    assert found["messages"]["dropped_by_faults"] == 0
    # The bridge lost sight of its agents, and drives those that are left in their stead.
    assert events(lab.folder / "out", "caretaker-took-over")


@pytest.mark.more
def test_rules_between_single_processes(lab: Lab, short: Path) -> None:
    """The agent that hears nothing of the road is the only one that a caretaker replaces."""
    faults = lab.path(
        "faults.toml",
        '[[messages]]\nfrom = "bridge"\nto = "v0003"\nloss = 1\nuntil_s = 20\n'
        '[[messages]]\nbetween = ["v0001", "v0002"]\nloss = 1\n'
        '[[messages]]\nfrom = "c1"\nto = "v0005"\nloss = 1\n'
        '[[pause]]\ntarget = "c2"\nat_s = 9\nfor_s = 0.5\n'
        '[[kill]]\ntarget = "v0004"\nat_s = 9\nrestart_after_s = 0.2\n',
    )

    found = run_with(lab, short, faults, "--pace", "5", "--duration", "10")

    folder = lab.folder / "out"
    assert found["messages"]["dropped_by_faults"] > 0
    silent = {event["vehicle"] for event in events(folder, "agent-silent")}
    assert silent == {"v0003"}
    injected = events(folder, "fault-injected")
    assert {(one["fault"], one["action"], one["target"]) for one in injected} == {
        ("messages[0]", "began", "bridge to v0003"),
        ("messages[0]", "ended", "bridge to v0003"),
        ("messages[1]", "began", "v0001 and v0002"),
        ("messages[2]", "began", "c1 to v0005"),
        ("pause[0]", "paused", "c2"),
        ("pause[0]", "resumed", "c2"),
        ("kill[0]", "killed", "agent-v0004"),
        ("kill[0]", "restarted", "agent-v0004"),
    }
    assert [one["run_s"] for one in injected] == sorted(one["run_s"] for one in injected)


@pytest.mark.more
def test_a_run_ends_with_its_killed_bridge(lab: Lab, short: Path) -> None:
    faults = lab.path("faults.toml", '[[kill]]\ntarget = "bridge"\nat_s = 12\n')
    folder = lab.folder / "out"

    ended = lab.run(
        *("run", short, *DEMAND, "--pace", "3", "--vehicles-per-process", "8"),
        *("--faults", faults, "--out", folder),
    )

    assert ended.status == 1
    (line,) = [line for line in ended.out.splitlines() if line.startswith("FAILED: ")]
    assert re.fullmatch(r"FAILED: the bridge was killed at 12\.\d s by kill\[0\]", line)
    assert summary(folder)["ending"] == "unfinished"
    (event,) = events(folder, "fault-injected")
    assert (event["action"], event["target"]) == ("killed", "bridge")
    assert lab.run("repair", folder).status == 0
    lab.check_nothing_left()


@pytest.mark.more
def test_a_fault_that_never_came_fails_the_run(lab: Lab, short: Path) -> None:
    faults = lab.path(
        "faults.toml", "[[kill]]\nat_s = 5000\n[[messages]]\nloss = 1\nfrom_s = 6000\n"
    )

    ended = lab.run(
        *("run", short, *DEMAND, "--duration", "2", "--transport", "simulated"),
        *("--faults", faults, "--out", lab.folder / "out"),
    )

    assert ended.status == 1
    assert "FAILED: kill[0]: the run ended before leader was killed at 5000 s" in ended.out
    assert "FAILED: messages[0]: the run ended before it came into force at 6000 s" in ended.out


@pytest.mark.more
def test_no_process_stays_paused_when_the_launcher_is_killed(lab: Lab, short: Path) -> None:
    faults = lab.path(
        "faults.toml", '[[pause]]\ntarget = "agent"\ncount = 2\nat_s = 8\nfor_s = 500\n'
    )
    process = lab.start("run", short, *DEMAND, "--faults", faults, "--out", "out")

    def paused() -> int:
        assert process.poll() is None, process.communicate()
        return sum(_is_stopped(one) for one in lab.processes())

    lab.wait_until(lambda: paused() == 2)
    process.kill()

    lab.wait_until(lambda: not lab.processes(), END_S)


def _is_stopped(process: psutil.Process) -> bool:
    try:
        return process.status() == psutil.STATUS_STOPPED
    except psutil.Error:
        return False


@pytest.mark.more
def test_links_lose_packets(lab: Lab, short: Path) -> None:
    faults = lab.path("faults.toml", "[[link]]\nloss = 0.02\nfrom_s = 5\nuntil_s = 15\n")
    folder = lab.folder / "out"
    ended = lab.run("run", short, *DEMAND, "--faults", faults, "--out", folder,
                    "--pace", "4", "--vehicles-per-process", "8")  # fmt: skip
    if "link[0]: " in ended.err:
        pytest.skip(f"there can be no links that lose packets here: {ended.err}")
    assert ended.status == 0, ended
    check_safe_and_complete(folder)
    found = summary(folder)
    assert injected(found, "link") == ["began", "ended"]
    assert found["messages"]["dropped_by_faults"] == 0


@pytest.mark.more
def test_faults_of_a_deployment_by_hand(lab: Lab) -> None:
    """Only processes of the realm get signals; what is paused is resumed on Ctrl-C."""
    config = deployment(lab, free_tcp())
    other = lab.path("other.toml", config.read_text(encoding="utf-8").replace("test", "other"))
    faults = lab.path(
        "faults.toml",
        '[[pause]]\ntarget = "c1"\nat_s = 5\nfor_s = 0.5\n'
        '[[kill]]\ntarget = "c3"\nat_s = 6\n'
        '[[kill]]\ntarget = "v0002"\nat_s = 8\n'
        '[[pause]]\ntarget = "c2"\nat_s = 10\nfor_s = 500\n',
    )
    router = start_router(lab, config)
    one, two = (lab.start("coordinator", "--config", config, "--name", c) for c in ("c1", "c2"))
    stranger = lab.start("coordinator", "--config", other, "--name", "c3")
    agents = [lab.start("agent", "--config", config, "--shard", f"{i}/2") for i in range(2)]
    index = int(Shard(1, 2).contains("v0002"))
    killed, rest = agents[index], agents[1 - index]
    lab.wait_until(lambda: ask(lab, config, request()).status == 0, END_S)
    command = lab.start("faults", "apply", faults, "--config", config)
    bridge = lab.start("bridge", "--config", config, "--pace", "3", "--out", "out")

    lab.wait_until(lambda: _is_stopped(psutil.Process(two.pid)))
    command.send_signal(signal.SIGINT)
    ended = lab.finish(command, END_S)

    assert ended.status == 1
    assert ended.err.splitlines()[-1] == "interrupted"
    assert "kill[0] waits for c3 on this host" in ended.err
    assert not _is_stopped(psutil.Process(two.pid))
    assert killed.wait(END_S) == -signal.SIGKILL
    assert stranger.poll() is None
    done = [line.split(": ", 1)[1] for line in ended.out.splitlines()]
    assert done == [
        f"pause[0]: c1 (process {one.pid}) paused",
        *sorted(done[1:3], reverse=True),
        f"pause[1]: c2 (process {two.pid}) paused",
        f"pause[1]: c2 (process {two.pid}) resumed",
    ]
    assert set(done[1:3]) == {
        f"pause[0]: c1 (process {one.pid}) resumed",
        f"kill[1]: fleet-{index}-of-2 (process {killed.pid}) killed",
    }
    lab.wait_until(lambda: len(events(lab.folder / "out", "fault-injected")) == len(done), END_S)
    bridge.send_signal(signal.SIGTERM)
    assert lab.finish(bridge, END_S).status == 0
    stop(lab, rest, one, two, stranger, router)
    lab.check_nothing_left()


def test_faults_that_are_not_possible_from_outside(lab: Lab) -> None:
    faults = lab.path("faults.toml", '[[messages]]\nfrom = "c1"\nto = "v0003"\nloss = 1\n')
    ended = lab.run_forked("faults", "apply", faults, "--endpoint", free_tcp())
    assert ended.status == 2
    (line,) = ended.err.splitlines()
    assert line.startswith("messages: got a table; allowed: nothing from outside: ")
