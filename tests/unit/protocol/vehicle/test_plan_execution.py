"""Rules V1 to V8 of the execution protocol, guard by guard."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell, Lattice, PlannedMove
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES, both_lanes_are_open
from laneweave.protocol.vehicle.lane_ends import LATE_S, LaneEnds, early_start_m
from laneweave.protocol.vehicle.plan_execution import LISTEN_S, ExecutionPhase, PlanExecution
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.vehicle.territory import BlockTerritory
from laneweave.protocol.wire.messages import (
    Ballot,
    CurrentMotion,
    Name,
    Plan,
    Prepare,
    Sense,
    VehicleRecord,
    VehicleState,
)
from support.convoy import ROLLING
from support.rule_books import RuleRecorder
from support.states import holding
from support.states import make_plan as plan_of

A, B, C = Name("A"), Name("B"), Name("C")
LOW = Ballot(1, Name("c1"), 10, 1)
MID = Ballot(1, Name("c2"), 5, 9)
HIGH = Ballot(2, Name("c1"), 10, 2)
SLOT_S = 4.0
T0_S = 100.0
OVERDUE_S = 6.0
LATTICE = Lattice(pitch_m=15.0, speed_mps=15.0, lane_width_m=3.5, lanes=3, block_columns=8)
"""Block 0 has the columns -7 to 0, block 1 those from -15 to -8."""
AT: dict[Name, Cell] = {A: (-4, 0), B: (-3, 0)}


def vehicle(name: Name = A, cell: Cell = (-4, 0), **more: Any) -> PlanExecution:  # noqa: ANN401
    stored = VehicleRecord(incarnation=7, joined=more.pop("joined", (0,)))
    return PlanExecution(
        name, 7, cell, BlockTerritory(LATTICE), stored, **{"rules": VEHICLE_RULES, **more}
    )


def note(execution: PlanExecution, ballot: Ballot | None) -> bool:
    """Let the controller report that it has stored an acceptance."""
    return execution.on_record(replace(execution.stored, accepted=ballot))


def prepare(ballot: Ballot, *roster: Name, blocks: tuple[int, ...] = (0,)) -> Prepare:
    return Prepare(ballot, blocks, roster or (A, B))


def make_plan(
    ballot: Ballot = MID,
    moves: dict[Name, tuple[PlannedMove, ...]] | None = None,
    cells: dict[Name, Cell] | None = None,
    blocks: tuple[int, ...] = (0,),
) -> Plan:
    cells = cells or AT
    return plan_of(
        cells,
        moves or {A: ((0, (-4, 0), (-4, 1)),)},
        ballot=ballot,
        blocks=blocks,
        incarnations=dict.fromkeys(cells, 7),
        t0_s=T0_S,
        slot_s=SLOT_S,
    )


def shown(name: Name = B, ballot: Ballot | None = MID, **more: object) -> VehicleState:
    """Return the state of a vehicle that has accepted a plan and is ready."""
    return holding(name, ballot, (-4, 0), **({"accepted": True, "ready": True} | more))


def taken(plan: Plan | None = None, name: Name = A) -> PlanExecution:
    """Promise and take a plan, which the controller has not noted yet."""
    plan = plan or make_plan()
    execution = vehicle(name, plan.start_cells[name])
    execution.on_prepare(prepare(plan.ballot, *plan.roster))
    assert execution.on_plan(plan)
    return execution


def accepted(plan: Plan | None = None, name: Name = A) -> PlanExecution:
    execution = taken(plan, name)
    assert note(execution, MID)
    return execution


def going(plan: Plan | None = None) -> PlanExecution:
    """Accept a plan and hear the open gate from the other member."""
    execution = accepted(plan)
    execution.on_state(shown(go=True))
    assert execution.go
    return execution


# --- V1 ---------------------------------------------------------------------------------------


def test_v1_starts_with_nothing() -> None:
    execution = vehicle(joined=(0, 3))
    assert (execution.promised, execution.plan, execution.completed) == (None, None, 0)
    assert not any((execution.go, execution.ready, execution.done, execution.moving))
    assert (execution.phase, execution.next_move, execution.tick(1e9)) == (
        ExecutionPhase.FREE,
        None,
        None,
    )
    assert not execution.overdue(1e9)
    assert execution.wanted_joined == execution.stored.joined == (0, 3)


def test_v1_takes_a_motion_over() -> None:
    execution = vehicle(cell=(-4, 1), moving=True)
    assert not execution.ready
    execution.on_body(arrived=True)
    assert (execution.moving, execution.completed, execution.hold_cell) == (False, 0, (-4, 1))


# --- V2 ---------------------------------------------------------------------------------------


def test_v2_promises_rising_ballots_only() -> None:
    execution = vehicle()
    for ballot, promised in ((MID, MID), (LOW, MID), (MID, MID), (HIGH, HIGH), (MID, HIGH)):
        assert execution.on_prepare(prepare(ballot))  # whatever the ballot, the state answers
        assert execution.promised == promised
        assert execution.phase is ExecutionPhase.PROMISED


def test_v2_not_in_the_roster() -> None:
    execution = vehicle()
    assert not execution.on_prepare(prepare(HIGH, B, C, blocks=(0, 1)))
    assert (execution.promised, execution.phase) == (None, ExecutionPhase.FREE)
    assert execution.wanted_joined == (0,)


def test_v2_ignores_formations_to_which_it_does_not_belong_any_more() -> None:
    """A late ballot may name a vehicle that has left the lattice and entered it elsewhere."""
    execution = vehicle(joined=(7, 8))
    assert not execution.on_prepare(prepare(HIGH, blocks=(0, 1)))
    assert (execution.promised, execution.wanted_joined) == (None, (7, 8))
    assert execution.on_prepare(prepare(LOW, blocks=(6, 7)))
    assert execution.promised == LOW


@pytest.mark.parametrize("ballot", [LOW, MID])
@pytest.mark.parametrize("reach", [taken, accepted, going])
def test_v2_a_repeat_or_a_lower_ballot_changes_nothing(
    ballot: Ballot, reach: Callable[[], PlanExecution]
) -> None:
    execution = reach()
    execution.on_state(shown())
    before = repr(execution)
    assert execution.on_prepare(prepare(ballot, blocks=(0, 1)))
    assert repr(execution) == before


def test_v2_asks_for_the_formations_of_the_ballot_and_never_for_fewer() -> None:
    execution = vehicle(joined=(0, 2))
    for ballot, formations, wanted in (
        (LOW, (0, 1), (0, 1, 2)),
        (MID, (0,), (0, 1, 2)),
        (HIGH, (5, 0), (0, 1, 2, 5)),
    ):
        execution.on_prepare(prepare(ballot, blocks=formations))
        assert execution.wanted_joined == wanted
        assert execution.stored.joined == (0, 2)  # only the motion controller changes that


def test_late_reports_do_not_undo_joining() -> None:
    execution = vehicle(joined=(0, 2))
    for heard, news, known in (
        ((0,), False, (0, 2)),
        ((), False, (0, 2)),
        ((0, 1, 2), True, (0, 1, 2)),
        ((0, 1, 2), False, (0, 1, 2)),
        ((5, 0), True, (0, 1, 2, 5)),
        ((0, 2), False, (0, 1, 2, 5)),
    ):
        assert execution.on_record(replace(execution.stored, joined=heard)) == news
        assert execution.stored.joined == known


# --- V3 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reach", "phase"), [(accepted, ExecutionPhase.GATED), (going, ExecutionPhase.GOING)]
)
def test_v3_accepts_the_plan_of_the_promised_ballot_once(
    reach: Callable[[], PlanExecution], phase: ExecutionPhase
) -> None:
    execution = reach()
    plan = execution.plan
    assert (execution.ready, execution.phase) == (True, phase)
    for second in (make_plan(), make_plan(moves={A: ((0, (-4, 0), (-5, 0)),)})):
        assert not execution.on_plan(second)
        assert (execution.plan, execution.phase) == (plan, phase)


UNFIT = {
    "older incarnation": replace(make_plan(), incarnations={A: 6, B: 7}),
    "newer incarnation": replace(make_plan(), incarnations={A: 8, B: 7}),
    "no incarnation": replace(make_plan(), incarnations={B: 7}),
    "lower ballot": make_plan(LOW),
    "higher ballot": make_plan(HIGH),
    "other start cell": make_plan(cells={A: (-4, 2), B: (-3, 0)}, moves={B: ()}),
    "no start cell": replace(make_plan(), start_cells={B: (-3, 0)}),
    "territory": replace(make_plan(), territory=()),
    "not in the roster": replace(make_plan(), roster=(B,)),
    "drives into B": make_plan(moves={A: ((0, (-4, 0), (-3, 0)),)}),
    "jumps": make_plan(moves={A: ((0, (-4, 0), (-4, 2)),)}),
    "no time": replace(make_plan(), slot_s=0.0),
    "no block": replace(make_plan(), blocks=()),
    "another block": replace(make_plan(), blocks=(1,)),
    "a block that is not joined": make_plan(blocks=(0, 1)),
}


@pytest.mark.parametrize("unfit", UNFIT.values(), ids=UNFIT.keys())
def test_v3_ignores_a_plan_that_does_not_fit(unfit: Plan) -> None:
    execution = vehicle()
    assert not execution.on_plan(make_plan())  # nothing is promised
    execution.on_prepare(prepare(MID))
    assert not execution.on_plan(unfit)
    assert (execution.plan, execution.needs, execution.phase) == (None, (), ExecutionPhase.PROMISED)
    assert execution.on_plan(make_plan())  # the right one is still accepted


@pytest.mark.parametrize("beyond", [(-8, 0), (1, 0), (-4, 3), (-4, -1), (-20, 0)])
def test_v3_the_territory_stays_within_the_blocks_of_the_plan(beyond: Cell) -> None:
    """Plans of other formations run at the same time; only the blocks keep them apart."""
    execution = vehicle()
    execution.on_prepare(prepare(MID))
    plan = make_plan()
    assert not execution.on_plan(replace(plan, territory=(*plan.territory, beyond)))
    assert execution.on_plan(replace(plan, territory=(*plan.territory, (-7, 2), (0, 2))))


def test_v3_a_joint_plan_waits_until_the_controller_has_confirmed_its_formations() -> None:
    execution = vehicle()
    execution.on_prepare(prepare(MID, blocks=(0, 1)))
    joint = make_plan(
        moves={A: ((0, (-4, 0), (-4, 1)),)}, cells={A: (-4, 0), B: (-9, 0)}, blocks=(0, 1)
    )
    for joined in ((0,), (1,), (), (0, 2)):
        execution.stored = replace(execution.stored, joined=joined)
        assert not execution.on_plan(joint)
    execution.stored = replace(execution.stored, joined=(0, 1))
    assert execution.on_plan(joint)


@pytest.mark.parametrize("formations", [(0,), (1,), (0, 1), (1, 2), (0, 2)])
def test_v3_ignores_a_plan_for_some_of_the_blocks_that_are_joined(
    formations: tuple[int, ...],
) -> None:
    """Vehicles of the other blocks may be in any of them."""
    execution = vehicle(joined=(0, 1, 2))
    execution.on_prepare(prepare(MID, blocks=(0, 1, 2)))
    cells: dict[Name, Cell] = {A: (-4, 0)}
    assert not execution.on_plan(make_plan(cells=cells, blocks=formations))
    assert execution.on_plan(make_plan(cells=cells, blocks=(0, 1, 2)))


def waits(execution: PlanExecution) -> bool:
    """Return whether a vehicle neither acts nor reports as one that has accepted."""
    return (
        execution.phase is ExecutionPhase.TAKEN
        and execution.tick(T0_S + 100.0) is None
        and not any((execution.accepted, execution.ready, execution.go, execution.done))
        and not execution.overdue(T0_S + 1000.0)
    )


@pytest.mark.parametrize("name", [A, B])  # B has no moves
def test_v3_a_plan_is_accepted_when_the_controller_has_noted_it(name: Name) -> None:
    execution = taken(name=name)
    for heard in ((), (shown(A), shown(B)), (shown(A, go=True), shown(B, go=True))):
        for state in heard:
            execution.on_state(state)
        assert waits(execution)  # whatever the others show
    assert execution.needs_states(0.0)
    for other in (None, LOW, HIGH):
        assert not note(execution, other)
        assert waits(execution)
    assert note(execution, MID)
    assert not note(execution, MID)  # once
    assert execution.phase is ExecutionPhase.GATED
    assert execution.accepted
    assert execution.ready
    assert execution.done == (name == B)
    execution.tick(T0_S)
    assert execution.go  # what it has heard meanwhile counts


# --- V4 and V5 --------------------------------------------------------------------------------


IRRELEVANT = {
    "not accepted": shown(accepted=False),
    "not accepted, but go": shown(accepted=False, go=True),
    "older ballot": shown(ballot=LOW),
    "newer ballot": shown(ballot=HIGH, completed=5, go=True),
    "nothing": shown(ballot=None, accepted=False),
    "a stranger": shown(name=C, go=True),
    "itself": shown(name=A, go=True),
}


@pytest.mark.parametrize("state", IRRELEVANT.values(), ids=IRRELEVANT.keys())
def test_v4_irrelevant_states_are_ignored(state: VehicleState) -> None:
    execution = accepted()
    execution.on_state(state)
    assert execution.progress == {}
    assert execution.tick(T0_S) is None
    assert not execution.go


@pytest.mark.parametrize("reach", [taken, accepted, going])
def test_v4_late_states_do_not_lower_what_was_heard(reach: Callable[[], PlanExecution]) -> None:
    execution = reach()
    execution.progress = {}
    for completed, ready, known in (
        (2, False, -1), (2, True, 2), (1, True, 2), (5, False, 2), (3, True, 3)
    ):  # fmt: skip
        execution.on_state(shown(completed=completed, ready=ready))
        assert execution.progress == {B: known}


def test_v4_an_open_gate_spreads() -> None:
    execution = accepted()
    execution.on_state(shown(ready=False, go=True))
    assert execution.go
    execution.on_state(shown(go=False))
    assert execution.go
    assert execution.tick(T0_S) is not None


def test_v5_the_gate_needs_all_members() -> None:
    cells: dict[Name, Cell] = {A: (-4, 0), B: (-2, 0), C: (-1, 0)}
    execution = accepted(make_plan(cells=cells))
    assert execution.tick(T0_S) is None
    execution.on_state(shown(B))
    assert execution.tick(T0_S) is None
    execution.on_state(shown(C, ready=False))
    assert execution.tick(T0_S) is None
    assert not execution.go
    execution.on_state(shown(C))
    assert execution.tick(T0_S) == (0, (-4, 0), (-4, 1))
    assert execution.go


def test_v5_opens_for_others_before_the_own_time_and_without_own_moves() -> None:
    execution = accepted(name=B)
    execution.on_state(shown(A))
    assert execution.tick(T0_S - 50.0) is None
    assert execution.go


# --- V6 and V7 --------------------------------------------------------------------------------


def test_v6_not_before_its_time() -> None:
    execution = going(make_plan(moves={A: ((3, (-4, 0), (-4, 1)),)}))
    due_s = T0_S + 3 * SLOT_S
    assert execution.tick(due_s - 0.01) is None
    assert (execution.hold_cell, execution.moving) == ((-4, 0), False)
    assert execution.tick(due_s) == (3, (-4, 0), (-4, 1))
    assert (execution.hold_cell, execution.moving) == ((-4, 1), True)


@pytest.mark.parametrize("reach", [vehicle, taken, accepted, going])
def test_v7_without_a_motion_nothing_ends(reach: Callable[[], PlanExecution]) -> None:
    execution = reach()
    before = repr(execution)
    execution.on_body(arrived=True)
    assert repr(execution) == before


# --- published states and needed states -------------------------------------------------------


def test_states_matter_until_the_gate_is_open_and_while_a_move_waits() -> None:
    assert not vehicle().needs_states(T0_S)
    moves: dict[Name, tuple[PlannedMove, ...]] = {
        A: ((0, (-3, 0), (-2, 0)),),
        B: ((1, (-4, 0), (-3, 0)),),
    }
    execution = accepted(make_plan(moves=moves, cells={A: (-3, 0), B: (-4, 0)}), B)
    assert execution.needs_states(0.0)
    execution.on_state(shown(A, go=True))
    assert not execution.needs_states(T0_S + SLOT_S - LISTEN_S - 0.1)
    assert execution.needs_states(T0_S + SLOT_S - LISTEN_S)
    execution.on_state(shown(A, completed=1))
    assert not execution.needs_states(T0_S + SLOT_S)


def test_overdue_runs_from_the_moment_the_next_move_is_due() -> None:
    execution = accepted(make_plan(moves={A: ((2, (-4, 0), (-4, 1)),)}))
    due_s = T0_S + 2 * SLOT_S
    assert not execution.overdue(due_s + OVERDUE_S - 0.01)
    assert execution.overdue(due_s + OVERDUE_S)
    execution.on_state(shown())
    assert execution.tick(due_s + OVERDUE_S) is not None
    assert not execution.overdue(due_s + OVERDUE_S)  # on its way
    execution.on_body(arrived=True)
    assert not execution.overdue(due_s + 100.0)  # done
    execution.on_prepare(prepare(HIGH))
    assert not execution.overdue(due_s + 100.0)  # no plan


@pytest.mark.parametrize(("slot_s", "patience_s"), [(1.0, 1.5), (4.0, 6.0), (7.0, 9.0)])
def test_how_long_a_move_may_be_due_follows_the_slots_of_its_plan(
    slot_s: float, patience_s: float
) -> None:
    execution = accepted(replace(make_plan(), slot_s=slot_s))
    assert not execution.overdue(T0_S + patience_s - 0.01)
    assert execution.overdue(T0_S + patience_s)


@pytest.mark.parametrize("attended", [True, False])
def test_the_state_says_what_the_vehicle_knows_and_senses(*, attended: bool) -> None:
    sense = Sense(
        A, 1001, 100.1, (7.0, 14.0, 0.5, 2.0, 0.1, 0.0), (-4, 1),
        CurrentMotion((-4, 0), 1038), 2, VehicleRecord(joined=(0,)), (), block=3,
    )  # fmt: skip
    execution = going()
    assert execution.tick(T0_S) is not None
    expected = holding(
        A, MID, (-4, 1), incarnation=7, block=3, accepted=True, ready=True, moving=True,
        go=True, attended=attended, s_m=7.0, y_m=2.0, speed_mps=14.0, t_s=100.1,
    )  # fmt: skip
    assert execution.state(sense, attended=attended) == expected
    execution.on_body(arrived=True)
    assert execution.state(sense, attended=attended) == replace(
        expected, moving=False, done=True, completed=1
    )
    late = replace(sense, t_s=T0_S + OVERDUE_S)
    assert accepted().state(late, attended=attended).overdue


# --- bodies out of their cells, and lanes that end ----------------------------------------------


def test_a_body_out_of_its_cell_is_not_ready_until_it_is_back() -> None:
    execution = accepted()
    execution.on_state(shown())
    execution.on_body(displaced=True)
    assert (execution.moving, execution.moving_in_plan, execution.ready) == (True, False, False)
    assert execution.tick(T0_S) is None
    assert not execution.go
    execution.on_body(arrived=True)
    assert (execution.ready, execution.completed) == (True, 0)
    assert execution.tick(T0_S) is not None


def test_a_body_out_of_its_cell_does_not_interrupt_a_move() -> None:
    execution = going()
    assert execution.tick(T0_S) is not None
    execution.on_body(displaced=True)
    assert execution.moving_in_plan
    execution.on_body(arrived=True)
    assert execution.completed == 1


@pytest.mark.parametrize("lane", [0, 1])
@pytest.mark.parametrize(("late_s", "begins"), [(0.0, True), (LATE_S, True), (0.3, False)])
def test_a_move_from_or_into_a_lane_that_ends_begins_only_if_it_ends_before_the_stop_line(
    lane: int, late_s: float, *, begins: bool
) -> None:
    # The move from (-4, 0) to (-4, 1) takes one slot; the line is where it ends if it is punctual.
    line_m = ROLLING.lattice.cell_s_m(-4, T0_S + SLOT_S)
    room_m = re_entry(ROLLING).room_m
    road = evolve(ROLLING.road, s3_m=20_000.0, closures=(Closure(lane, line_m + room_m + 1e-6),))
    execution = going()
    execution.lane_ends = LaneEnds(evolve(ROLLING, road=road))
    assert (execution.tick(T0_S + late_s) is not None) == begins


@pytest.mark.parametrize("lane", [0, 1])
@pytest.mark.parametrize("closed_m", [0.0, 60.0])
def test_a_move_begins_where_both_lanes_are_open(lane: int, closed_m: float) -> None:
    """It may be planned for later in its slot. Without moves between columns.

    The lane may have been open and closed before.
    """
    early = evolve(ROLLING, formation=evolve(ROLLING.formation, change_columns=False))
    cell_m = early.lattice.cell_s_m(-4, T0_S)
    # Its front may begin 20 m beyond the cell: the body, without the part that may be early.
    opens_m = cell_m + 20.0 - early.types.longest_body_m + early_start_m(early)
    closure = Closure(lane, max(0.0, opens_m - closed_m) if closed_m else 0.0, opens_m)
    road = evolve(early.road, s3_m=20_000.0, closures=(closure,))
    execution = going()
    execution.lane_ends = LaneEnds(evolve(early, road=road))
    begins_s = T0_S + 20.0 / early.lattice.speed_mps
    assert not evolve(execution, t_s=T0_S - 1.0).too_late
    assert execution.tick(T0_S) is None
    assert execution.tick(begins_s - 0.01) is None
    assert execution.tick(begins_s) is not None


@pytest.mark.parametrize("columns", [0, 1])
def test_a_lane_that_opens_again_does_not_excuse_a_move_beyond_the_stop_line(columns: int) -> None:
    """The section is that of the cell that moves, not that of the cell ahead of it."""
    origin, target = (-4, 0), (-4 + columns, 1)
    ends_m = ROLLING.lattice.cell_s_m(-4, T0_S) + 9.0
    closure = Closure(1, ends_m, ends_m + 9.0)
    road = evolve(ROLLING.road, s3_m=20_000.0, closures=(closure,))
    execution = going()
    assert execution.plan is not None
    execution.plan = replace(execution.plan, moves={execution.vehicle: ((0, origin, target),)})
    execution.lane_ends = LaneEnds(evolve(ROLLING, road=road))
    execution.t_s = T0_S
    assert both_lanes_are_open(execution, None)
    assert execution.too_late


# --- the table as a whole ---------------------------------------------------------------------


def test_a_history_takes_every_row_of_the_table() -> None:
    """No row is hidden behind an earlier one."""
    book = RuleRecorder(VEHICLE_RULES)
    execution = evolve(vehicle(moving=True), rules=book)
    execution.on_plan(make_plan())
    execution.on_body(arrived=True)
    for _ in range(2):
        execution.on_prepare(prepare(MID))
    for _ in range(2):
        execution.on_plan(make_plan())
    for _ in range(2):
        note(execution, MID)
    execution.on_state(shown())
    for _ in range(2):
        execution.tick(T0_S)
    for _ in range(2):
        execution.on_body(arrived=True)
    execution.on_prepare(prepare(HIGH))
    assert execution.on_plan(make_plan(HIGH, {A: ()}, {A: (-4, 1), B: (-3, 0)}))
    assert note(execution, HIGH)
    for _ in range(2):
        execution.on_state(shown(ballot=HIGH, go=True))
    for _ in range(2):
        execution.on_body(displaced=True)
    rules = [f"{book.table[row].rule} row {row}" for row in book.taken]
    assert rules == [
        "V7 row 9", "V2 row 0", "V2 row 1", "V3 row 2", "V3 row 3", "V4 row 5", "V5 row 6",
        "V6 row 7", "V7 row 8", "V2 row 0", "V3 row 2", "V3 row 3", "V4 row 4", "V4 row 5",
        "V8 row 10",
    ]  # fmt: skip
    assert {*book.taken} == {*range(len(VEHICLE_RULES.table))}
