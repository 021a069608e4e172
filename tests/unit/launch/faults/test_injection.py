"""Targets of kills and pauses, resumes and restarts, and measured failover times."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from attrs import define, field

from laneweave.launch.faults.fault_file import FaultSpec, Kill, Partition, Pause
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.runtime.message_faults import MessageRule
from laneweave.protocol.wire.messages import Census, CensusEntry, Heartbeat, Name
from support.tables import for_each

LEASE_S = 1.0


@define
class FakeRoles:
    """Role control that only records the calls."""

    coordinators: tuple[str, ...] = ("c1", "c2", "c3")
    agents: tuple[str, ...] = ("v1", "v2", "v3", "v4")
    dead: set[str] = field(factory=set)
    done: list[tuple[str, str]] = field(factory=list)

    @property
    def running(self) -> list[str]:
        names = ("router", "bridge", *self.coordinators, *(f"agent-{name}" for name in self.agents))
        return [name for name in names if name not in self.dead]

    def agent_of(self, vehicle: str) -> str | None:
        return f"agent-{vehicle}" if vehicle in self.agents else None

    def kill(self, name: str) -> None:
        assert name in self.running
        self.dead.add(name)
        self.done.append(("kill", name))

    def pause(self, name: str) -> None:
        assert name in self.running
        self.done.append(("pause", name))

    def resume(self, name: str) -> None:
        self.done.append(("resume", name))

    def restart(self, name: str) -> None:
        assert name in self.dead
        self.dead.discard(name)
        self.done.append(("start", name))


def on_road(*vehicles: str, leader: str | None = "c1", incarnation: int = 1) -> RoadView:
    entries = tuple(CensusEntry(Name(vehicle), (0, 0), 0, 0.0) for vehicle in vehicles)
    return RoadView(
        census=Census(0.0, entries, ()),
        leader=Name(leader) if leader is not None else None,
        incarnation=incarnation,
    )


def leads(view: RoadView, name: str, incarnation: int = 1) -> None:
    heartbeat = Heartbeat(Name(name), incarnation, view.term, leading=True, plans=0)
    view.update(heartbeat, 0.0)


def injection(roles: FakeRoles, seed: int = 1, **faults: Any) -> FaultInjection:  # noqa: ANN401
    return FaultInjection(FaultSpec(**faults), seed, roles, LEASE_S)


def test_the_current_leader_is_killed() -> None:
    roles, view = FakeRoles(), on_road(leader="c2")
    faults = injection(roles, kill=(Kill(at_s=5.0),))
    faults.step(4.9, 0.0, view)
    assert roles.done == []
    faults.step(5.0, 0.1, view)
    assert roles.done == [("kill", "c2")]
    assert view.leader is None
    assert faults.injected == [{"t_s": 5.0, "fault": "kill[0]", "killed": "c2"}]
    leads(view, "c2")  # in flight
    faults.step(5.1, 0.2, view)
    assert view.leader is None


def test_a_fault_without_a_target_waits_for_one() -> None:
    roles, view = FakeRoles(), on_road(leader=None)
    faults = injection(roles, kill=(Kill(at_s=5.0),))
    faults.step(5.0, 0.0, view)
    assert roles.done == []
    assert faults.unused_faults() == ["kill[0]: the run ended before leader was killed at 5 s"]
    leads(view, "c3")
    faults.step(5.5, 0.5, view)
    assert roles.done == [("kill", "c3")]
    assert faults.unused_faults() == []


def test_targets_are_found_by_name() -> None:
    roles = FakeRoles()
    kills = tuple(Kill(at_s=1.0, target=name) for name in ("c3", "router", "v2"))
    injection(roles, kill=kills).step(1.0, 0.0, on_road("v2"))
    assert roles.done == [("kill", "c3"), ("kill", "router"), ("kill", "agent-v2")]


@for_each(
    ("target", "names"),
    [("agent", ["agent-v1", "agent-v3", "agent-v4"]), ("coordinator", ["c1", "c2", "c3"])],
)
def test_each_target_is_chosen_at_most_once(target: str, names: list[str]) -> None:
    roles, view = FakeRoles(), on_road("v1", "v3", "v4")
    faults = injection(roles, kill=(Kill(at_s=1.0, target=target, count=4, restart_after_s=0.5),))
    for step in range(10):
        faults.step(1.0 + step, float(step), view)
    assert sorted(name for verb, name in roles.done if verb == "kill") == names
    assert sorted(name for verb, name in roles.done if verb == "start") == names


@pytest.mark.parametrize("times", [{"at_s": 10.0, "every_s": 5.0}, {"between_s": (10.0, 60.0)}])
def test_coordinators_are_killed_again_in_the_next_repetition(times: dict[str, Any]) -> None:
    roles, view = FakeRoles(), on_road()
    kill = Kill(target="coordinator", times=10, restart_after_s=0.5, **times)
    faults = injection(roles, kill=(kill,))
    for step in range(100):
        faults.step(float(step), float(step), view)
    assert len([name for verb, name in roles.done if verb == "kill"]) == 10
    assert faults.finished


def test_the_choice_among_agents_is_drawn_from_the_seed() -> None:
    def killed(seed: int) -> list[tuple[str, str]]:
        roles = FakeRoles()
        faults = injection(roles, seed, kill=(Kill(at_s=1.0, target="agent", count=4),))
        faults.step(1.0, 0.0, on_road("v1", "v2", "v3", "v4"))
        return roles.done

    assert killed(1) == killed(1)
    assert len({tuple(killed(seed)) for seed in range(10)}) > 1


def test_a_coordinator_is_chosen_among_those_that_run() -> None:
    roles = FakeRoles(dead={"c1", "c3"})
    injection(roles, kill=(Kill(at_s=1.0, target="coordinator"),)).step(1.0, 0.0, on_road())
    assert roles.done == [("kill", "c2")]


def test_a_restart_comes_after_wall_clock_time() -> None:
    roles, view = FakeRoles(), on_road()
    faults = injection(roles, kill=(Kill(at_s=5.0, target="router", restart_after_s=3.0),))
    assert faults.wakeup_s is None
    faults.step(5.0, 100.0, view)
    assert faults.wakeup_s == 103.0
    faults.step(5.0, 102.9, view)  # road time stands still without a router
    assert roles.done == [("kill", "router")]
    faults.step(5.0, 103.0, view)
    assert roles.done == [("kill", "router"), ("start", "router")]
    assert faults.wakeup_s is None


def test_a_pause_ends_after_wall_clock_time_and_a_paused_role_is_no_target() -> None:
    roles, view = FakeRoles(), on_road()
    faults = injection(
        roles, pause=(Pause(at_s=5.0, target="c2", for_s=2.0),), kill=(Kill(at_s=5.5, target="c2"),)
    )
    faults.step(5.0, 100.0, view)
    faults.step(5.5, 100.5, view)
    assert roles.done == [("pause", "c2")]
    faults.step(7.0, 102.0, view)
    assert roles.done == [("pause", "c2"), ("resume", "c2"), ("kill", "c2")]


# --- events -----------------------------------------------------------------------------------


Logged = tuple[float, str, str, str, float]
"""Road time, fault, action, target, time of the run."""


def logged_by(faults: FaultInjection) -> list[Logged]:
    """Return a list to which a fault engine adds its events."""
    found: list[Logged] = []

    def log(t_s: float, data: Mapping[str, Any]) -> None:
        assert data["role"] == "launcher"
        found.append((t_s, data["fault"], data["action"], data["target"], data["run_s"]))

    faults.log_event = log
    return found


def test_each_effect_of_a_fault_is_an_event() -> None:
    roles, view = FakeRoles(), on_road()
    faults = injection(
        roles,
        kill=(Kill(at_s=5.0, target="v2", restart_after_s=1.0),),
        pause=(Pause(at_s=6.0, target="c2", for_s=2.0),),
        messages=(MessageRule(loss=0.5, sender="c1", from_s=7.0, until_s=9.0),),
        partition=(Partition(between=("bridge", "others"), from_s=8.0, until_s=9.0),),
    )
    found = logged_by(faults)
    # The road stands from 6 s on for two seconds, and then advances over the end of the windows.
    for road_s, now_s in ((5.0, 100.0), (6.0, 101.0), (6.0, 103.0), (8.0, 103.5), (9.5, 104.0)):
        faults.step(road_s, now_s, view)
    assert found == [
        (5.0, "kill[0]", "killed", "agent-v2", 0.0),
        (6.0, "kill[0]", "restarted", "agent-v2", 1.0),
        (6.0, "pause[0]", "paused", "c2", 1.0),
        (6.0, "pause[0]", "resumed", "c2", 3.0),
        (8.0, "messages[0]", "began", "c1 to all", 3.5),
        (8.0, "partition[0]", "began", "bridge and others", 3.5),
        (9.5, "messages[0]", "ended", "c1 to all", 4.0),
        (9.5, "partition[0]", "ended", "bridge and others", 4.0),
    ]
    # The summary has no rules, and not what a fault undoes.
    assert [one["fault"] for one in faults.injected] == [
        *("kill[0]", "pause[0]", "partition[0]", "partition[0]")
    ]


def test_a_window_between_two_steps_is_not_lost() -> None:
    faults = injection(FakeRoles(), messages=(MessageRule(loss=1.0, from_s=5.1, until_s=5.2),))
    found = logged_by(faults)
    for road_s in (5.0, 6.0, 7.0):
        faults.step(road_s, road_s, on_road())
    assert [(t_s, action) for t_s, _, action, *_ in found] == [(6.0, "began"), (6.0, "ended")]


def test_a_paused_process_that_has_exited_is_not_resumed() -> None:
    roles = FakeRoles()
    faults = injection(roles, pause=(Pause(at_s=5.0, target="c2", for_s=2.0),))
    found = logged_by(faults)
    faults.step(5.0, 100.0, on_road())
    roles.dead.add("c2")
    faults.step(7.0, 102.0, on_road())
    assert [action for _, _, action, *_ in found] == ["paused"]


def test_the_killed_bridge_ends_the_run() -> None:
    roles = FakeRoles()
    faults = injection(roles, kill=(Kill(at_s=5.0, target="bridge"),))
    found = logged_by(faults)
    faults.step(4.0, 0.0, on_road())
    assert faults.end == ""
    faults.step(5.0, 1.0, on_road())
    assert faults.end == "the bridge was killed at 5.0 s by kill[0]"
    assert roles.done == [("kill", "bridge")]
    assert found == [(5.0, "kill[0]", "killed", "bridge", 1.0)]


@for_each(
    ("names", "agents", "unused"),
    [
        (("c1", "v1"), ("v1",), []),
        (("c1", "v1"), (), ["messages[0]: c1 and v1 did not run while it was in force"]),
        (("c9", "vehicle"), ("v1",), ["messages[0]: c9 did not run while it was in force"]),
    ],
)
def test_a_rule_for_a_process_that_never_runs_is_unused(
    names: tuple[str, str], agents: tuple[str, ...], unused: list[str]
) -> None:
    roles = FakeRoles(agents=())
    rule = MessageRule(loss=1.0, between=names, from_s=5.0, until_s=8.0)
    faults = injection(roles, messages=(rule,))
    faults.step(6.0, 0.0, on_road())
    roles.agents = agents
    faults.step(7.0, 1.0, on_road())
    roles.agents = ("v1", "v2")
    faults.step(9.0, 3.0, on_road())
    assert faults.unused_faults() == unused


# --- recovery -------------------------------------------------------------------------------------


@for_each(
    ("fault", "heartbeats", "recovery_s"),
    [
        # What is in flight of the killed leader does not count, and nothing counts twice.
        (Kill(at_s=5.0), [(100.1, "c1", 1), (100.3, "c2", 1), (101.0, "c3", 1)], [0.3]),
        # A leader that was started again is another one.
        (Kill(at_s=5.0, restart_after_s=0.5), [(100.6, "c1", 1), (101.5, "c1", 2)], [1.5]),
        (Pause(at_s=5.0, for_s=4.0), [(101.2, "c2", 1)], [1.2]),
        # Within the lease, or when it resumes before another one leads, it stays the leader.
        (Pause(at_s=5.0, for_s=LEASE_S), [(101.2, "c2", 1)], []),
        (Pause(at_s=5.0, for_s=1.5), [(101.6, "c1", 1), (109.0, "c2", 1)], []),
    ],
)
def test_recovery_is_measured_until_another_process_leads(
    fault: Kill | Pause, heartbeats: list[tuple[float, str, int]], recovery_s: list[float]
) -> None:
    roles, view = FakeRoles(), on_road(leader="c1")
    is_kill = isinstance(fault, Kill)
    faults = injection(roles, kill=(fault,)) if is_kill else injection(roles, pause=(fault,))
    faults.step(5.0, 100.0, view)
    assert (view.leader == "c1") is (isinstance(fault, Pause) and fault.for_s == LEASE_S)
    for now_s, leader, incarnation in heartbeats:
        faults.step(now_s - 95.0, now_s - 0.05, view)
        leads(view, leader, incarnation)
        faults.step(now_s - 95.0, now_s, view)
    assert faults.failover.recovery_s == recovery_s
