"""The status of a deployment: coordinators, road, vehicles, health."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from attrs import define, field

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.observe.status import (
    AGENT,
    BRIDGE,
    COORDINATOR,
    LISTENED,
    Plans,
    RoleHealth,
    Status,
    status_of,
)
from laneweave.protocol.runtime.node import Arrived, PeerDown, PeerUp
from laneweave.protocol.runtime.transport import LinkDown
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    CensusEntry,
    ClosedFormation,
    Heartbeat,
    Name,
    RoadClock,
)
from support.states import holding

ELECTION_S = 0.7


@define
class Listener:
    """Listens to a realm from second 0 on."""

    view: RoadView = field(factory=RoadView)

    def heartbeat(
        self, name: str, term: int, now_s: float, *, leading: bool = False, incarnation: int = 1
    ) -> None:
        message = Heartbeat(Name(name), incarnation, term, leading=leading, plans=2)
        self.view.update(Arrived(topics.HEARTBEAT, {"coordinator": name}, message), now_s)

    def coordinator(self, name: str, *, up: bool = True) -> None:
        kind = PeerUp if up else PeerDown
        self.view.update(
            kind(topics.COORDINATOR_ALIVE, {"coordinator": name, "incarnation": "1"}), 0.0
        )

    def bridge(self, *, up: bool = True) -> None:
        kind = PeerUp if up else PeerDown
        self.view.update(kind(topics.BRIDGE_ALIVE, {"incarnation": "7"}), 0.0)

    def agent(self, vehicle: str) -> None:
        self.view.update(PeerUp(topics.VEHICLE_ALIVE, {"vehicle": vehicle}), 0.0)

    def clock(self, tick: int, *, ended: bool = False, bridge: int = 7, on_road: int = 1) -> None:
        message = RoadClock(
            tick, tick / 10, demanded=9, entered=5, on_road=on_road, left=4, ended=ended,
            bridge=bridge,
        )  # fmt: skip
        self.view.update(Arrived(topics.CLOCK, {}, message), tick / 10)

    def census(
        self, tick: int, closed: tuple[ClosedFormation, ...] = (), **entered_s: float
    ) -> None:
        entries = tuple(CensusEntry(Name(one), (0, 0), 0, at) for one, at in entered_s.items())
        message = Census(tick / 10, entries, (), closed, bridge=7)
        self.view.update(Arrived(topics.CENSUS, {}, message), tick / 10)

    def states(self, vehicle: str, ticks: Iterable[int], **changes: object) -> None:
        for tick in ticks:
            values: dict[str, Any] = {"promised": None, "speed_mps": 15.0, "t_s": tick / 10}
            state = holding(Name(vehicle), **values | changes)
            self.view.update(Arrived(topics.STATE, {"vehicle": vehicle}, state), tick / 10)

    def status(self, now_s: float = 2.0) -> Status:
        return status_of(self.view, 0.0, now_s, ELECTION_S)


@pytest.fixture
def listener() -> Listener:
    return Listener()


@pytest.fixture
def healthy(listener: Listener) -> Listener:
    """A deployment that is healthy: c1 leads, and one vehicle drives."""
    listener.coordinator("c1")
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.bridge()
    listener.agent("a")
    for tick in range(100, 121):
        listener.clock(tick)
        if tick == 110:
            listener.census(tick, a=1.0)
        listener.states("a", [tick])
    return listener


def test_an_observer_does_not_slow_publishers_down() -> None:
    assert {topic.quality for topic in LISTENED} == {topics.Quality.LATEST}
    assert {topics.STATE, topics.CLOCK, topics.CENSUS, topics.HEARTBEAT} <= set(LISTENED)


def test_a_healthy_deployment(healthy: Listener) -> None:
    found = healthy.status()
    assert (found.healthy, found.problem) == (True, None)
    assert (found.leader, found.term, found.claims) == ("c1", 3, ("c1",))
    assert found.road is not None
    assert (found.road.t_s, found.road.advanced_s, found.road.pace) == (12.0, 2.0, 1.0)
    assert (found.vehicles.attended, found.vehicles.agents) == (1, 1)
    assert found.messages_per_s["clock"] == 10.5
    found_json = json.loads(json.dumps(found.to_dict()))
    assert found_json["schema"] == "laneweave.status/1"
    assert found_json["plans"] == {
        "in_force": 2, "operation": "formations", "formations": 0, "formations_with_plan": 0,
    }  # fmt: skip


def test_coordinators_without_a_leader(listener: Listener) -> None:
    for name in ("c1", "c2"):
        listener.coordinator(name)
    listener.heartbeat("c1", 3, 1.0, leading=True)  # too long ago
    listener.heartbeat("c2", 3, 1.9)
    assert listener.status().problem == "there is no leader: 2 coordinators found"


def test_two_claims_to_lead_are_shown(listener: Listener) -> None:
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.heartbeat("c2", 4, 1.9, leading=True)
    found = listener.status()
    assert (found.leader, found.term, found.claims) == ("c2", 4, ("c2", "c1"))
    assert found.healthy
    assert not any(one.token for one in found.candidates)


def test_two_coordinators_of_one_name_are_a_problem_unless_one_was_restarted(
    listener: Listener,
) -> None:
    listener.heartbeat("c1", 3, 0.9)
    listener.heartbeat("c1", 3, 1.9, leading=True, incarnation=2)
    assert listener.status().healthy
    listener.heartbeat("c1", 3, 1.9, leading=True)
    assert listener.status().problem == "2 coordinators have the name c1, which must be unique"


def test_a_coordinator_whose_token_vanished_is_no_candidate(listener: Listener) -> None:
    listener.coordinator("c1")
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.coordinator("c1", up=False)
    assert listener.status().candidates == ()
    listener.coordinator("c1")
    assert listener.status().leader == "c1"


def _standing(listener: Listener) -> None:
    listener.clock(5)
    listener.bridge()


def _gone(listener: Listener) -> None:
    for tick in (5, 6):
        listener.clock(tick)


@pytest.mark.parametrize(
    ("happens", "problem"),
    [
        (Listener.bridge, "no clock of the bridge for 2.0 s"),
        (_standing, "the road clock has not advanced beyond 0.5 s for 2.0 s"),
        (_gone, "the bridge disappeared at 0.6 s, before the end of its road"),
        (
            lambda listener: listener.view.update(LinkDown(), 1.0),
            "the connection to the router was lost",
        ),
    ],
)
def test_problems(listener: Listener, happens: Callable[[Listener], None], problem: str) -> None:
    listener.heartbeat("c1", 3, 1.9, leading=True)
    assert listener.status().healthy
    happens(listener)
    assert listener.status().problem == problem


def test_a_road_that_has_ended_is_healthy(listener: Listener) -> None:
    listener.heartbeat("c1", 3, 1.9, leading=True)
    listener.clock(5, ended=True)
    assert listener.status().healthy


def test_attended_and_unattended_vehicles(healthy: Listener) -> None:
    healthy.census(112, a=1.0, b=1.0, c=1.0)
    healthy.states("b", [112], attended=False, accepted=True, promised=Ballot(1, Name("c"), 1, 1))
    vehicles = healthy.status().vehicles
    assert (vehicles.attended, vehicles.unattended, vehicles.unheard) == (1, 1, 1)
    healthy.states("b", [113], owned=((0, 0),))
    assert healthy.status().plans.operation == "rolling"


def test_formations_are_counted_by_their_number(healthy: Listener) -> None:
    assert healthy.status().plans == Plans(2, "formations", 0, 0)
    closed = (ClosedFormation(0, 2, 3.0), ClosedFormation(3, 7, 9.0))
    vehicles = dict.fromkeys("abcd", 1.0)
    healthy.census(112, closed, **vehicles)
    # Vehicles show the column in which they entered; the last one's formation is still open.
    for name, column in zip(vehicles, (0, 2, 5, 8), strict=True):
        healthy.states(name, [112], block=column)
    assert healthy.status().plans == Plans(2, "formations", 2, 0)
    promised = Ballot(1, Name("c"), 1, 1)
    for name, column in (("a", 0), ("b", 2), ("d", 8)):
        healthy.states(name, [113], block=column, accepted=True, promised=promised)
    assert healthy.status().plans == Plans(2, "formations", 2, 1)
    healthy.states("c", [113], block=5, accepted=True, promised=promised)
    assert healthy.status().plans == Plans(2, "formations", 2, 2)


# --- one role ------------------------------------------------------------------------------------


def problem(listener: Listener, health: RoleHealth) -> str | None:
    return health.problem(listener.view, 0.0, 2.0, ELECTION_S)


def test_health_of_a_coordinator(listener: Listener) -> None:
    health = RoleHealth(COORDINATOR, "c2")
    listener.heartbeat("c1", 1, 1.9, leading=True)
    assert problem(listener, health) == "no coordinator c2 found"
    listener.coordinator("c2")
    listener.heartbeat("c2", 1, 1.2)
    assert problem(listener, health) == "no heartbeat of coordinator c2 for 0.7 s"
    listener.heartbeat("c2", 1, 1.4)
    assert problem(listener, health) is None


def test_health_of_a_bridge(listener: Listener) -> None:
    health = RoleHealth(BRIDGE)
    assert problem(listener, health) == "no bridge found"
    listener.bridge()
    listener.clock(5)
    assert problem(listener, health) is not None
    listener.clock(6)
    assert problem(listener, health) is None


def test_health_of_agents(listener: Listener) -> None:
    alone = RoleHealth(AGENT, "a")
    assert problem(listener, alone) == "no agent of a found"
    shard = RoleHealth(AGENT, "0/2", lambda vehicle: vehicle in "ab")
    assert problem(listener, shard) is None
    assert not shard.may_end_early(listener.view)
    listener.census(10, a=0.0, b=0.0, c=0.0)
    assert shard.may_end_early(listener.view)
    assert problem(listener, shard) == "shard 0/2: 2 vehicles without an agent, such as a"
    listener.agent("a")
    listener.agent("b")
    assert problem(listener, alone) is None
    assert problem(listener, shard) is None
    listener.states("b", [10], attended=False)
    assert problem(listener, shard) == "shard 0/2: 1 vehicle without an agent, such as b"
