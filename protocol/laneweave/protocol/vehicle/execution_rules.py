"""The rules of a vehicle (V2 to V7): its state, the guards and actions, and their table.

`PlanExecution` runs by the table; the first line of each guard and action is its meaning in
docs/PROTOCOL.md. V1 is the construction of a `PlanExecution`.
"""

from __future__ import annotations

from enum import Enum

from attrs import define, field

from laneweave.protocol.lattice import Cell, Lattice, PlannedMove
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.vehicle.plans import Needs, dependencies, ownership_problems, plan_problems
from laneweave.protocol.wire.messages import Ballot, Deed, Name, Plan, Prepare, VehicleState

TIME_TOLERANCE_S = 1e-6


class ExecutionPhase(Enum):
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


ACCEPTED = (ExecutionPhase.GATED, ExecutionPhase.GOING)
"""Phases in which a plan is accepted."""

PREPARE, PLAN, NOTED, STATE = "PREPARE", "PLAN", "SENSE", "STATE"
GATE, TICK, REST = "tick (gate)", "tick (move)", "motion ends"


@define
class ExecutionState:
    """What one vehicle remembers of the protocol (V1: nothing promised, no plan).

    `hold_cell`, `moving`, `joined`, `owned` and `noted_transfer` mirror the motion controller,
    which outlives this object.
    """

    vehicle: Name
    incarnation: int
    hold_cell: Cell
    lattice: Lattice
    joined: tuple[int, ...]
    """Blocks that plans may use, as the motion controller has confirmed; ascending."""
    moving: bool = False
    phase: ExecutionPhase = ExecutionPhase.FREE
    promised: Ballot | None = None
    plan: Plan | None = None
    completed: int = 0
    heard: dict[Name, int] = field(factory=dict)
    """Completed moves of my plan that each other member has shown; -1: not ready yet."""
    wanted_joined: tuple[int, ...] = field(init=False)
    """Blocks that the motion controller should note."""
    moving_in_plan: bool = False
    """The motion under way is a move of the accepted plan."""
    needs: tuple[Needs, ...] = ()
    """For each of my moves what it needs of the others."""
    t_s: float = 0.0
    """Road time of the tick."""
    promise_noted: bool = False
    """The motion controller has noted the promise, so it counts."""
    owned: frozenset[Cell] | None = None
    """Cells that the vehicle owns, from its controller; None: formations own blocks."""
    transfer: Deed | None = None
    """Pending transfer of the newest plan that was taken."""
    noted_transfer: Deed | None = None
    """The newest pending transfer that the controller has noted."""

    def __attrs_post_init__(self) -> None:
        """Ask for no more blocks than the controller has."""
        self.wanted_joined = self.joined

    @property
    def next_move(self) -> PlannedMove | None:
        """The first move of the plan that is not completed."""
        if self.plan is None or self.completed >= len(self.plan.moves[self.vehicle]):
            return None
        return self.plan.moves[self.vehicle][self.completed]

    @property
    def accepted(self) -> bool:
        """It has a plan, and its motion controller has noted that."""
        return self.phase in ACCEPTED

    def is_due(self, t_s: float) -> bool:
        """Return whether the time of the next move has come."""
        plan = self.plan
        if plan is None:
            return False
        moves, completed = plan.moves[self.vehicle], self.completed
        if completed >= len(moves):
            return False
        return t_s + TIME_TOLERANCE_S >= plan.t0_s + moves[completed][0] * plan.slot_s


# --- guards and actions ---------------------------------------------------------------------------


def is_in_roster(me: ExecutionState, prepare: Prepare) -> bool:
    """I am in the roster."""
    return me.vehicle in prepare.roster


def is_above_promise(me: ExecutionState, prepare: Prepare) -> bool:
    """The ballot is above the one that I promised, if any."""
    return me.promised is None or prepare.ballot > me.promised


def promise(me: ExecutionState, prepare: Prepare) -> None:
    """Promise the ballot, ask the controller to note its blocks as joined."""
    me.promised, me.promise_noted = prepare.ballot, False
    if me.owned is None:
        me.wanted_joined = tuple(sorted({*me.wanted_joined, *prepare.formations}))


def drop_plan(me: ExecutionState, _: object) -> None:
    """Drop the plan: k = 0, nothing heard; the motion under way ends and belongs to no plan."""
    me.plan = None
    me.completed = 0
    me.needs = ()
    me.moving_in_plan = False


def forget_heard(me: ExecutionState, _: object) -> None:
    """Forget what others have shown."""
    me.heard = {}


def show(me: ExecutionState, _: object) -> None:
    """Show my state."""


def is_promised_ballot(me: ExecutionState, plan: Plan) -> bool:
    """Its ballot is the one that I promised."""
    return plan.ballot == me.promised


def names_my_incarnation(me: ExecutionState, plan: Plan) -> bool:
    """It names my incarnation."""
    return plan.incarnations.get(me.vehicle) == me.incarnation


def starts_in_my_cell(me: ExecutionState, plan: Plan) -> bool:
    """I start in my hold cell."""
    return plan.start_cells.get(me.vehicle) == me.hold_cell


def is_executable(_: ExecutionState, plan: Plan) -> bool:
    """It can be executed safely (`plan_problems`)."""
    return not plan_problems(plan)


def keeps_to_its_blocks(me: ExecutionState, plan: Plan) -> bool:
    """Its territory lies in the blocks of its formations."""
    if me.owned is not None:
        return True
    blocks = set(plan.formations)
    return all(
        me.lattice.block_of(column) in blocks and 0 <= lane < me.lattice.lanes
        for column, lane in plan.territory
    )


def has_joined(me: ExecutionState, plan: Plan) -> bool:
    """Its blocks are exactly those that my controller has noted as joined."""
    return me.owned is not None or set(plan.formations) == set(me.joined)


def transfers_only_owned_cells(me: ExecutionState, plan: Plan) -> bool:
    """It transfers cells among their owners only, and counts no cell as mine that I do not own."""
    if me.owned is None:
        return True
    mine = me.owned | set(me.noted_transfer.after if me.noted_transfer is not None else ())
    return not ownership_problems(plan) and set(plan.before[me.vehicle]) <= mine


def accept(me: ExecutionState, plan: Plan) -> None:
    """Take the plan, derive what its moves need, ask the controller to note it."""
    me.plan = plan
    me.needs = dependencies(plan, me.vehicle)
    if me.owned is not None:
        name = me.vehicle
        me.transfer = Deed(plan.ballot, plan.before[name], plan.after[name], plan.roster)


def is_noted(me: ExecutionState, ballot: Ballot | None) -> bool:
    """My controller has noted for me that I accept it."""
    return me.plan is not None and ballot == me.plan.ballot


def is_of_my_plan(me: ExecutionState, state: VehicleState) -> bool:
    """A is another member and shows my plan's ballot as accepted."""
    plan = me.plan
    return (
        plan is not None
        and state.accepted
        and state.promised == plan.ballot
        and state.vehicle in plan.moves
        and state.vehicle != me.vehicle
    )


def shows_open_gate(_: ExecutionState, state: VehicleState) -> bool:
    """A has go."""
    return state.go


def hear(me: ExecutionState, state: VehicleState) -> None:
    """heard[A] = max(heard[A], k if A is ready, else -1)."""
    shown = state.completed if state.ready else -1
    me.heard[state.vehicle] = max(me.heard.get(state.vehicle, -1), shown)


def is_holding(me: ExecutionState, _: object) -> bool:
    """I hold my cell."""
    return not me.moving


def all_are_ready(me: ExecutionState, _: object) -> bool:
    """heard[A] >= 0 for every other member."""
    return me.plan is not None and all(
        me.heard.get(other, -1) >= 0 for other in me.plan.roster if other != me.vehicle
    )


def take_ownership(me: ExecutionState, _: object) -> None:
    """Own the cells of `after`: the transfer is open."""
    if me.transfer is not None:
        me.transfer = Deed(me.transfer.ballot, open=True)


def has_next_move(me: ExecutionState, _: object) -> bool:
    """There is a next move."""
    return me.next_move is not None


def is_time(me: ExecutionState, _: object) -> bool:
    """My clock >= t0 + step * slot."""
    return me.is_due(me.t_s)


def is_released(me: ExecutionState, _: object) -> bool:
    """heard[A] >= need(A) for all dependencies of the move."""
    heard = me.heard
    for other, count in me.needs[me.completed].items():  # noqa: SIM110 (asked at each tick)
        if heard.get(other, -1) < count:
            return False
    return True


def start_move(me: ExecutionState, _: object) -> None:
    """Move: from now on I count as being at the target."""
    move = me.next_move
    if move is not None:
        me.hold_cell = move[2]
        me.moving = me.moving_in_plan = True


def is_moving(me: ExecutionState, _: object) -> bool:
    """I was moving."""
    return me.moving


def moved_in_plan(me: ExecutionState, _: object) -> bool:
    """The motion was a move of my plan."""
    return me.moving_in_plan


def count_move(me: ExecutionState, _: object) -> None:
    """Count it: k += 1."""
    me.completed += 1


def rest(me: ExecutionState, _: object) -> None:
    """Hold the target."""
    me.moving = me.moving_in_plan = False


_ANY = tuple(ExecutionPhase)
_WITH_PLAN = (ExecutionPhase.TAKEN, ExecutionPhase.GATED, ExecutionPhase.GOING)

VEHICLE_RULES = RuleBook(
    (
        Transition(
            "V2",
            PREPARE,
            _ANY,
            (is_in_roster, is_above_promise),
            (promise, drop_plan, forget_heard, show),
            ExecutionPhase.PROMISED,
        ),
        Transition("V2", PREPARE, _ANY, (is_in_roster,), (show,)),
        Transition(
            "V3",
            PLAN,
            (ExecutionPhase.PROMISED,),
            (
                is_promised_ballot,
                names_my_incarnation,
                starts_in_my_cell,
                is_executable,
                keeps_to_its_blocks,
                has_joined,
                transfers_only_owned_cells,
            ),
            (accept,),
            ExecutionPhase.TAKEN,
        ),
        Transition(
            "V3", NOTED, (ExecutionPhase.TAKEN,), (is_noted,), (show,), ExecutionPhase.GATED
        ),
        Transition(
            "V4",
            STATE,
            (ExecutionPhase.GATED,),
            (is_of_my_plan, shows_open_gate),
            (hear, take_ownership),
            ExecutionPhase.GOING,
        ),
        Transition("V4", STATE, _WITH_PLAN, (is_of_my_plan,), (hear,)),
        Transition(
            "V5",
            GATE,
            (ExecutionPhase.GATED,),
            (is_holding, all_are_ready),
            (take_ownership,),
            ExecutionPhase.GOING,
        ),
        Transition(
            "V6",
            TICK,
            (ExecutionPhase.GOING,),
            (is_holding, has_next_move, is_time, is_released),
            (start_move,),
        ),
        Transition("V7", REST, _ANY, (is_moving, moved_in_plan), (count_move, rest)),
        Transition("V7", REST, _ANY, (is_moving,), (rest,)),
    )
)
"""Rules V2 to V7."""
