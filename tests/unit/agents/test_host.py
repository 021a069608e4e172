"""Several agents in one process: dispatch of events, shards, and the end of the process."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.agents.host import NO_BRIDGE_S, RETURN_S, AgentHost, AgentMetrics
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime import node
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.messages import (
    Announcement,
    Census,
    CensusEntry,
    Command,
    Name,
    Prepare,
    VehicleState,
)
from laneweave.protocol.wire.obstacle_messages import Obstacle, Obstacles
from laneweave.protocol.wire.process_messages import Report
from support.paper import PAPER
from support.states import BALLOT, make_plan, sense_in, sent

A, B, C = Name("A"), Name("B"), Name("C")
FRONT: Cell = (0, 0)
"""In formation 0; the next block begins at column -4."""
SIDE: Cell = (-1, 1)
"""Likewise."""
PROCESS = Name("p")
ADDRESSED_TO_IT = [
    node.Listen(topic, {"process": PROCESS})
    for topic in (topics.SENSE, topics.PREPARE, topics.PLAN)
]
STATES_OF_0 = topics.STATE, {"block": 0}


def make_host(*vehicles: Name, shard: Shard | None = None) -> AgentHost:
    return AgentHost(
        PROCESS, lambda name: AgentCore(name, lambda: 1, PAPER), 1, PAPER.runtime, vehicles, shard
    )


def token(vehicle: Name) -> dict[str, Name]:
    return {"process": PROCESS, "vehicle": vehicle}


def give(host: AgentHost, event: node.Event, now_s: float = 0.0) -> list[node.Effect]:
    return list(host.handle(event, now_s))


def vehicles_of(host: AgentHost) -> int:
    (metrics,) = host.metrics
    assert isinstance(metrics, AgentMetrics)
    return metrics.vehicles


def hand(host: AgentHost, topic: topics.Topic, vehicle: Name, message: object) -> list[node.Effect]:
    return give(host, node.Arrived(topic, token(vehicle), message))


def feel(
    host: AgentHost,
    vehicle: Name,
    cell: Cell = FRONT,
    tick: int = 1,
    **more: Any,  # noqa: ANN401 (fields)
) -> list[node.Effect]:
    """Send a vehicle its SENSE; its agent is in charge, unless another process is given."""
    felt = sense_in(cell, tick, vehicle=vehicle, **({"incarnation": 1} | more))
    return hand(host, topics.SENSE, vehicle, felt)


def show(host: AgentHost, state: VehicleState) -> list[node.Effect]:
    """Bring the host a state of a vehicle, as the network does."""
    key = {"block": str(state.block), "vehicle": state.vehicle}
    return give(host, node.Arrived(topics.STATE, key, state))


def census(
    *announced: Name, on_road: Iterable[Name] = (), t_s: float = 1.0, bridge: int = 0
) -> node.Arrived:
    entries = tuple(CensusEntry(name, FRONT, 0, 0.0) for name in on_road)
    announcements = tuple(Announcement(name, 0, 0, 5.0) for name in announced)
    return node.Arrived(topics.CENSUS, {}, Census(t_s, entries, announcements, bridge=bridge))


def accept(
    host: AgentHost, cells: dict[Name, Cell], formations: tuple[int, ...] = (0,)
) -> list[node.Effect]:
    """Let all vehicles of a roster promise and accept a plan without moves, in the first tick."""
    effects: list[node.Effect] = []
    for name in cells:
        effects += hand(host, topics.PREPARE, name, Prepare(BALLOT, formations, tuple(cells)))
    plan = make_plan(cells, blocks=formations)
    for name, cell in cells.items():
        effects += hand(host, topics.PLAN, name, plan)
        effects += feel(host, name, cell, joined=formations, accepted=BALLOT)
    return effects


def test_events_go_to_the_vehicle_that_they_concern() -> None:
    host = make_host(A, B)
    started = give(host, node.Started())
    # Last the tokens: a process that sees one may rely on the subscriptions.
    tokens = [node.Announce(topics.VEHICLE_ALIVE, token(name)) for name in (A, B)]
    assert started[-5:] == [*ADDRESSED_TO_IT, *tokens]
    effects = feel(host, B, SIDE)
    assert [each.vehicle for each in sent(effects, Command)] == [B]
    assert [each.vehicle for each in sent(effects, VehicleState)] == [B]
    feel(host, A)
    effects = hand(host, topics.PREPARE, A, Prepare(BALLOT, (0,), (A, B)))
    assert [(s.vehicle, s.record.promised) for s in sent(effects, VehicleState)] == [(A, BALLOT)]
    assert feel(host, C) == []


@pytest.mark.parametrize("formation", [0, 1])
def test_states_go_to_the_members_of_their_formation(formation: int) -> None:
    host = make_host(A, B, C)
    for name, cell in ((A, FRONT), (B, SIDE), (C, (-4, 0))):
        feel(host, name, cell)
    *_, last = sent(accept(host, {A: FRONT, B: SIDE}), VehicleState)
    assert (last.vehicle, last.ready) == (B, True)
    show(host, replace(last, block=formation))
    (state,) = sent(feel(host, A, FRONT, 2), VehicleState)
    assert state.go is (formation == 0)  # A has heard B
    (state,) = sent(feel(host, B, SIDE, 2), VehicleState)
    assert not state.go  # B has not heard A


def test_a_vehicle_that_has_not_received_a_message_does_not_know_of_it() -> None:
    """Over a radio, vehicles of one process do not all hear the same."""
    host = make_host(A, B, C)
    cells: dict[Name, Cell] = {A: FRONT, B: SIDE, C: (-2, 2)}
    for name, cell in cells.items():
        feel(host, name, cell)
    states = sent(accept(host, cells), VehicleState)
    last = {state.vehicle: state for state in states if state.ready}
    assert host.listeners(last[C]) == [A, B]  # not C itself
    assert host.listeners(replace(last[C], block=1)) == []
    for state in last.values():
        event = node.Arrived(topics.STATE, token(state.vehicle), state, frozenset({A}))
        give(host, event)
    for name, goes in ((A, True), (B, False)):
        (state,) = sent(feel(host, name, cells[name], 2), VehicleState)
        assert state.go is goes


@pytest.mark.parametrize(("rear", "formations"), [(SIDE, (0,)), ((-4, 0), (0, 1))])
def test_host_subscribes_to_all_formations_of_a_plan_while_an_agent_waits(
    rear: Cell, formations: tuple[int, ...]
) -> None:
    host = make_host(A, B)
    cells: dict[Name, Cell] = {A: FRONT, B: rear}
    for name, cell in cells.items():
        assert node.Listen(*STATES_OF_0) not in feel(host, name, cell, joined=formations)
    effects = accept(host, cells, formations)
    assert [effect for effect in effects if isinstance(effect, node.Listen)] == [
        node.Listen(topics.STATE, {"block": each}) for each in formations
    ]
    first, second = (state for state in sent(effects, VehicleState) if state.accepted)
    assert (first.block, second.block) == (0, formations[-1])
    assert show(host, first) == show(host, second) == []
    (state,) = sent(feel(host, A, FRONT, 2, joined=formations), VehicleState)
    assert state.go
    effects = feel(host, B, rear, 2, joined=formations)
    assert [effect for effect in effects if isinstance(effect, node.Unlisten)] == [
        node.Unlisten(topics.STATE, {"block": each}) for each in formations
    ]


def test_an_agent_that_lost_charge_waits_for_no_states() -> None:
    host = make_host(A)
    feel(host, A)
    assert node.Listen(*STATES_OF_0) in accept(host, {A: FRONT, B: SIDE})
    effects = feel(host, A, FRONT, 2, incarnation=9)
    assert [e for e in effects if getattr(e, "topic", None) is not topics.MOTION] == [
        node.Unlisten(*STATES_OF_0)
    ]


def test_ends_when_the_last_vehicle_has_left() -> None:
    host = make_host(A, B)
    for name in (A, B):
        feel(host, name)
    feel(host, A, FRONT, 2, left=True)
    assert host.wakeup_s != RETURN_S
    feel(host, B, FRONT, 2, left=True)
    # It may have been told in error.
    assert host.wakeup_s == RETURN_S
    assert give(host, node.Wakeup(), RETURN_S) == [node.End()]


def test_an_agent_comes_back_that_was_told_in_error_that_its_vehicle_has_left() -> None:
    host = make_host(A)
    give(host, node.Started())
    feel(host, A)
    told = feel(host, A, FRONT, 2, left=True)
    report, withdrawal = (each for each in told if not isinstance(each, node.Unlisten))
    assert isinstance(report, node.Send)
    assert report.topic is topics.REPORT
    assert withdrawal == node.Withdraw(topics.VEHICLE_ALIVE, token(A))
    assert feel(host, A, FRONT, 2) == feel(host, A, FRONT, 1) == []  # late
    back = feel(host, A, FRONT, 3)
    assert node.Announce(topics.VEHICLE_ALIVE, token(A)) in back
    assert topics.COMMAND in [getattr(effect, "topic", None) for effect in back]
    assert vehicles_of(host) == 1
    assert host.wakeup_s == NO_BRIDGE_S  # the process does not end


def test_an_agent_of_a_shard_comes_back_if_the_census_lists_its_vehicle_for_long() -> None:
    host = make_host(shard=Shard(0, 1))
    give(host, census(on_road=[A]))
    feel(host, A)
    feel(host, A, FRONT, 2, left=True)
    assert give(host, census(on_road=[A]), 0.9 * RETURN_S) == []
    back = give(host, census(on_road=[A]), RETURN_S)
    assert node.Announce(topics.VEHICLE_ALIVE, token(A)) in back
    feel(host, A, FRONT, 3, left=True)
    assert give(host, census(), 1.0) == []
    assert vehicles_of(host) == 0


def test_what_agents_have_counted_stays_when_they_end() -> None:
    host = make_host(A, B)
    (before,) = host.metrics
    assert before == AgentMetrics(
        vehicles=2, vehicles_in_charge=0, solves_total=0, unusable_total=0
    )
    for name in (A, B):
        feel(host, name)
    (driving,) = host.metrics
    assert driving == evolve(before, vehicles_in_charge=2, solves_total=2)
    feel(host, A, FRONT, 2, left=True)
    (after,) = host.metrics
    assert after == evolve(driving, vehicles=1, vehicles_in_charge=1)


def test_an_agent_that_ends_waits_for_no_states() -> None:
    host = make_host(A)
    feel(host, A)
    accept(host, {A: FRONT, B: SIDE})  # A waits for B's state
    effects = feel(host, A, FRONT, 2, left=True)
    assert effects[-1] == node.Unlisten(*STATES_OF_0)


@pytest.mark.parametrize("strangers", [[], ["ghost"]])
def test_ends_when_no_bridge_comes(strangers: list[str]) -> None:
    host = make_host(A)
    give(host, node.Started(), 10.0)
    for stranger in strangers:
        give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": stranger}), 11.0)
    assert host.wakeup_s == 10.0 + NO_BRIDGE_S
    assert give(host, node.Wakeup(), 10.0 + NO_BRIDGE_S) == [node.End()]


def test_waits_for_its_vehicle_as_long_as_the_bridge_is_there() -> None:
    host = make_host(A)
    give(host, node.Started(), 10.0)
    give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": "7"}), 11.0)
    assert host.wakeup_s is None
    give(host, node.PeerDown(topics.BRIDGE_ALIVE, {"incarnation": "6"}), 12.0)
    assert host.wakeup_s is None
    give(host, node.PeerDown(topics.BRIDGE_ALIVE, {"incarnation": "7"}), 100.0)
    assert give(host, node.Wakeup(), 99.0 + NO_BRIDGE_S) == []
    give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": "7"}), 99.5 + NO_BRIDGE_S)
    assert host.wakeup_s is None


def test_a_new_bridge_has_new_vehicles_of_the_same_names() -> None:
    host = make_host(shard=Shard(0, 1))
    give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": "7"}))
    first = census(A)
    assert node.Announce(topics.VEHICLE_ALIVE, token(A)) in give(host, first)
    assert give(host, first) == []
    gone = give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": "8"}))
    assert node.Withdraw(topics.VEHICLE_ALIVE, token(A)) in gone
    assert node.Announce(topics.VEHICLE_ALIVE, token(A)) in give(host, first)


@pytest.mark.parametrize("other", ["6", "ghost", "-1", "x"])
def test_what_is_no_newer_bridge_changes_nothing(other: str) -> None:
    """A bridge of an earlier run that was only asleep, or a stranger's token."""
    named, shard = make_host(A), make_host(shard=Shard(0, 1))
    for host in (named, shard):
        give(host, node.Started(), 10.0)
        give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": "7"}), 11.0)
    give(shard, census(A))
    for host in (named, shard):
        effects = give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": other}), 12.0)
        # Only the first is an incarnation.
        assert [type(effect) for effect in effects] == ([] if other == "6" else [node.Refuse])
        assert give(host, node.PeerDown(topics.BRIDGE_ALIVE, {"incarnation": other}), 13.0) == []
        assert host.wakeup_s is None
        assert give(host, node.Wakeup(), 14.0 + NO_BRIDGE_S) == []
    assert give(shard, census(A)) == []  # it has the vehicle still


def closed(
    t_s: float, *lanes: int, bridge: int = 7, from_m: float = 600.0, to_m: float = 650.0
) -> node.Arrived:
    parts = tuple(Obstacle(lane, from_m, to_m) for lane in lanes)
    return node.Arrived(topics.OBSTACLES, {}, Obstacles(t_s, parts, bridge))


def known_to(host: AgentHost, vehicle: Name) -> set[int]:
    """Return the lanes of whose ends an agent knows."""
    return {end.lane for end in host._agents[vehicle]._lane_ends}


def test_agents_know_the_newest_closed_parts_of_their_road() -> None:
    host = make_host(A)
    give(host, node.Started())
    give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": "7"}))
    give(host, closed(1.0, 1))
    assert known_to(host, A) == {1}
    give(host, closed(3.0, 2))
    give(host, closed(2.0, 0))  # late
    give(host, closed(4.0, 0, bridge=6))  # of another road
    assert known_to(host, A) == {2}
    give(host, closed(5.0))
    assert known_to(host, A) == set()


def test_agents_that_start_later_know_them_and_absurd_parts_change_nothing() -> None:
    host = make_host(A)
    give(host, node.Started())
    give(host, closed(1.0, 1, 9, -3, bridge=0))
    give(host, closed(2.0, 1, 9, bridge=0))
    host._start(B)
    assert known_to(host, B) == {1}
    for from_m, to_m in ((650.0, 600.0), (900.0, 5000.0), (math.nan, math.nan)):
        give(host, closed(3.0, 1, bridge=0, from_m=from_m, to_m=to_m))
        assert known_to(host, B) == set()


def test_a_shard_lets_go_of_vehicles_that_the_census_lacks() -> None:
    host = make_host(shard=Shard(0, 1))
    give(host, census(A, B))
    assert node.Withdraw(topics.VEHICLE_ALIVE, token(B)) in give(host, census(A, t_s=2.0))
    assert give(host, census(A, B, t_s=1.0)) == []  # an older one


@pytest.mark.parametrize("other", [6, 8])
def test_a_shard_accepts_the_census_of_its_own_bridge(other: int) -> None:
    """That of an earlier road may come late, that of a newer one before its token."""
    host = make_host(shard=Shard(0, 1))
    assert give(host, census(A, bridge=7)) == []
    give(host, node.PeerUp(topics.BRIDGE_ALIVE, {"incarnation": "7"}))
    assert give(host, census(B, t_s=9.0, bridge=other)) == []
    assert node.Announce(topics.VEHICLE_ALIVE, token(A)) in give(host, census(A, bridge=7))
    # Neither does it make the next one of the right road look old.
    assert node.Announce(topics.VEHICLE_ALIVE, token(C)) in give(host, census(A, C, bridge=7))


def test_stopping_reports_for_every_vehicle() -> None:
    reports = sent(give(make_host(A, B), node.Stopping()), Report)
    assert [report.name for report in reports] == [A, B]


def test_a_shard_takes_announced_vehicles_and_those_on_the_road_once() -> None:
    shards = [make_host(shard=Shard(index, 2)) for index in range(2)]
    names = [Name(f"v{number}") for number in range(20)]
    up: list[str] = []
    for host in shards:
        assert give(host, node.Started()) == [
            node.Watch(topics.BRIDGE_ALIVE),
            node.Listen(topics.OBSTACLES),
            node.Listen(topics.CENSUS),
            *ADDRESSED_TO_IT,
        ]
        assert host.wakeup_s is None
        for _ in range(2):
            up += [
                effect.parameters["vehicle"]
                for effect in give(host, census(*names[3:], on_road=names[:5]))
                if isinstance(effect, node.Announce) and effect.topic is topics.VEHICLE_ALIVE
            ]
    assert sorted(up) == sorted(names)


def test_a_shard_continues_without_vehicles_and_takes_none_twice() -> None:
    host = make_host(shard=Shard(0, 1))
    give(host, census(on_road=[A]))
    feel(host, A)
    feel(host, A, FRONT, 2, left=True)
    assert give(host, census(on_road=[A])) == []
    assert give(host, node.Wakeup(), 1e6) == []


def test_without_a_shard_the_census_is_ignored() -> None:
    assert give(make_host(A), census(B)) == []
