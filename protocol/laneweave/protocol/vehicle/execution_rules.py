"""Rules V2 to V8 of plan execution: guards, actions, and the table that combines them.

The first lines of the docstrings of guards and actions are shown in docs/PROTOCOL.md, whose table
is generated from `VEHICLE_RULES`. docs/SAFETY.md has the proof.
"""

from __future__ import annotations

from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.vehicle.plan_execution import (
    BODY,
    GATE,
    PLAN,
    PREPARE,
    REST,
    STATE,
    STORED,
    TICK,
    ExecutionPhase,
    PlanExecution,
)
from laneweave.protocol.vehicle.plans import dependencies, followers, plan_problems
from laneweave.protocol.wire.messages import (
    PendingTransfer,
    Plan,
    Prepare,
    VehicleRecord,
    VehicleState,
)


def is_in_roster(execution: PlanExecution, prepare: Prepare) -> bool:
    """The vehicle is in the roster, and in one of the formations."""
    return execution.vehicle in prepare.roster and execution.territory.is_addressed(
        execution.stored, prepare
    )


def is_above_promise(execution: PlanExecution, prepare: Prepare) -> bool:
    """The ballot is above the promised one, if any."""
    return execution.promised is None or prepare.ballot > execution.promised


def promise(execution: PlanExecution, prepare: Prepare) -> None:
    """Promise the ballot; request storage of its blocks as joined."""
    execution.promised, execution.promise_stored = prepare.ballot, False
    execution.wanted_joined = execution.territory.joined_by(execution.wanted_joined, prepare)


def drop_plan(execution: PlanExecution, _: object) -> None:
    """Drop the plan: k = 0; a motion in progress continues, but belongs to no plan."""
    execution.plan = None
    execution.completed = 0
    execution.needs = execution.followers = ()
    execution.moving_in_plan = False


def forget_progress(execution: PlanExecution, _: object) -> None:
    """Clear the progress of the other members."""
    execution.progress = {}


def publish_state(execution: PlanExecution, _: object) -> None:
    """Publish the state."""
    # Left to the caller: `on_prepare` and `on_record` return whether the state must be published.


def is_promised_ballot(execution: PlanExecution, plan: Plan) -> bool:
    """The ballot of the plan is the promised one."""
    return plan.ballot == execution.promised


def names_own_incarnation(execution: PlanExecution, plan: Plan) -> bool:
    """The plan names the incarnation of this process."""
    return plan.incarnations.get(execution.vehicle) == execution.incarnation


def starts_in_hold_cell(execution: PlanExecution, plan: Plan) -> bool:
    """The start cell is the hold cell."""
    return plan.start_cells.get(execution.vehicle) == execution.hold_cell


def is_executable(_: PlanExecution, plan: Plan) -> bool:
    """The plan can be executed safely (`plan_problems`)."""
    return not plan_problems(plan)


def drives_its_moves(execution: PlanExecution, plan: Plan) -> bool:
    """The vehicle's type drives its moves."""
    return execution.drivable is None or all(
        (target[0] - origin[0], target[1] - origin[1]) in execution.drivable
        for _, origin, target in plan.moves[execution.vehicle]
    )


def stays_in_its_blocks(execution: PlanExecution, plan: Plan) -> bool:
    """The territory lies in the blocks of the plan."""
    return execution.territory.contains(plan)


def has_joined(execution: PlanExecution, plan: Plan) -> bool:
    """The blocks of the plan are exactly those that the controller has stored as joined."""
    return execution.territory.is_joined(execution.stored, plan)


def transfers_only_owned_cells(execution: PlanExecution, plan: Plan) -> bool:
    """The cell transfers are valid, and the vehicle owns the cells attributed to it."""
    return execution.territory.may_transfer(execution.stored, plan, execution.vehicle)


def take_plan(execution: PlanExecution, plan: Plan) -> None:
    """Take the plan; derive its dependencies; request storage of the acceptance."""
    execution.plan = plan
    execution.needs = dependencies(plan, execution.vehicle)
    execution.followers = followers(plan, execution.vehicle)
    execution.transfer = execution.territory.transfer_in(plan, execution.vehicle)


def is_stored(execution: PlanExecution, record: VehicleRecord) -> bool:
    """The controller has stored the acceptance for this process."""
    return execution.plan is not None and record.accepted == execution.plan.ballot


def is_of_same_plan(execution: PlanExecution, state: VehicleState) -> bool:
    """A is another member and reports that it has accepted the same plan."""
    plan = execution.plan
    return (
        plan is not None
        and state.record.accepted == plan.ballot
        and state.vehicle in plan.moves
        and state.vehicle != execution.vehicle
    )


def reports_open_gate(_: PlanExecution, state: VehicleState) -> bool:
    """A reports an open gate."""
    return state.go


def record_progress(execution: PlanExecution, state: VehicleState) -> None:
    """progress[A] = max(progress[A], k if A is ready, else -1)."""
    reported = state.completed if state.ready else -1
    execution.progress[state.vehicle] = max(execution.progress.get(state.vehicle, -1), reported)


def is_holding(execution: PlanExecution, _: object) -> bool:
    """The vehicle holds its cell."""
    return not execution.moving


def all_are_ready(execution: PlanExecution, _: object) -> bool:
    """progress[A] >= 0 for every other member."""
    return execution.plan is not None and all(
        execution.progress.get(other, -1) >= 0
        for other in execution.plan.roster
        if other != execution.vehicle
    )


def open_transfer(execution: PlanExecution, _: object) -> None:
    """Open the transfer: the vehicle owns the cells `after`."""
    if execution.transfer is not None:
        execution.transfer = PendingTransfer(execution.transfer.ballot, open=True)


def has_next_move(execution: PlanExecution, _: object) -> bool:
    """There is a next move."""
    return execution.next_move is not None


def move_is_due(execution: PlanExecution, _: object) -> bool:
    """Road time >= t0 + step * slot."""
    return execution.is_due(execution.t_s)


def ends_in_time(execution: PlanExecution, _: object) -> bool:
    """The move, begun as soon as possible, ends before the stop and exit lines of both lanes."""
    return not execution.too_late


def both_lanes_are_open(execution: PlanExecution, _: object) -> bool:
    """The cell is where moves may begin in both lanes."""
    # A move may be planned for later in its slot.
    move, ends = execution.next_move, execution.lane_ends
    return move is None or ends is None or ends.may_begin(*move[1:], execution.t_s)


def is_released(execution: PlanExecution, _: object) -> bool:
    """progress[A] >= needs[A] for all dependencies of the move."""
    return execution.released


def start_move(execution: PlanExecution, _: object) -> None:
    """Begin the move: the target becomes the hold cell."""
    move = execution.next_move
    if move is not None:
        execution.hold_cell = move[2]
        execution.moving = execution.moving_in_plan = True


def leave_cell(execution: PlanExecution, _: object) -> None:
    """Move back to the cell; this motion belongs to no plan."""
    execution.moving, execution.moving_in_plan = True, False


def is_moving(execution: PlanExecution, _: object) -> bool:
    """The vehicle was moving."""
    return execution.moving


def moved_in_plan(execution: PlanExecution, _: object) -> bool:
    """The motion was a move of the plan."""
    return execution.moving_in_plan


def count_move(execution: PlanExecution, _: object) -> None:
    """Count the move: k += 1."""
    execution.completed += 1


def rest(execution: PlanExecution, _: object) -> None:
    """Hold the target."""
    execution.moving = execution.moving_in_plan = False


_ANY = tuple(ExecutionPhase)
_, _PROMISED, _TAKEN, _GATED, _GOING = _ANY

VEHICLE_RULES: RuleBook = RuleBook(
    (
        Transition(
            "V2",
            PREPARE,
            _ANY,
            (is_in_roster, is_above_promise),
            (promise, drop_plan, forget_progress, publish_state),
            _PROMISED,
        ),
        Transition("V2", PREPARE, _ANY, (is_in_roster,), (publish_state,)),
        Transition(
            "V3",
            PLAN,
            (_PROMISED,),
            (
                is_promised_ballot,
                names_own_incarnation,
                starts_in_hold_cell,
                is_executable,
                drives_its_moves,
                stays_in_its_blocks,
                has_joined,
                transfers_only_owned_cells,
            ),
            (take_plan,),
            _TAKEN,
        ),
        Transition("V3", STORED, (_TAKEN,), (is_stored,), (publish_state,), _GATED),
        Transition(
            "V4",
            STATE,
            (_GATED,),
            (is_of_same_plan, reports_open_gate),
            (record_progress, open_transfer),
            _GOING,
        ),
        Transition("V4", STATE, (_TAKEN, _GATED, _GOING), (is_of_same_plan,), (record_progress,)),
        Transition("V5", GATE, (_GATED,), (is_holding, all_are_ready), (open_transfer,), _GOING),
        Transition(
            "V6",
            TICK,
            (_GOING,),
            (
                is_holding,
                has_next_move,
                move_is_due,
                both_lanes_are_open,
                ends_in_time,
                is_released,
            ),
            (start_move,),
        ),
        Transition("V7", REST, _ANY, (is_moving, moved_in_plan), (count_move, rest)),
        Transition("V7", REST, _ANY, (is_moving,), (rest,)),
        Transition("V8", BODY, _ANY, (is_holding,), (leave_cell,)),
    )
)
"""Rules V2 to V8."""
