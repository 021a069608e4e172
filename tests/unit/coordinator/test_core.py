"""The coordinator's core as a whole: events in, effects out."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from attrs import evolve
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.coordinator.core import START_MARGIN_S, CoordinatorCore
from laneweave.coordinator.formation import start_time_s
from laneweave.coordinator.leader import Phase
from laneweave.coordinator.planning import PlanResponse
from laneweave.protocol.lattice import Cell
from laneweave.protocol.messages import (
    Ballot,
    Census,
    CensusEntry,
    Heartbeat,
    LogEvent,
    Name,
    Plan,
    Prepare,
    Report,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.node import (
    Announce,
    Arrived,
    Asked,
    Compute,
    Computed,
    Effect,
    Listen,
    PeerDown,
    PeerUp,
    Reply,
    Send,
    Serve,
    Started,
    Stopping,
    Unlisten,
    Wakeup,
    Watch,
    run_job,
)
from laneweave.protocol.plans import plan_problems
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COORDINATOR_ALIVE,
    HEARTBEAT,
    PLAN,
    PREPARE,
    SERVICE,
    STATE,
)
from laneweave.protocol.transport import LinkDown, LinkUp

SCENARIO = Scenario()
LATTICE, ELECTION_S = SCENARIO.lattice, SCENARIO.network.election_s
T_S = 20.0
"""Road time: block 0 has closed and is on the way to S3."""
A, B = Name("A"), Name("B")
Cells = dict[Name, Cell]


class Desk:
    """A coordinator and what it has been told."""

    def __init__(self, name: str = "c1", incarnation: int = 1) -> None:
        """Start a coordinator."""
        self.core = CoordinatorCore(Name(name), incarnation, SCENARIO)
        self.now_s = 0.0
        self.effects = list(self.core.handle(Started(), 0.0))

    def give(self, *events: object) -> list[Effect]:
        effects: list[Effect] = []
        for event in events:
            effects += self.core.handle(event, self.now_s)  # type: ignore[arg-type]
            assert self.core.wakeup_s is not None
            assert self.core.wakeup_s > self.now_s
        self.effects += effects
        return effects

    def wait(self, seconds: float) -> list[Effect]:
        self.now_s += seconds
        return self.give(Wakeup())

    def lead(self) -> list[Effect]:
        return self.wait(ELECTION_S)

    def tell(self, message: object) -> list[Effect]:
        return self.give(Arrived(CENSUS, {}, message))

    @property
    def ballot(self) -> Ballot:
        ballot = self.core.controls[0].ballot
        assert ballot is not None
        return ballot

    def collect_promises(self, cells: Cells, lanes: dict[Name, int]) -> list[Effect]:
        """Lead a formation up to the order of its plan."""
        self.lead()
        self.tell(census(cells, lanes))
        for name, cell in cells.items():
            self.tell(state(name, cell))
        effects: list[Effect] = []
        for name, cell in cells.items():
            effects += self.tell(state(name, cell, self.ballot, t_s=1.0))
        return effects


def census(cells: Cells, lanes: dict[Name, int] | None = None, t_s: float = T_S) -> Census:
    return Census(
        t_s,
        tuple(
            CensusEntry(name, cell, (lanes or {}).get(name, 0), 0.0) for name, cell in cells.items()
        ),
        (),
    )


def state(
    name: Name,
    cell: Cell = (0, 0),
    promised: Ballot | None = None,
    *,
    accepted: bool = False,
    t_s: float = 0.0,
) -> VehicleState:
    return VehicleState(
        vehicle=name,
        incarnation=1,
        formation=0,
        promised=promised,
        accepted=accepted,
        ready=accepted,
        completed=0,
        hold_cell=cell,
        moving=False,
        go=False,
        done=False,
        overdue=False,
        s_m=0.0,
        y_m=0.0,
        speed_mps=0.0,
        t_s=t_s,
    )


def messages(effects: Iterable[Effect], kind: type) -> list[Send]:
    return [e for e in effects if isinstance(e, Send) and isinstance(e.message, kind)]


def jobs(effects: Iterable[Effect]) -> list[Compute]:
    return [e for e in effects if isinstance(e, Compute)]


def logged(effects: Iterable[Effect]) -> list[str]:
    return [e.message.kind for e in messages(effects, LogEvent)]


# --- being there ------------------------------------------------------------------------------


def test_start() -> None:
    desk = Desk()
    assert [e for e in desk.effects if not isinstance(e, Send)] == [
        Listen(HEARTBEAT),
        Listen(CLOCK),
        Listen(CENSUS),
        Watch(COORDINATOR_ALIVE),
        Watch(BRIDGE_ALIVE),
        Announce(COORDINATOR_ALIVE, {"coordinator": "c1", "incarnation": 1}),
        Serve(SERVICE),
    ]


def test_a_new_bridge_has_a_new_road() -> None:
    desk = Desk()
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "7"}))
    (order,) = jobs(desk.collect_promises({A: (0, 0)}, {A: 1}))
    assert desk.core.controls
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "8"}))
    assert (desk.core.controls, desk.core.census, desk.core.t_s) == ({}, None, 0.0)
    assert desk.give(run_job(order)) == []  # a plan for the road that is no more
    desk.tell(census({}, t_s=1.0))  # of an earlier road time than what it knew
    assert desk.core.census is not None
    assert desk.core.t_s == 1.0


@pytest.mark.parametrize("other", ["7", "6", "ghost", "-1"])
def test_what_is_no_newer_bridge_changes_nothing(other: str) -> None:
    """The same one after a loss of the link, one of an earlier run, or a stranger's token."""
    desk = Desk()
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "7"}))
    desk.collect_promises({A: (0, 0)}, {A: 1})
    for news in (PeerDown, PeerUp, PeerDown):
        desk.give(news(BRIDGE_ALIVE, {"incarnation": other}))
    assert list(desk.core.controls) == [0]
    assert desk.core.t_s == T_S


def test_heartbeats_are_periodic_and_say_who_leads() -> None:
    desk = Desk()
    desk.effects.clear()
    for _ in range(20):
        desk.now_s = desk.core.wakeup_s or 0.0
        desk.give(Wakeup())
    beats = [send.message for send in messages(desk.effects, Heartbeat)]
    assert len(beats) == pytest.approx(desk.now_s / SCENARIO.network.heartbeat_s, abs=2)
    assert (beats[0].leading, beats[0].term) == (False, 0)
    assert (beats[-1].leading, beats[-1].term) == (True, 1)


def test_leads_and_steps_down() -> None:
    desk = Desk("c2")
    effects = desk.lead()
    assert Listen(STATE) in effects
    assert logged(effects) == ["leader-elected"]
    desk.tell(census({A: (0, 0)}))
    assert set(desk.core.controls) == {0}
    better = Heartbeat(Name("c1"), 1, 1, leading=False, formations=0)
    effects = desk.tell(better)
    assert Unlisten(STATE) in effects
    assert logged(effects) == ["leader-stepped-down"]
    assert desk.core.controls == {}
    assert messages(desk.tell(state(A)), Prepare) == []


def test_tokens_and_links_reach_the_election() -> None:
    desk = Desk("c2")
    peer = {"coordinator": "c1", "incarnation": "7"}
    desk.give(PeerUp(COORDINATOR_ALIVE, peer))
    assert logged(desk.wait(ELECTION_S - 0.01)) == []
    desk.give(PeerDown(COORDINATOR_ALIVE, peer))
    assert logged(desk.wait(0.01)) == ["leader-elected"]
    assert logged(desk.give(LinkDown())) == ["leader-stepped-down"]
    assert logged(desk.give(LinkUp())) == []
    assert logged(desk.wait(ELECTION_S)) == ["leader-elected"]
    desk.give(PeerDown(COORDINATOR_ALIVE, {"coordinator": "c1", "incarnation": "strange"}))


def test_stopping_reports_and_does_nothing_else() -> None:
    desk = Desk()
    (effect,) = desk.core.handle(Stopping(), 0.0)
    assert isinstance(effect, Send)
    assert isinstance(effect.message, Report)


# --- census and clock -------------------------------------------------------------------------


def test_an_older_census_is_ignored() -> None:
    desk = Desk()
    desk.lead()
    desk.tell(census({A: (0, 0), B: (-1, 1)}))
    desk.tell(census({A: (0, 0)}, t_s=T_S - 0.1))
    assert list(desk.core.controls[0].formation.roster) == [A, B]
    desk.tell(census({B: (-1, 1)}, t_s=T_S + 0.1))
    assert list(desk.core.controls[0].formation.roster) == [B]


def test_a_formation_that_is_not_closed_is_not_touched() -> None:
    desk = Desk()
    desk.lead()
    desk.tell(census({A: (0, 0)}, t_s=2.9))
    desk.tell(RoadClock(99, 9.9, 1, 1, 1, 0, ended=False))
    assert desk.core.controls == {}  # the census is too old to be complete
    desk.tell(census({A: (0, 0)}, t_s=3.1))
    assert set(desk.core.controls) == {0}


def test_a_formation_that_has_left_is_forgotten() -> None:
    desk = Desk()
    desk.lead()
    desk.tell(census({A: (0, 0)}))
    desk.tell(census({}, t_s=T_S + 1.0))
    assert desk.core.controls == {}


def test_road_time_never_goes_back() -> None:
    desk = Desk()
    desk.tell(RoadClock(1, 50.0, 0, 0, 0, 0, ended=False))
    desk.tell(RoadClock(1, 40.0, 0, 0, 0, 0, ended=False))
    desk.tell(census({}, t_s=45.0))
    assert desk.core.t_s == 50.0


# --- from the promise to the plan -------------------------------------------------------------


def test_prepare_promise_plan_acceptance() -> None:
    desk = Desk()
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    (job,) = jobs(desk.collect_promises(cells, {A: 1, B: 0}))
    prepares = messages(desk.effects, Prepare)
    assert [(s.topic, s.parameters["vehicle"]) for s in prepares] == [(PREPARE, A), (PREPARE, B)]
    effects = desk.give(run_job(job))
    assert "plan-made" in logged(effects)
    plans = messages(effects, Plan)
    assert [(s.topic, s.parameters["vehicle"]) for s in plans] == [(PLAN, A), (PLAN, B)]
    assert plans[0].message == plans[1].message
    for name, cell in cells.items():
        desk.tell(state(name, cell, desk.ballot, accepted=True, t_s=2.0))
    assert desk.core.controls[0].phase is Phase.WATCHING
    desk.wait(1.0)
    assert messages(desk.wait(10.0), Plan) == []


def test_adoption_sends_nothing() -> None:
    desk = Desk()
    desk.lead()
    desk.tell(census({A: (0, 0), B: (-1, 1)}, {B: 1}))
    theirs = Ballot(4, Name("c0"), 3, 2)
    for name, cell in ((A, (0, 0)), (B, (-1, 1))):
        desk.tell(state(name, cell, theirs, accepted=True))
    for _ in range(10):
        desk.wait(0.5)
    assert messages(desk.effects, Prepare) == messages(desk.effects, Plan) == []
    assert jobs(desk.effects) == []


def test_a_result_for_an_older_ballot_is_dropped() -> None:
    desk = Desk()
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    (job,) = jobs(desk.collect_promises(cells, {}))
    first = desk.ballot
    desk.tell(census({A: (0, 0)}, t_s=T_S + 1.0))  # B leaves
    assert desk.ballot > first
    assert messages(desk.give(run_job(job)), Plan) == []
    assert messages(desk.give(Computed(999, None)), Plan) == []
    (job,) = jobs(desk.tell(state(A, (0, 0), desk.ballot, t_s=2.0)))
    (plan,) = messages(desk.give(run_job(job)), Plan)
    assert plan.message.roster == (A,)


def test_a_result_after_stepping_down_is_dropped() -> None:
    desk = Desk("c2")
    (job,) = jobs(desk.collect_promises({A: (0, 0)}, {}))
    desk.tell(Heartbeat(Name("c1"), 1, 1, leading=True, formations=0))
    assert messages(desk.give(run_job(job)), Plan) == []


@pytest.mark.parametrize("spoil", ["error", "nothing found", "unsafe paths"])
def test_failed_planning_is_logged_and_tried_again_under_the_same_ballot(spoil: str) -> None:
    desk = Desk()
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    (job,) = jobs(desk.collect_promises(cells, {A: 1, B: 0}))
    ballot = desk.ballot
    result = run_job(job)
    response = result.result
    assert isinstance(response, PlanResponse)
    match spoil:
        case "error":
            result = evolve(result, result=None, error="ValueError: broken")
        case "nothing found":
            result = evolve(result, result=evolve(response, status="timeout", paths=()))
        case _:
            swapped = (((3, 0), (2, 1)), ((2, 1), (3, 0)))
            result = evolve(result, result=evolve(response, paths=swapped))
    effects = desk.give(result)
    assert logged(effects) == ["planning-failed"]
    assert messages(effects, Plan) == []
    assert jobs(desk.wait(0.9)) == []
    (job,) = jobs(desk.wait(0.1))
    (plan, _) = messages(desk.give(run_job(job)), Plan)
    assert plan.message.ballot == ballot


@pytest.mark.parametrize("cell", [(-4, 0), (77, 0), (0, 5), (-1, 1)])
def test_cells_that_cannot_be_planned_from_do_not_stop_the_coordinator(cell: Cell) -> None:
    """Outside the block, or the cell of another: a promise may come from anybody."""
    desk = Desk()
    desk.lead()
    desk.tell(census({A: (0, 0), B: (-1, 1)}))
    desk.tell(state(A))
    desk.tell(state(B))
    desk.tell(state(A, cell, desk.ballot, t_s=1.0))
    (job,) = jobs(desk.tell(state(B, (-1, 1), desk.ballot, t_s=1.0)))
    assert logged(desk.give(run_job(job))) == ["planning-failed"]


def test_too_late_for_any_step_settles() -> None:
    desk = Desk()
    desk.lead()
    desk.tell(census({A: (0, 0)}, t_s=66.0))
    desk.tell(state(A))
    effects = desk.tell(state(A, (0, 0), desk.ballot, t_s=1.0))
    assert jobs(effects) == []
    assert logged(effects) == ["formation-too-late"]
    assert desk.core.controls[0].phase is Phase.SETTLED
    assert logged(desk.wait(5.0)) == []


@st.composite
def rosters(draw: st.DrawFn) -> tuple[Cells, dict[Name, int]]:
    block = sorted(LATTICE.block_cells(0))
    cells = draw(st.lists(st.sampled_from(block), min_size=1, max_size=6, unique=True))
    fit = [lane for lane in range(LATTICE.lanes) for _ in range(LATTICE.block_columns)]
    lanes = draw(st.permutations(fit))
    names = [Name(f"v{index}") for index in range(len(cells))]
    return dict(zip(names, cells, strict=True)), dict(zip(names, lanes, strict=False))


@settings(max_examples=40, deadline=None)
@given(roster=rosters(), t_s=st.floats(3.1, 40.0))
def test_every_plan_is_executable_and_serves_all_preferences(
    roster: tuple[Cells, dict[Name, int]], t_s: float
) -> None:
    cells, lanes = roster
    desk = Desk()
    desk.core.t_s = t_s
    (job,) = jobs(desk.collect_promises(cells, lanes))
    plan: Plan = messages(desk.give(run_job(job)), Plan)[0].message
    assert plan_problems(plan) == []
    assert plan.roster == tuple(cells)
    assert plan.start_cells == cells
    assert set(plan.territory) <= LATTICE.block_cells(0)
    assert plan.slot_s == SCENARIO.formation.cycle_s
    now_s = max(t_s, T_S)
    assert plan.t0_s == start_time_s(0, now_s + START_MARGIN_S, SCENARIO) > now_s
    for name, moves in plan.moves.items():
        end = moves[-1][2] if moves else cells[name]
        assert end[1] == lanes[name]


# --- ballots ----------------------------------------------------------------------------------


def test_ballots_never_repeat() -> None:
    """Neither within a process, over formations and re-elections, nor over its restarts."""
    seen: list[Ballot] = []
    for incarnation in (1, 2, 3):
        desk = Desk("c2", incarnation)
        desk.lead()
        for round_ in range(4):
            both: Cells = {A: (0, 0), B: (-5, 0)}
            desk.tell(census(both, t_s=T_S + round_))
            for number, name in ((0, A), (1, B)):
                desk.tell(evolve(state(name), formation=number))
                ballot = desk.core.controls[number].ballot
                assert ballot is not None
                seen.append(ballot)
            desk.tell(Heartbeat(Name("c1"), 1, 9, leading=True, formations=0))
            desk.wait(2 * ELECTION_S)
    assert len(set(seen)) == len(seen) == 24


@pytest.mark.parametrize(
    "shown",
    [
        Ballot(1, Name("c9"), 1, 1),
        Ballot(1, Name("c1"), 2, 1),
        Ballot(1, Name("c0"), 9, 9),
        Ballot(7, Name("c0"), 1, 1),
    ],
    ids=["equal term of a worse name", "later process of its own", "lower", "higher term"],
)
def test_a_new_ballot_is_above_what_vehicles_show(shown: Ballot) -> None:
    """With an equal term the name alone could make it the lower one, for ever."""
    desk = Desk()
    desk.lead()
    assert desk.core.election.term == 1
    desk.tell(census({A: (0, 0)}))
    desk.tell(state(A, promised=shown))
    assert desk.ballot > shown
    assert desk.ballot.term == desk.core.election.term


# --- the service ------------------------------------------------------------------------------


def test_the_service_answers_without_leading() -> None:
    desk = Desk()
    request = (
        b'{"schema": "laneweave.plan.request/1", "grid": {"columns": 2, "lanes": 2},'
        b' "vehicles": [{"id": "a", "cell": [0, 0]}], "targets": [[1, 0]]}'
    )
    (job,) = jobs(desk.give(Asked(5, request)))
    (reply,) = [e for e in desk.give(run_job(job)) if isinstance(e, Reply)]
    assert (reply.token, reply.ok) == (5, True)
    (refusal,) = [e for e in desk.give(Asked(6, b"{}")) if isinstance(e, Reply)]
    assert (refusal.token, refusal.ok) == (6, False)
