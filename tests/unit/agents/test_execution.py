"""Rules V1 to V7 of the execution protocol, guard by guard."""

from __future__ import annotations

import pytest
from attrs import evolve

from laneweave.agents.execution import PlanExecution
from laneweave.protocol.lattice import Cell, Move, territory
from laneweave.protocol.messages import Ballot, Name, Plan, Prepare, VehicleState

A, B, C = Name("A"), Name("B"), Name("C")
LOW = Ballot(1, Name("c1"), 10, 1)
MID = Ballot(1, Name("c2"), 5, 9)
HIGH = Ballot(2, Name("c1"), 10, 2)
SLOT_S = 4.0
T0_S = 100.0
OVERDUE_S = 6.0
AT: dict[Name, Cell] = {A: (0, 0), B: (1, 0)}


def vehicle(name: Name = A, cell: Cell = (0, 0), *, moving: bool = False) -> PlanExecution:
    return PlanExecution(name, 7, cell, OVERDUE_S, moving=moving)


def prepare(ballot: Ballot, *roster: Name) -> Prepare:
    return Prepare(ballot, 0, roster or (A, B))


def make_plan(
    ballot: Ballot = MID,
    moves: dict[Name, tuple[Move, ...]] | None = None,
    cells: dict[Name, Cell] | None = None,
) -> Plan:
    cells = cells or AT
    moves = dict.fromkeys(cells, ()) | (moves or {A: ((0, (0, 0), (0, 1)),)})
    return Plan(
        ballot=ballot,
        formation=0,
        roster=tuple(cells),
        incarnations=dict.fromkeys(cells, 7),
        start_cells=cells,
        moves=moves,
        t0_s=T0_S,
        slot_s=SLOT_S,
        territory=tuple(territory(cells.values(), [m for each in moves.values() for m in each])),
    )


def shown(
    name: Name = B,
    ballot: Ballot | None = MID,
    completed: int = 0,
    *,
    accepted: bool = True,
    ready: bool = True,
    go: bool = False,
) -> VehicleState:
    return VehicleState(
        vehicle=name,
        incarnation=7,
        formation=0,
        promised=ballot,
        accepted=accepted,
        ready=ready,
        completed=completed,
        hold_cell=(0, 0),
        moving=False,
        go=go,
        done=False,
        overdue=False,
        s_m=0.0,
        y_m=0.0,
        speed_mps=0.0,
        t_s=0.0,
    )


def accepted(plan: Plan | None = None, name: Name = A) -> PlanExecution:
    plan = plan or make_plan()
    execution = vehicle(name, plan.start_cells[name])
    execution.on_prepare(prepare(plan.ballot, *plan.roster))
    assert execution.on_plan(plan)
    return execution


# --- V1 ---------------------------------------------------------------------------------------


def test_v1_starts_with_nothing() -> None:
    execution = vehicle()
    assert (execution.promised, execution.plan, execution.completed) == (None, None, 0)
    assert not any((execution.go, execution.ready, execution.done, execution.moving))
    assert execution.next_move(1e9) is None
    assert not execution.overdue(1e9)


def test_v1_takes_a_motion_over() -> None:
    execution = vehicle(cell=(0, 1), moving=True)
    assert not execution.ready
    execution.end_motion()
    assert (execution.moving, execution.completed, execution.hold_cell) == (False, 0, (0, 1))


# --- V2 ---------------------------------------------------------------------------------------


def test_v2_promises_rising_ballots_only() -> None:
    execution = vehicle()
    for ballot, promised in ((MID, MID), (LOW, MID), (MID, MID), (HIGH, HIGH), (MID, HIGH)):
        assert execution.on_prepare(prepare(ballot))  # whatever the ballot, the state answers
        assert execution.promised == promised


@pytest.mark.parametrize(
    ("lower", "higher"),
    [
        (Ballot(1, Name("z"), 9, 9), Ballot(2, Name("a"), 1, 1)),
        (Ballot(1, Name("a"), 9, 9), Ballot(1, Name("b"), 1, 1)),
        (Ballot(1, Name("a"), 1, 9), Ballot(1, Name("a"), 2, 1)),
        (Ballot(1, Name("a"), 1, 9), Ballot(1, Name("a"), 1, 10)),
    ],
)
def test_v2_term_then_coordinator_then_incarnation_then_seq(lower: Ballot, higher: Ballot) -> None:
    execution = vehicle()
    execution.on_prepare(prepare(lower))
    execution.on_prepare(prepare(higher))
    assert execution.promised == higher
    execution.on_prepare(prepare(lower))
    assert execution.promised == higher


def test_v2_not_in_the_roster() -> None:
    execution = vehicle()
    assert not execution.on_prepare(prepare(HIGH, B, C))
    assert execution.promised is None


def test_v2_forgets_plan_progress_gate_and_what_was_heard() -> None:
    execution = accepted()
    execution.on_state(shown(completed=3, go=True))
    move = execution.next_move(T0_S)
    assert move is not None
    execution.begin(move)
    execution.end_motion()
    assert execution.completed == 1
    execution.on_prepare(prepare(HIGH))
    assert (execution.plan, execution.completed, execution.go) == (None, 0, False)
    assert execution.heard == {}
    assert execution.hold_cell == (0, 1)


@pytest.mark.parametrize("ballot", [LOW, MID])
def test_v2_a_repeat_or_a_lower_ballot_changes_nothing(ballot: Ballot) -> None:
    execution = accepted()
    execution.on_state(shown())
    before = repr(execution)
    assert execution.on_prepare(prepare(ballot))
    assert repr(execution) == before


def test_v2_while_moving_the_motion_ends_but_counts_for_no_plan() -> None:
    execution = accepted()
    execution.on_state(shown())
    move = execution.next_move(T0_S)
    assert move == (0, (0, 0), (0, 1))
    execution.begin(move)
    assert (execution.hold_cell, execution.moving, execution.ready) == ((0, 1), True, True)

    execution.on_prepare(prepare(HIGH))
    assert (execution.hold_cell, execution.moving, execution.ready) == ((0, 1), True, False)
    newer = make_plan(HIGH, {A: ((0, (0, 1), (0, 2)),)}, {A: (0, 1), B: (1, 0)})
    assert execution.on_plan(newer)
    assert not execution.ready  # it still occupies the footprint of the old move
    execution.on_state(shown(ballot=HIGH))
    assert execution.next_move(T0_S) is None
    assert not execution.go

    execution.end_motion()
    assert execution.completed == 0
    assert execution.ready
    assert execution.next_move(T0_S) == (0, (0, 1), (0, 2))


# --- V3 ---------------------------------------------------------------------------------------


def test_v3_accepts_the_plan_of_the_promised_ballot_once() -> None:
    execution = accepted()
    plan = execution.plan
    assert execution.ready
    assert not execution.on_plan(make_plan())
    assert not execution.on_plan(make_plan(moves={A: ((0, (0, 0), (-1, 0)),)}))  # a second one
    assert execution.plan is plan


def test_v3_needs_a_promise() -> None:
    assert not vehicle().on_plan(make_plan())


@pytest.mark.parametrize("ballot", [LOW, HIGH])
def test_v3_ignores_plans_of_other_ballots(ballot: Ballot) -> None:
    execution = vehicle()
    execution.on_prepare(prepare(MID))
    assert not execution.on_plan(make_plan(ballot))
    assert (execution.plan, execution.promised) == (None, MID)


@pytest.mark.parametrize(
    "spoiled",
    [
        evolve(make_plan(), incarnations={A: 6, B: 7}),
        evolve(make_plan(), incarnations={A: 8, B: 7}),
        evolve(make_plan(), incarnations={B: 7}),
        make_plan(cells={A: (0, 2), B: (1, 0)}, moves={B: ()}),
        evolve(make_plan(), start_cells={B: (1, 0)}),
        evolve(make_plan(), territory=()),
        evolve(make_plan(), roster=(B,)),
        make_plan(moves={A: ((0, (0, 0), (1, 0)),)}),
        make_plan(moves={A: ((0, (0, 0), (0, 2)),)}),
    ],
    ids=[
        "older incarnation",
        "newer incarnation",
        "no incarnation",
        "other start cell",
        "no start cell",
        "territory",
        "not in the roster",
        "drives into B",
        "jumps",
    ],
)
def test_v3_ignores_a_plan_that_does_not_fit(spoiled: Plan) -> None:
    execution = vehicle()
    execution.on_prepare(prepare(MID))
    assert not execution.on_plan(spoiled)
    assert execution.plan is None
    assert execution.on_plan(make_plan())  # the right one is still welcome


# --- V4 and V5 --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "state",
    [
        shown(accepted=False),
        shown(ballot=LOW),
        shown(ballot=HIGH, completed=5, go=True),
        shown(ballot=None, accepted=False),
        shown(name=C, go=True),
        shown(name=A, go=True),
    ],
    ids=["not accepted", "older ballot", "newer ballot", "nothing", "a stranger", "itself"],
)
def test_v4_states_that_say_nothing(state: VehicleState) -> None:
    execution = accepted()
    execution.on_state(state)
    assert execution.heard == {}
    assert execution.next_move(T0_S) is None
    assert not execution.go


def test_v4_without_a_plan_nothing_is_heard() -> None:
    execution = vehicle()
    execution.on_state(shown(go=True))
    execution.on_prepare(prepare(MID))
    execution.on_state(shown(go=True))
    assert (execution.heard, execution.go) == ({}, False)


def test_v4_not_ready_counts_as_nothing_completed() -> None:
    execution = accepted()
    execution.on_state(shown(ready=False, completed=2))
    assert execution.heard == {B: -1}
    assert execution.next_move(T0_S) is None
    execution.on_state(shown(completed=0))
    assert execution.heard == {B: 0}


def test_v4_late_states_take_nothing_back() -> None:
    execution = accepted()
    for completed, ready, known in ((2, True, 2), (1, True, 2), (5, False, 2), (3, True, 3)):
        execution.on_state(shown(completed=completed, ready=ready))
        assert execution.heard == {B: known}


def test_v4_an_open_gate_spreads() -> None:
    execution = accepted()
    execution.on_state(shown(ready=False, go=True))
    assert execution.go
    assert execution.next_move(T0_S) is not None
    execution.on_state(shown(go=False))
    assert execution.go


def test_v5_the_gate_needs_everybody() -> None:
    cells: dict[Name, Cell] = {A: (0, 0), B: (2, 0), C: (3, 0)}
    execution = accepted(make_plan(cells=cells))
    assert execution.next_move(T0_S) is None
    execution.on_state(shown(B))
    assert execution.next_move(T0_S) is None
    execution.on_state(shown(C, ready=False))
    assert execution.next_move(T0_S) is None
    execution.on_state(shown(C))
    assert execution.next_move(T0_S) == (0, (0, 0), (0, 1))
    assert execution.go


def test_v5_alone_in_the_roster() -> None:
    execution = accepted(make_plan(cells={A: (0, 0)}))
    assert execution.next_move(T0_S) is not None


def test_v5_opens_for_others_before_the_own_time_and_without_own_moves() -> None:
    execution = accepted(name=B)
    execution.on_state(shown(A))
    assert execution.next_move(T0_S - 50.0) is None
    assert execution.go


# --- V6 and V7 --------------------------------------------------------------------------------


def test_v6_not_before_its_time() -> None:
    execution = accepted(make_plan(moves={A: ((3, (0, 0), (0, 1)),)}))
    execution.on_state(shown())
    due_s = T0_S + 3 * SLOT_S
    assert execution.next_move(due_s - 0.01) is None
    assert execution.next_move(due_s) == (3, (0, 0), (0, 1))
    assert execution.next_move(due_s + 100.0) == (3, (0, 0), (0, 1))


def test_v6_dependencies() -> None:
    """B follows A through two cells: each of its moves waits for the count that frees them."""
    moves: dict[Name, tuple[Move, ...]] = {
        A: ((0, (1, 0), (2, 0)), (1, (2, 0), (3, 0)), (5, (3, 0), (3, 1))),
        B: ((1, (0, 0), (1, 0)), (2, (1, 0), (2, 0))),
    }
    execution = accepted(make_plan(moves=moves, cells={A: (1, 0), B: (0, 0)}), B)
    late_s = T0_S + 100.0
    execution.on_state(shown(A, completed=0))
    assert execution.next_move(late_s) is None
    execution.on_state(shown(A, completed=1))
    first = execution.next_move(late_s)
    assert first == (1, (0, 0), (1, 0))
    execution.begin(first)
    assert execution.next_move(late_s) is None  # one at a time
    execution.end_motion()
    assert execution.next_move(late_s) is None
    execution.on_state(shown(A, completed=2))
    assert execution.next_move(late_s) == (2, (1, 0), (2, 0))


def test_v7_counts_and_is_done() -> None:
    moves: dict[Name, tuple[Move, ...]] = {A: ((0, (0, 0), (0, 1)), (1, (0, 1), (0, 2)))}
    execution = accepted(make_plan(moves=moves))
    execution.on_state(shown())
    for count, t_s in ((0, T0_S), (1, T0_S + SLOT_S)):
        assert execution.completed == count
        assert not execution.done
        move = execution.next_move(t_s)
        assert move is not None
        execution.begin(move)
        execution.end_motion()
    assert execution.done
    assert execution.hold_cell == (0, 2)
    assert execution.next_move(T0_S + 1000.0) is None


def test_v7_without_a_motion_nothing_ends() -> None:
    execution = accepted()
    execution.end_motion()
    assert execution.completed == 0


def test_without_moves_it_is_done_at_once() -> None:
    execution = accepted(name=B)
    assert execution.done
    assert not execution.overdue(T0_S + 1000.0)


def test_states_matter_until_the_gate_is_open_and_while_a_move_waits() -> None:
    assert not vehicle().needs_states(T0_S)
    moves: dict[Name, tuple[Move, ...]] = {
        A: ((0, (1, 0), (2, 0)),),
        B: ((1, (0, 0), (1, 0)),),
    }
    execution = accepted(make_plan(moves=moves, cells={A: (1, 0), B: (0, 0)}), B)
    assert execution.needs_states(0.0)
    execution.on_state(shown(A, go=True))
    assert not execution.needs_states(T0_S - SLOT_S - 0.1)
    assert execution.needs_states(T0_S - SLOT_S)
    execution.on_state(shown(A, completed=1))
    assert not execution.needs_states(T0_S)


def test_overdue_runs_from_the_moment_the_next_move_is_due() -> None:
    execution = accepted(make_plan(moves={A: ((2, (0, 0), (0, 1)),)}))
    due_s = T0_S + 2 * SLOT_S
    assert not execution.overdue(due_s + OVERDUE_S - 0.01)
    assert execution.overdue(due_s + OVERDUE_S)
    execution.on_state(shown())
    move = execution.next_move(due_s + OVERDUE_S)
    assert move is not None
    execution.begin(move)
    assert not execution.overdue(due_s + OVERDUE_S)  # on its way
    execution.end_motion()
    assert not execution.overdue(due_s + 100.0)  # done
    execution.on_prepare(prepare(HIGH))
    assert not execution.overdue(due_s + 100.0)  # no plan
