"""Targets of kills and pauses, resumes and restarts, and measured failover times."""

from __future__ import annotations

from typing import Any

from attrs import define, field

from laneweave.launch.faults.fault_file import FaultSpec, Kill, Pause
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.observe.road_view import RoadView
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
        names = ("router", *self.coordinators, *(f"agent-{name}" for name in self.agents))
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
    assert faults.unused_faults() == ["the run ended before leader was killed at 5 s"]
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
