"""The coordinator's core as a whole: events in, effects out."""

from __future__ import annotations

import time
from collections.abc import Iterable

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.formations import formation_planner
from laneweave.coordinator.formations.formation_planner import START_MARGIN_S
from laneweave.coordinator.formations.roster import start_time_s
from laneweave.coordinator.formations.sorting import Sorting, SortingTask, sort_lanes
from laneweave.coordinator.planning.budget import Clock
from laneweave.coordinator.planning.response import PlanFunction
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.runtime.node import (
    Announce,
    Compute,
    Computed,
    Decline,
    Delegate,
    Effect,
    Listen,
    PeerDown,
    PeerUp,
    QueryArrived,
    Reply,
    Send,
    Serve,
    StopJob,
    Stopping,
    Unlisten,
    Wakeup,
    Watch,
    run_delegated,
    run_job,
)
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.vehicle.plans import plan_problems
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Heartbeat,
    Name,
    Plan,
    Prepare,
    RoadClock,
)
from laneweave.protocol.wire.process_messages import LogEvent, Report
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLIENT_ALIVE,
    CLOCK,
    COORDINATOR_ALIVE,
    HEARTBEAT,
    OBSTACLES,
    PLAN,
    PREPARE,
    SERVICE,
    SERVICE_CANCEL,
    STATE,
    Topic,
)
from support.examples import examples
from support.paper import PAPER
from support.service_desk import T_S, Cells, Desk, census, jobs, leading, logged, messages, state
from support.states import A, B, C, D, E, F, changed
from support.variants import variants

# --- starting, bridges, election --------------------------------------------------------------


def test_start() -> None:
    desk = Desk()
    assert [e for e in desk.effects if not isinstance(e, Send)] == [
        Listen(HEARTBEAT),
        Listen(CLOCK),
        Listen(CENSUS),
        Listen(OBSTACLES),
        Watch(COORDINATOR_ALIVE),
        Watch(BRIDGE_ALIVE),
        Watch(CLIENT_ALIVE),
        Announce(COORDINATOR_ALIVE, {"coordinator": "c1", "incarnation": 1}),
        Serve(SERVICE),
        Serve(SERVICE_CANCEL),
    ]


def test_a_new_bridge_has_a_new_road() -> None:
    desk = Desk()
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "7"}))
    (order,) = jobs(desk.collect_promises({A: (0, 0), B: (-4, 0)}, {A: 1}))
    desk.tell(state(A, joined=(0, 1)))
    assert sorted(desk.leaders) == [0]
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "8"}))
    assert (desk.leaders, desk.core.census, desk.core.t_s) == ({}, None, 0.0)
    assert desk.give(run_job(order)) == []  # a plan for the road that is no more
    desk.tell(census({}, t_s=1.0))  # of an earlier road time than what it knew
    assert desk.core.census is not None
    assert desk.core.t_s == 1.0
    desk.wait(1.0)
    desk.tell(census({A: (0, 0), B: (-4, 0)}))
    assert sorted(desk.leaders) == [0, 1]


@pytest.mark.parametrize("other", ["7", "6", "ghost", "-1"])
def test_tokens_of_no_newer_bridge_change_nothing(other: str) -> None:
    """The same one after a loss of the link, one of an earlier run, or a stranger's token."""
    desk = Desk()
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "7"}))
    desk.collect_promises({A: (0, 0)}, {A: 1})
    for news in (PeerDown, PeerUp, PeerDown):
        desk.give(news(BRIDGE_ALIVE, {"incarnation": other}))
    assert list(desk.leaders) == [0]
    assert desk.core.t_s == T_S


def of_bridge(bridge: int, cells: Cells, t_s: float) -> tuple[Census, RoadClock]:
    clock = RoadClock(round(10 * t_s), t_s, 1, 1, 1, 0, ended=False, bridge=bridge)
    return replace(census(cells, t_s=t_s), bridge=bridge), clock


def road(desk: Desk) -> tuple[list[Name], float]:
    """Return the vehicles that a coordinator knows on the road, and the road time."""
    assert desk.core.census is not None
    return [entry.vehicle for entry in desk.core.census.on_road], desk.core.t_s


@pytest.mark.parametrize("index", [0, 1], ids=["census", "clock"])
def test_a_newer_bridge_is_met_by_its_news_before_its_token_is_seen(index: int) -> None:
    desk = Desk()
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "7"}))
    desk.collect_promises({A: (0, 0)}, {A: 1})
    newer = of_bridge(8, {B: (0, 0)}, 1.0)
    desk.tell(newer[index])
    assert (desk.leaders, desk.core.t_s) == ({}, 1.0)
    desk.tell(newer[1 - index])
    assert road(desk) == ([B], 1.0)
    desk.give(PeerUp(BRIDGE_ALIVE, {"incarnation": "8"}))  # nothing new
    desk.tell(of_bridge(7, {A: (0, 0)}, 9 * T_S)[index])  # late, and ahead in road time
    assert road(desk) == ([B], 1.0)


def test_states_of_vehicles_that_the_census_does_not_list_are_ignored() -> None:
    """Or not in this formation: what they have joined is of another road."""
    desk = leading({A: (0, 0), B: (-5, 0)})
    theirs = Ballot(4, Name("c9"), 3, 2)
    for stranger in (
        state(C, (0, 0), theirs, joined=(0, 1)),
        changed(state(A, (0, 0), theirs, joined=(0, 1)), block=1),
        changed(state(B, (-5, 0), theirs, joined=(0, 1)), block=0),
    ):
        desk.tell(stranger)
    assert set(desk.leaders) == {0, 1}  # not joined
    for control in desk.leaders.values():
        assert (control.states, control.highest) == ({}, None)
    desk.tell(state(A, (0, 0), theirs))
    assert desk.leaders[0].highest == theirs


def test_heartbeats_are_periodic_and_name_the_leader() -> None:
    desk = Desk()
    desk.effects.clear()
    for _ in range(20):
        desk.now_s = desk.core.wakeup_s or 0.0
        desk.give(Wakeup())
    beats = [send.message for send in messages(desk.effects, Heartbeat)]
    assert len(beats) == pytest.approx(desk.now_s / PAPER.network.heartbeat_s, abs=2)
    assert (beats[0].leading, beats[0].term) == (False, 0)
    assert (beats[-1].leading, beats[-1].term) == (True, 1)


def test_leads_and_steps_down() -> None:
    desk = Desk("c2")
    effects = desk.lead()
    assert Listen(STATE) in effects
    assert logged(effects) == ["leader-elected"]
    desk.tell(census({A: (0, 0)}))
    assert set(desk.leaders) == {0}
    better = Heartbeat(Name("c1"), 1, 1, leading=False, plans=0)
    assert logged(desk.tell(better)) == []  # it waits until the newcomer leads
    effects = desk.tell(replace(better, leading=True))
    assert Unlisten(STATE) in effects
    assert logged(effects) == ["leader-stepped-down"]
    assert desk.leaders == {}
    assert messages(desk.tell(state(A)), Prepare) == []


def test_tokens_and_links_reach_the_election() -> None:
    desk = Desk("c2")
    peer = {"coordinator": "c1", "incarnation": "7"}
    desk.give(PeerUp(COORDINATOR_ALIVE, peer))
    assert logged(desk.wait(PAPER.network.election_s - 0.01)) == []
    desk.give(PeerDown(COORDINATOR_ALIVE, peer))
    assert logged(desk.wait(0.01)) == ["leader-elected"]
    assert logged(desk.give(LinkDown())) == ["leader-stepped-down"]
    assert logged(desk.give(LinkUp())) == []
    assert logged(desk.wait(PAPER.network.election_s)) == ["leader-elected"]
    desk.give(PeerDown(COORDINATOR_ALIVE, {"coordinator": "c1", "incarnation": "strange"}))


def test_stopping_reports_and_does_nothing_else() -> None:
    desk = Desk()
    (effect,) = desk.core.handle(Stopping(), 0.0)
    assert isinstance(effect, Send)
    assert isinstance(effect.message, Report)


# --- census and clock -------------------------------------------------------------------------


def test_an_older_census_is_ignored() -> None:
    desk = leading({A: (0, 0), B: (-1, 1)})
    desk.tell(census({A: (0, 0)}, t_s=T_S - 0.1))
    assert list(desk.leaders[0].formation.roster) == [A, B]
    desk.tell(census({B: (-1, 1)}, t_s=T_S + 0.1))
    assert list(desk.leaders[0].formation.roster) == [B]
    desk.tell(RoadClock(1, T_S - 5.0, 0, 0, 0, 0, ended=False))
    assert desk.core.t_s == T_S + 0.1


def test_a_formation_that_is_not_closed_is_not_touched() -> None:
    desk = leading({A: (0, 0)}, t_s=4.4)
    desk.tell(RoadClock(99, 9.9, 1, 1, 1, 0, ended=False))
    assert desk.leaders == {}  # the census is too old to be complete
    desk.tell(census({A: (0, 0)}, t_s=4.6))
    assert set(desk.leaders) == {0}


def test_a_formation_that_has_left_is_forgotten() -> None:
    desk = leading({A: (0, 0)})
    desk.tell(census({}, t_s=T_S + 1.0))
    assert desk.leaders == {}


# --- from the promise to the plan -------------------------------------------------------------


def addressees(effects: Iterable[Effect], topic: Topic) -> list[tuple[str, str]]:
    """Return process and vehicle of the messages of a topic."""
    return [
        (each.parameters["process"], each.parameters["vehicle"])
        for each in effects
        if isinstance(each, Send) and each.topic is topic
    ]


def test_messages_go_to_the_processes_that_the_census_names() -> None:
    """Without any, to one that has the name of the vehicle; the newest census counts."""
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    desk = Desk()
    desk.lead()
    plain = census(cells, {A: 1, B: 0})
    at_b = (plain.on_road[0], replace(plain.on_road[1], processes=(Name("f"), Name("g"))))
    desk.tell(replace(plain, on_road=at_b))
    assert addressees(desk.observe(cells), PREPARE) == [(A, A), ("f", B), ("g", B)]
    at_a = (replace(plain.on_road[0], processes=(Name("g"),)), plain.on_road[1])
    desk.tell(replace(plain, on_road=at_a, t_s=T_S + 0.1))
    (job,) = jobs(desk.promise(cells))
    assert addressees(desk.give(run_job(job)), PLAN) == [("g", A), (B, B)]


def test_prepare_promise_plan_acceptance() -> None:
    desk = Desk()
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    (job,) = jobs(desk.collect_promises(cells, {A: 1, B: 0}))
    prepares = messages(desk.effects, Prepare)
    assert [(s.topic, s.parameters["vehicle"]) for s in prepares] == [(PREPARE, A), (PREPARE, B)]
    effects = desk.give(run_job(job))
    (made,) = (s.message.data for s in messages(effects, LogEvent) if s.message.kind == "plan-made")
    assert (made["solver"], made["fallback"]) == ("tappa", False)
    plans = messages(effects, Plan)
    assert [(s.topic, s.parameters["vehicle"]) for s in plans] == [(PLAN, A), (PLAN, B)]
    assert plans[0].message == plans[1].message
    assert plans[0].message.blocks == (0,)
    told = desk.accept(cells)
    assert desk.leaders[0].phase is BallotPhase.IN_FORCE
    assert desk.accept(cells, t_s=2.1) == []
    (note,) = messages(told, LogEvent)
    assert note.message.kind == "plan-in-force"
    assert note.message.data == {"formation": 0, "closed_s": 4.5}
    desk.wait(1.0)
    assert messages(desk.wait(10.0), Plan) == []


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


def test_a_result_for_an_older_ballot_is_dropped_while_the_newer_one_is_planned() -> None:
    """It was made from promises that do not hold any more."""
    desk = Desk()
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    (old,) = jobs(desk.collect_promises(cells, {A: 1, B: 0}))
    before = old.work(time.monotonic)
    assert isinstance(before, Sorting)
    desk.tell(census(cells, {A: 2, B: 0}, t_s=T_S + 1.0))
    assert jobs(desk.promise(cells)) == []
    assert desk.leaders[0].phase is BallotPhase.PLANNING
    result = run_job(old)  # in another thread; it depends on its order only
    assert isinstance(result.result, Sorting)
    assert result.result.moves == before.moves
    effects = desk.give(result)
    assert messages(effects, LogEvent) == []
    (new,) = jobs(effects)
    plan: Plan = messages(desk.give(run_job(new)), Plan)[0].message
    assert plan.moves[A][-1][2][1] == 2


def lead_two_formations(desk: Desk) -> tuple[Compute, list[Effect]]:
    """Return the order of the first formation, and the effects of the second one's promise."""
    desk.lead()
    desk.tell(census(APART, {A: 1, B: 1}))
    desk.observe(APART)
    (first,) = jobs(promise(desk, A))
    return first, promise(desk, B)


APART: Cells = {A: (0, 0), B: (-5, 0)}


def promise(desk: Desk, name: Name, t_s: float = 1.0) -> list[Effect]:
    cell = APART[name]
    ballot = desk.leaders[PAPER.lattice.block_of(cell[0])].ballot
    return desk.tell(state(name, cell, ballot, t_s=t_s))


def test_one_formation_is_planned_after_the_other() -> None:
    desk = Desk()
    first, effects = lead_two_formations(desk)
    assert jobs(effects) == []
    (second,) = jobs(desk.give(run_job(first)))
    assert desk.leaders[0].phase is BallotPhase.ISSUING
    assert jobs(desk.give(run_job(second))) == []
    assert desk.leaders[1].phase is BallotPhase.ISSUING


def test_a_replaced_order_is_not_computed() -> None:
    desk = Desk()
    first, _ = lead_two_formations(desk)
    desk.tell(census(APART, {A: 1, B: 2}, t_s=T_S + 1.0))
    assert jobs(promise(desk, B, t_s=2.0)) == []
    (second,) = jobs(desk.give(run_job(first)))
    plan: Plan = messages(desk.give(run_job(second)), Plan)[0].message
    assert plan.moves[B][-1][2][1] == 2
    assert jobs(desk.wait(0.1)) == []


def test_an_order_of_an_outbid_leader_is_not_computed() -> None:
    desk = Desk()
    first, _ = lead_two_formations(desk)
    desk.tell(state(B, APART[B], desk.ballot._replace(term=9), t_s=2.0))
    assert jobs(desk.give(run_job(first))) == []


@pytest.mark.parametrize(
    "news",
    [
        Heartbeat(Name("c1"), 1, 1, leading=True, plans=0),
        state(A, promised=Ballot(9, Name("c1"), 1, 1), t_s=2.0),
    ],
    ids=["stepped down", "outbid"],
)
def test_a_result_that_no_leader_waits_for_is_dropped(news: object) -> None:
    desk = Desk("c2")
    (job,) = jobs(desk.collect_promises({A: (0, 0)}, {}))
    desk.tell(news)
    effects = desk.give(run_job(job))
    assert messages(effects, Plan) == messages(effects, LogEvent) == []


@pytest.mark.parametrize("spoil", ["error", "nothing found", "unsafe paths", "one unsafe path"])
def test_failed_planning_is_logged_and_tried_again_under_the_same_ballot(spoil: str) -> None:
    desk = Desk()
    cells: Cells = {A: (0, 0), B: (-1, 1)}
    (job,) = jobs(desk.collect_promises(cells, {A: 1, B: 0}))
    ballot = desk.ballot
    result = run_job(job)
    sorting = result.result
    assert isinstance(sorting, Sorting)
    assert sorting.response is not None
    match spoil:
        case "error":
            result = evolve(result, result=None, error="ValueError: broken")
        case "nothing found":
            nothing = evolve(sorting.response, status="timeout", paths=())
            result = evolve(result, result=evolve(sorting, response=nothing))
        case _:
            moves: dict[Name, tuple[PlannedMove, ...]] = {A: ((0, (0, 0), (-1, 1)),), B: ()}
            if spoil == "unsafe paths":
                moves[B] = ((0, (-1, 1), (0, 0)),)
            result = evolve(result, result=evolve(sorting, moves=moves))
    effects = desk.give(result)
    assert logged(effects) == ["planning-failed"]
    if spoil == "one unsafe path":
        (failure,) = messages(effects, LogEvent)
        assert failure.message.data["error"].count(";") == 0  # one problem is enough
    assert messages(effects, Plan) == []
    assert jobs(desk.wait(0.9)) == []
    (job,) = jobs(desk.wait(0.1))
    (plan, _) = messages(desk.give(run_job(job)), Plan)
    assert plan.message.ballot == ballot


@pytest.mark.slow
@pytest.mark.parametrize("cell", variants(map(pytest.param, ((-1, 1), (-4, 0), (77, 0), (3, 2)))))
def test_cells_that_cannot_be_planned_from_do_not_stop_the_coordinator(cell: Cell) -> None:
    """Outside the block, or the cell of another vehicle."""
    desk = leading({A: (0, 0), B: (-1, 1)})
    desk.tell(state(A))
    desk.tell(state(B))
    desk.tell(changed(state(A, promised=desk.ballot, t_s=1.0), hold_cell=cell))
    (job,) = jobs(desk.tell(state(B, (-1, 1), desk.ballot, t_s=1.0)))
    assert logged(desk.give(run_job(job))) == ["planning-failed"]


def test_too_late_for_any_step_settles() -> None:
    desk = leading({A: (0, 0)}, t_s=66.0)
    desk.tell(state(A))
    effects = desk.tell(state(A, (0, 0), desk.ballot, t_s=1.0))
    assert jobs(effects) == []
    assert logged(effects) == ["formation-too-late"]
    assert desk.leaders[0].phase is BallotPhase.ABORTED
    assert logged(desk.wait(5.0)) == []


@pytest.mark.slow
def test_failed_planning_searches_further_each_time() -> None:
    """The bound on nodes doubles, so hard tasks are solved eventually."""
    few = evolve(PAPER, formation=evolve(PAPER.formation, solver="branching", max_nodes=1))
    desk = Desk(scenario=few)
    cells: Cells = {A: (0, 0), B: (-1, 1), C: (-2, 0), D: (-3, 1), E: (0, 2), F: (-2, 2)}
    effects = desk.collect_promises(cells, dict(zip(cells, (2, 2, 1, 0, 0, 1), strict=True)))
    outcomes: list[list[str]] = []
    while not outcomes or "plan-made" not in outcomes[-1]:
        (job,) = jobs(effects)
        outcomes.append(logged(desk.give(run_job(job))))
        assert len(outcomes) < 10
        effects = desk.wait(8.0)
    assert outcomes[0] == ["planning-failed"]


@st.composite
def rosters(draw: st.DrawFn) -> tuple[Cells, dict[Name, int]]:
    block = sorted(PAPER.lattice.block_cells(0))
    cells = draw(st.lists(st.sampled_from(block), min_size=1, max_size=6, unique=True))
    fit = [lane for lane in range(PAPER.lattice.lanes) for _ in range(PAPER.lattice.block_columns)]
    lanes = draw(st.permutations(fit))
    names = [Name(f"v{index}") for index in range(len(cells))]
    return dict(zip(names, cells, strict=True)), dict(zip(names, lanes, strict=False))


@pytest.mark.slow
@examples(15)
@given(roster=rosters(), t_s=st.floats(4.1, 40.0))
def test_every_plan_is_executable_and_serves_all_preferences(
    roster: tuple[Cells, dict[Name, int]], t_s: float
) -> None:
    cells, lanes = roster
    # However slow the machine is.
    patient = evolve(PAPER, formation=evolve(PAPER.formation, planning_deadline_s=3600.0))
    desk = Desk(scenario=patient)
    desk.core._road.on_message(0, t_s, desk.now_s)
    (job,) = jobs(desk.collect_promises(cells, lanes))
    plan: Plan = messages(desk.give(run_job(job)), Plan)[0].message
    assert plan_problems(plan) == []
    assert plan.roster == tuple(cells)
    assert plan.start_cells == cells
    assert set(plan.territory) <= PAPER.lattice.block_cells(0)
    assert plan.slot_s == PAPER.timing.cycles_s[0]
    now_s = max(t_s, T_S)
    assert plan.t0_s == start_time_s(cells.values(), now_s + START_MARGIN_S, PAPER) > now_s
    for name, moves in plan.moves.items():
        end = moves[-1][2] if moves else cells[name]
        assert end[1] == lanes[name]


@pytest.mark.parametrize(
    ("t_s", "given_s", "deadline_s"),
    [(8.0, None, 15.0), (T_S, None, 7.0), (40.0, None, 1.0), (T_S, 0.25, 0.25)],
)
def test_planning_may_last_until_the_first_move(
    monkeypatch: pytest.MonkeyPatch, t_s: float, given_s: float | None, deadline_s: float
) -> None:
    asked = list[float]()

    def record(task: SortingTask, max_nodes: int, plan: PlanFunction, clock: Clock) -> Sorting:
        asked.append(task.deadline_s)
        return sort_lanes(task, max_nodes, plan, clock)

    monkeypatch.setattr(formation_planner, "sort_lanes", record)
    formation = evolve(PAPER.formation, planning_deadline_s=given_s)
    desk = Desk(scenario=evolve(PAPER, formation=formation))
    desk.core._road.on_message(0, t_s, desk.now_s)
    desk.lead()
    desk.tell(census({A: (0, 0)}, {A: 1}, t_s=t_s))
    desk.tell(state(A, (0, 0)))
    (job,) = jobs(desk.promise({A: (0, 0)}))
    run_job(job)
    assert asked == [pytest.approx(deadline_s)]  # the first move may begin at 27 s


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
                desk.tell(state(name, both[name]))
                ballot = desk.leaders[number].ballot
                assert ballot is not None
                seen.append(ballot)
            desk.tell(Heartbeat(Name("c1"), 1, 9, leading=True, plans=0))
            desk.wait(2 * PAPER.network.election_s)
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
    """With an equal term the name alone could make it the lower one."""
    desk = Desk()
    desk.lead()
    assert desk.core.election.term == 1
    desk.tell(census({A: (0, 0)}))
    desk.tell(state(A, promised=shown))
    assert desk.ballot > shown
    assert desk.core.election.term == 1  # one vehicle does not raise what others are asked for


# --- the service ------------------------------------------------------------------------------


PLAN_REQUEST = (
    b'{"schema": "laneweave.plan.request/1", "grid": {"columns": 2, "lanes": 2},'
    b' "vehicles": [{"id": "a", "cell": [0, 0]}], "targets": [[1, 0]]}'
)


def test_the_service_answers_without_leading() -> None:
    desk = Desk()
    (job,) = [e for e in desk.give(QueryArrived(5, PLAN_REQUEST)) if isinstance(e, Delegate)]
    (reply,) = [
        e for e in desk.give(run_delegated(job, lambda: desk.now_s)) if isinstance(e, Reply)
    ]
    assert (reply.token, reply.ok) == (5, True)
    (refusal,) = [e for e in desk.give(QueryArrived(6, b"{}")) if isinstance(e, Reply)]
    assert (refusal.token, refusal.ok) == (6, False)


def test_a_request_ends_with_its_clients_session() -> None:
    desk = Desk()
    sender = {"session": "s", "client": "dispatch"}
    assert desk.give(PeerUp(CLIENT_ALIVE, sender)) == []
    (job,) = desk.give(QueryArrived(5, PLAN_REQUEST, sender=sender))
    assert isinstance(job, Delegate)
    effects = desk.give(PeerDown(CLIENT_ALIVE, sender))
    assert [type(effect) for effect in effects] == [StopJob, Decline]
    assert desk.give(QueryArrived(6, PLAN_REQUEST, sender=sender)) == [Decline(6)]


def test_a_client_cancels_its_request() -> None:
    desk = Desk()
    named = PLAN_REQUEST.replace(b'"grid"', b'"id": "r1", "grid"')
    desk.give(QueryArrived(5, named))
    cancellation = b'{"schema": "laneweave.plan.cancel/1", "id": "r1"}'
    effects = desk.give(QueryArrived(6, cancellation, topic=SERVICE_CANCEL))
    assert [type(effect) for effect in effects] == [StopJob, Reply, Reply]
