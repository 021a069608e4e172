"""A coordinator that receives numbers that no correct sender has, or has them no longer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.coordinator.rolling.operation import RollingOperation
from laneweave.protocol.runtime.node import (
    Arrived,
    Effect,
    MessagesDropped,
    PeerDown,
    PeerUp,
    Refuse,
    Send,
)
from laneweave.protocol.wire.bounds import max_election_term, max_term
from laneweave.protocol.wire.messages import Ballot, Census, Heartbeat, Name, RoadClock
from laneweave.protocol.wire.newest import FORGET_S
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COORDINATOR_ALIVE,
    HEARTBEAT,
    STATE,
    Topic,
)
from support.paper import PAPER
from support.service_desk import T_S, Desk, census, state
from support.states import A, B, changed
from support.tables import for_each

HUGE = 2**63 - 1
HIGH = Ballot(HUGE, Name("zz"), HUGE, HUGE)
DAY_NS = 86_400 * 10**9
ELECTION_S = PAPER.network.election_s
CELLS = {A: (0, 0), B: (-1, 0)}


def clock(t_s: float, **changes: Any) -> RoadClock:  # noqa: ANN401 (fields)
    made = RoadClock(round(10 * t_s), t_s, 1, 1, 1, 0, ended=False, bridge=7)
    return replace(made, **changes)


class Road(Desk):
    """A coordinator that leads on the road of bridge 7, whose clock is the coordinator's."""

    def __init__(self) -> None:
        """Lead a formation of two vehicles."""
        super().__init__()
        self.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "7"}))
        self.lead()
        self.show()

    @property
    def t_s(self) -> float:
        return T_S + self.now_s

    def send(self, topic: Topic, message: object, **parameters: str) -> list[Effect]:
        return self.give(Arrived(topic, parameters, message))

    def show(self) -> None:
        """Let the bridge show clock and census."""
        self.send(CLOCK, clock(self.t_s))
        self.send(CENSUS, self.census())

    def census(self, **changes: Any) -> Census:  # noqa: ANN401 (fields)
        return replace(census(CELLS, t_s=self.t_s), **({"bridge": 7} | changes))

    def drive(self, seconds: float) -> None:
        """Let time pass, with clock and census in each tick."""
        for _ in range(round(seconds / 0.1)):
            self.wait(0.1)
            self.show()

    @property
    def knows_its_road(self) -> bool:
        known = self.core.census
        return (
            known is not None
            and {entry.vehicle for entry in known.on_road} == {A, B}
            and abs(self.core.t_s - self.t_s) < 0.2
            and sorted(self.leaders) == [0]
        )


def refused(effects: list[Effect]) -> bool:
    return [each for each in effects if isinstance(each, Refuse)] != []


def beat(term: int = 1, incarnation: int = 1, name: str = "c2") -> Heartbeat:
    return Heartbeat(Name(name), incarnation, term, leading=False, plans=0)


@for_each(("topic", "make"), [
        (CLOCK, lambda road: clock(road.t_s, bridge=HUGE)),
        (CLOCK, lambda _: clock(1e12)),
        (CLOCK, lambda _: clock(9e4)),
        (CLOCK, lambda road: clock(road.t_s, tick=HUGE)),
        (CENSUS, lambda road: road.census(t_s=1e12, on_road=())),
        (CENSUS, lambda road: road.census(bridge=HUGE, on_road=())),
        (HEARTBEAT, lambda _: beat(HUGE)),
        (HEARTBEAT, lambda _: beat(2**62)),
        (HEARTBEAT, lambda _: beat(incarnation=HUGE)),
        (STATE, lambda _: state(A, promised=HIGH)),
        (STATE, lambda _: state(A, t_s=1e12)),
        (STATE, lambda _: changed(state(A), incarnation=2**62)),
    ])  # fmt: skip
def test_impossible_numbers_change_nothing(topic: Topic, make: Callable[[Road], object]) -> None:
    road = Road()
    term, leaders = road.core.election.term, dict(road.leaders)
    assert refused(road.send(topic, make(road)))
    assert road.knows_its_road
    assert road.leaders == leaders
    assert road.core.election.term == term
    assert road.core.election.leading


@pytest.mark.parametrize(
    ("topic", "parameters"),
    [(BRIDGE_ALIVE, {}), (COORDINATOR_ALIVE, {"coordinator": "c2"})],
)
def test_tokens_with_impossible_incarnations_change_nothing(
    topic: Topic, parameters: dict[str, str]
) -> None:
    road = Road()
    for incarnation in (HUGE, "9" * 60, "ghost"):
        assert refused(road.give(PeerUp(topic, parameters | {"incarnation": str(incarnation)})))
    assert road.knows_its_road
    assert list(road.core.election.living(road.now_s)) == []


@pytest.mark.parametrize(
    "make",
    [
        lambda road: (CLOCK, clock(road.t_s, bridge=DAY_NS)),
        lambda road: (CLOCK, clock(road.t_s + 9.0)),
        lambda road: (CENSUS, road.census(bridge=DAY_NS, on_road=())),
        lambda road: (CENSUS, replace(census({}, t_s=road.t_s + 9.0), bridge=7)),
    ],
    ids=["clock bridge", "clock time", "census bridge", "census time"],
)
def test_what_the_bridge_does_not_show_is_forgotten(
    make: Callable[[Road], tuple[Topic, object]],
) -> None:
    road = Road()
    for _ in range(20):
        road.send(*make(road))
        road.drive(0.1)
    assert not road.knows_its_road
    road.drive(FORGET_S + 0.3)
    assert road.knows_its_road


def test_a_token_that_vanishes_gives_the_road_back() -> None:
    road = Road()
    road.give(PeerUp(BRIDGE_ALIVE, {"incarnation": str(DAY_NS)}))
    assert not road.knows_its_road
    road.give(PeerDown(BRIDGE_ALIVE, {"incarnation": str(DAY_NS)}))
    road.drive(0.1)
    assert road.knows_its_road


@pytest.mark.parametrize("changes", [{"t_s": T_S + 9.0}, {"incarnation": DAY_NS}])
def test_a_state_that_its_vehicle_does_not_show_is_forgotten(changes: dict[str, Any]) -> None:
    road = Road()
    for vehicle, cell in CELLS.items():
        road.send(STATE, state(vehicle, cell, t_s=road.t_s))
    road.send(STATE, changed(state(A, CELLS[A], t_s=road.t_s), **changes))
    for _ in range(round(FORGET_S / 0.1) + 2):
        road.drive(0.1)
        for vehicle, cell in CELLS.items():
            road.send(STATE, state(vehicle, cell, road.leaders[0].ballot, t_s=road.t_s))
    assert set(road.leaders[0].promises) == set(CELLS)


def test_a_promise_of_the_highest_possible_term_is_outbid() -> None:
    road = Road()
    high = HIGH._replace(term=max_term(road.t_s))
    for vehicle, cell in CELLS.items():
        road.send(STATE, state(vehicle, cell, high, t_s=road.t_s))
    ballot = road.ballot
    assert ballot > high
    assert ballot.term <= max_term(road.t_s + 0.1)
    assert road.core.election.term <= max_election_term(road.t_s)  # others need not follow


def test_terms_of_others_are_adopted_up_to_a_limit_that_grows() -> None:
    road = Road()
    for _ in range(100):
        road.send(HEARTBEAT, beat(road.core.election.term + 10_000))
    assert road.core.election.term <= max_election_term(road.t_s) + 1
    before = road.core._new_ballot(None)
    road.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "8"}))  # its road time is 0
    road.send(CLOCK, clock(0.0, bridge=8))
    assert road.core.election.term <= max_election_term(0.0)
    assert road.core._new_ballot(None).seq > before.seq  # no ballot is used twice


def test_heartbeats_of_a_process_whose_successor_is_silent_count_again() -> None:
    road = Road()
    road.send(HEARTBEAT, beat(incarnation=DAY_NS, name="c0"))
    road.drive(ELECTION_S)
    road.send(HEARTBEAT, beat(incarnation=1, name="c0"))
    assert list(road.core.election.living(road.now_s)) == ["c0"]


def test_while_messages_are_dropped_silent_candidates_are_not_given_up() -> None:
    desk, token = Desk("c2"), {"coordinator": "c1", "incarnation": "5"}
    desk.give(PeerUp(COORDINATOR_ALIVE, token))
    for _ in range(20):
        desk.wait(0.1)
        desk.give(MessagesDropped(CLOCK))
    assert not desk.core.election.leading
    desk.give(PeerDown(COORDINATOR_ALIVE, token))
    desk.give(MessagesDropped(CLOCK))
    desk.watch(0.1)
    assert desk.core.election.leading


def test_a_candidate_that_was_silent_before_messages_were_dropped_stays_silent() -> None:
    desk = Desk("c2")
    desk.give(PeerUp(COORDINATOR_ALIVE, {"coordinator": "c1", "incarnation": "5"}))
    desk.watch(ELECTION_S + 0.1)
    desk.give(MessagesDropped(CLOCK))
    assert desk.core.election.leading


def test_a_leader_sends_only_terms_that_others_accept() -> None:
    road = Road()
    for _ in range(50):
        road.drive(0.1)
        road.send(HEARTBEAT, beat(max_election_term(road.t_s)))
        road.send(STATE, state(A, promised=HIGH._replace(term=max_term(road.t_s)), t_s=road.t_s))
    sent = [each.message for each in road.effects if isinstance(each, Send)]
    terms = [each.term for each in sent if isinstance(each, Heartbeat)]
    assert 0 < max(terms) <= max_election_term(road.t_s) + 1


@pytest.mark.parametrize("operation", ["formations", "rolling"])
@pytest.mark.parametrize("cell", [(0, 99), (0, -1), (10**9, 0), (-(10**12), 1)])
def test_hold_cells_where_no_vehicle_can_be_are_refused(
    operation: str, cell: tuple[int, int]
) -> None:
    """Planning would fail in such a lane, and take long with such a column."""
    formation = evolve(PAPER.formation, operation=operation)
    desk = Desk(scenario=evolve(PAPER, formation=formation))
    desk.lead()
    desk.give(Arrived(CENSUS, {}, census(CELLS, t_s=T_S)))
    told = state(A, CELLS[A], None, t_s=T_S)
    (refused,) = desk.give(Arrived(STATE, {}, replace(told, hold_cell=cell)))
    assert isinstance(refused, Refuse)
    assert refused.error.field == "hold_cell"
    near = replace(told, hold_cell=(CELLS[A][0] + 20, 2))
    assert not [one for one in desk.give(Arrived(STATE, {}, near)) if isinstance(one, Refuse)]


def test_on_a_new_road_terms_of_the_old_one_are_forgotten_in_the_rolling_operation() -> None:
    formation = evolve(PAPER.formation, operation="rolling")
    desk = Desk(scenario=evolve(PAPER, formation=formation))
    desk.lead()
    desk.give(Arrived(CLOCK, {}, clock(30_000.0)))
    desk.give(Arrived(CENSUS, {}, replace(census(CELLS, t_s=30_000.0), bridge=7)))
    absurd = Ballot(max_term(30_000.0), Name("zz"), 1, 1)
    desk.give(Arrived(STATE, {}, state(A, CELLS[A], absurd, t_s=30_000.0)))
    operation = desk.core.operation
    assert isinstance(operation, RollingOperation)
    assert operation._highest == absurd
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "8"}))
    desk.give(Arrived(CLOCK, {}, clock(0.0, bridge=8)))
    assert operation._highest is None
