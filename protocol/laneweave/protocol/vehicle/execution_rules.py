"""The rules of a vehicle (V2 to V7): one table, and the names it is made of.

`PlanExecution` runs by it; the first line of each function here is its meaning in docs/PROTOCOL.md.
V1 is the construction of a `PlanExecution`.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from laneweave.protocol.state_machine import RuleBook, Transition, named
from laneweave.protocol.vehicle.plans import dependencies, estate_problems, plan_problems
from laneweave.protocol.wire.messages import Ballot, Deed, Plan, Prepare, VehicleState

if TYPE_CHECKING:
    from laneweave.protocol.vehicle.execution import PlanExecution


class Stage(Enum):
    """What a vehicle has of the newest ballot."""

    FREE = "free"
    """Nothing promised, no plan."""
    PROMISED = "promised"
    TAKEN = "taken"
    """It has the plan, and waits for its motion controller to note that."""
    GATED = "gated"
    """It has accepted the plan and waits at the start gate."""
    GOING = "going"
    """The start gate is open."""


ACCEPTED = (Stage.GATED, Stage.GOING)
"""Phases in which a plan is accepted."""

PREPARE, PLAN, NOTED, STATE = "PREPARE", "PLAN", "SENSE", "STATE"
GATE, TICK, REST = "tick (gate)", "tick (move)", "motion ends"


# --- guards and actions ---------------------------------------------------------------------------


def _is_in_roster(me: PlanExecution, prepare: Prepare) -> bool:
    """I am in the roster."""
    return me.vehicle in prepare.roster


def _is_above_promise(me: PlanExecution, prepare: Prepare) -> bool:
    """The ballot is above the one that I promised, if any."""
    return me.promised is None or prepare.ballot > me.promised


def _promise(me: PlanExecution, prepare: Prepare) -> None:
    """Promise the ballot, ask the controller to join its formations."""
    me.promised, me.shown = prepare.ballot, False
    if me.estate is None:
        me.wanted_joined = tuple(sorted({*me.wanted_joined, *prepare.formations}))


def _drop_plan(me: PlanExecution, _: object) -> None:
    """Drop the plan: k = 0, nothing heard; the motion under way ends and belongs to no plan."""
    me.plan = None
    me.completed = 0
    me.needs = ()
    me.moving_in_plan = False


def _forget_heard(me: PlanExecution, _: object) -> None:
    """Forget what others have shown."""
    me.heard = {}


def _show(me: PlanExecution, _: object) -> None:
    """Show my state."""


def _is_promised_ballot(me: PlanExecution, plan: Plan) -> bool:
    """Its ballot is the one that I promised."""
    return plan.ballot == me.promised


def _names_my_incarnation(me: PlanExecution, plan: Plan) -> bool:
    """It names my incarnation."""
    return plan.incarnations.get(me.vehicle) == me.incarnation


def _starts_in_my_cell(me: PlanExecution, plan: Plan) -> bool:
    """I start in my hold cell."""
    return plan.start_cells.get(me.vehicle) == me.hold_cell


def _is_executable(_: PlanExecution, plan: Plan) -> bool:
    """It can be executed safely (`plan_problems`)."""
    return not plan_problems(plan)


def _keeps_to_its_blocks(me: PlanExecution, plan: Plan) -> bool:
    """Its territory lies in the blocks of its formations."""
    if me.estate is not None:
        return True
    blocks = set(plan.formations)
    return all(
        me.lattice.block_of(column) in blocks and 0 <= lane < me.lattice.lanes
        for column, lane in plan.territory
    )


def _has_joined(me: PlanExecution, plan: Plan) -> bool:
    """My controller has confirmed its formations as joined with mine, these and no others."""
    return me.estate is not None or set(plan.formations) == set(me.joined)


def _keeps_to_its_estates(me: PlanExecution, plan: Plan) -> bool:
    """Its cells change hands among their owners, and none is taken for mine that is not."""
    if me.estate is None:
        return True
    mine = me.estate | set(me.noted.after if me.noted is not None else ())
    return not estate_problems(plan) and set(plan.before[me.vehicle]) <= mine


def _accept(me: PlanExecution, plan: Plan) -> None:
    """Take the plan, derive what its moves need, ask the controller to note it."""
    me.plan = plan
    me.needs = me.rules.functions["dependencies"](plan, me.vehicle)
    if me.estate is not None:
        name = me.vehicle
        me.deed = Deed(plan.ballot, plan.before[name], plan.after[name], plan.roster)


def _is_noted(me: PlanExecution, ballot: Ballot | None) -> bool:
    """My controller has noted for me that I accept it."""
    return me.plan is not None and ballot == me.plan.ballot


def _is_of_my_plan(me: PlanExecution, state: VehicleState) -> bool:
    """A is another member and shows my plan's ballot as accepted."""
    plan = me.plan
    return (
        plan is not None
        and state.accepted
        and state.promised == plan.ballot
        and state.vehicle in plan.moves
        and state.vehicle != me.vehicle
    )


def _shows_open_gate(_: PlanExecution, state: VehicleState) -> bool:
    """A has go."""
    return state.go


def _hear(me: PlanExecution, state: VehicleState) -> None:
    """heard[A] = max(heard[A], k if A is ready, else -1)."""
    shown = state.completed if state.ready else -1
    me.heard[state.vehicle] = max(me.heard.get(state.vehicle, -1), shown)


def _is_ready(me: PlanExecution, _: object) -> bool:
    """Accepted, and not moving or moving in a move of this plan."""
    return me.phase in ACCEPTED and (not me.moving or me.moving_in_plan)


def _is_holding(me: PlanExecution, _: object) -> bool:
    """I hold my cell."""
    return not me.moving


def _all_are_ready(me: PlanExecution, _: object) -> bool:
    """heard[A] >= 0 for every other member."""
    return me.plan is not None and all(
        me.heard.get(other, -1) >= 0 for other in me.plan.roster if other != me.vehicle
    )


def _take_possession(me: PlanExecution, _: object) -> None:
    """Own what the plan gives me, and no more what it takes."""
    if me.deed is not None:
        me.deed = Deed(me.deed.ballot, open=True)


def _has_next_move(me: PlanExecution, _: object) -> bool:
    """There is a next move."""
    return me.next_move is not None


def _is_time(me: PlanExecution, _: object) -> bool:
    """My clock >= t0 + step * slot."""
    return me.is_due(me.t_s)


def _is_released(me: PlanExecution, _: object) -> bool:
    """heard[A] >= need(A) for all dependencies of the move."""
    heard = me.heard
    for other, count in me.needs[me.completed].items():  # noqa: SIM110 (asked at each tick)
        if heard.get(other, -1) < count:
            return False
    return True


def _start_move(me: PlanExecution, _: object) -> None:
    """Move: from now on I count as being at the target."""
    move = me.next_move
    if move is not None:
        me.hold_cell = move[2]
        me.moving = me.moving_in_plan = True


def _is_moving(me: PlanExecution, _: object) -> bool:
    """I was moving."""
    return me.moving


def _moved_in_plan(me: PlanExecution, _: object) -> bool:
    """The motion was a move of my plan."""
    return me.moving_in_plan


def _count_move(me: PlanExecution, _: object) -> None:
    """Count it: k += 1."""
    me.completed += 1


def _rest(me: PlanExecution, _: object) -> None:
    """Hold the target."""
    me.moving = me.moving_in_plan = False


_ANY = tuple(Stage)
_WITH_PLAN = (Stage.TAKEN, Stage.GATED, Stage.GOING)

VEHICLE_RULES: RuleBook = RuleBook(
    (
        Transition(
            "V2",
            PREPARE,
            _ANY,
            ("is_in_roster", "is_above_promise"),
            ("promise", "drop_plan", "forget_heard", "show"),
            Stage.PROMISED,
        ),
        Transition("V2", PREPARE, _ANY, ("is_in_roster",), ("show",)),
        Transition(
            "V3",
            PLAN,
            (Stage.PROMISED,),
            (
                "is_promised_ballot",
                "names_my_incarnation",
                "starts_in_my_cell",
                "is_executable",
                "keeps_to_its_blocks",
                "has_joined",
                "keeps_to_its_estates",
            ),
            ("accept",),
            Stage.TAKEN,
        ),
        Transition("V3", NOTED, (Stage.TAKEN,), ("is_noted",), ("show",), Stage.GATED),
        Transition(
            "V4",
            STATE,
            (Stage.GATED,),
            ("is_of_my_plan", "shows_open_gate"),
            ("hear", "take_possession"),
            Stage.GOING,
        ),
        Transition("V4", STATE, _WITH_PLAN, ("is_of_my_plan",), ("hear",)),
        Transition(
            "V5",
            GATE,
            (Stage.GATED,),
            ("is_holding", "all_are_ready"),
            ("take_possession",),
            Stage.GOING,
        ),
        Transition(
            "V6",
            TICK,
            (Stage.GOING,),
            ("is_holding", "has_next_move", "is_time", "is_released"),
            ("start_move",),
        ),
        Transition("V7", REST, _ANY, ("is_moving", "moved_in_plan"), ("count_move", "rest")),
        Transition("V7", REST, _ANY, ("is_moving",), ("rest",)),
    ),
    named(
        _is_in_roster,
        _is_above_promise,
        _promise,
        _drop_plan,
        _forget_heard,
        _show,
        _is_promised_ballot,
        _names_my_incarnation,
        _starts_in_my_cell,
        _is_executable,
        _keeps_to_its_blocks,
        _has_joined,
        _keeps_to_its_estates,
        _accept,
        _is_noted,
        _is_of_my_plan,
        _shows_open_gate,
        _hear,
        _is_ready,
        _is_holding,
        _all_are_ready,
        _take_possession,
        _has_next_move,
        _is_time,
        _is_released,
        _start_move,
        _is_moving,
        _moved_in_plan,
        _count_move,
        _rest,
        dependencies,
    ),
)
"""Rules V2 to V7."""
