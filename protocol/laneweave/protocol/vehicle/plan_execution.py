"""Plan execution: the vehicle's side of the execution protocol, rules V1 to V7.

The vehicle holds its cell unless everything that its next move needs is *known*: it has promised
and accepted a plan, every member of the roster has shown that it accepted the same plan (start
gate), and every vehicle whose earlier move interferes has shown that it completed it. Time only
paces; silence always means hold. `VEHICLE_RULES` is the table; the first line of each guard and
action is its meaning in docs/PROTOCOL.md, and docs/SAFETY.md has the argument.

The process in charge of a vehicle runs this machine: its agent, or its caretaker, which never
moves it.
"""

from __future__ import annotations

from enum import Enum

from attrs import define, field

from laneweave.protocol.lattice import Cell, Lattice, PlannedMove
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.vehicle.plans import Needs, dependencies, ownership_problems, plan_problems
from laneweave.protocol.wire.messages import (
    Ballot,
    Deed,
    Name,
    Plan,
    Prepare,
    Sense,
    VehicleState,
)

LISTEN_S = 1.0
"""A vehicle receives the states of its predecessors from this time before a move is due."""
OVERDUE_SLOTS = 1.5
OVERDUE_S = 2.0
"""A move is overdue when it has been due for 1.5 slots, or for a slot and 2 s if that is less."""
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
class PlanExecution:
    """The machine of one vehicle: takes messages and ticks, returns what to do and to publish.

    Constructing it is V1: nothing promised, no plan.

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
    rules: RuleBook = field(factory=lambda: VEHICLE_RULES)

    def __attrs_post_init__(self) -> None:
        """Ask for no more blocks than the controller has."""
        self.wanted_joined = self.joined

    def on_prepare(self, prepare: Prepare) -> bool:
        """V2: promise a ballot; return whether the state should be published at once."""
        return self.rules.take(self, PREPARE, prepare) is not None

    def on_plan(self, plan: Plan) -> bool:
        """V3: take the plan of the promised ballot, once; return whether it was taken now.

        A plan that cannot be executed safely is never taken. A taken plan is accepted, and shown
        as accepted, when the motion controller has noted it for this process (`on_noted`).
        """
        return self.rules.take(self, PLAN, plan) is not None

    def on_noted(self, ballot: Ballot | None) -> bool:
        """V3: the controller has noted a plan; return whether it is newly accepted now."""
        return self.rules.take(self, NOTED, ballot) is not None

    def on_joined(self, formations: tuple[int, ...]) -> bool:
        """Add the blocks that the controller has noted as joined; return whether any is new.

        The report may be older than what is known already: joined blocks never part.
        """
        if formations == self.joined or set(formations) <= set(self.joined):
            return False
        self.joined = tuple(sorted({*self.joined, *formations}))
        self.wanted_joined = tuple(sorted({*self.joined, *self.wanted_joined}))
        return True

    def on_owned(self, sense: Sense) -> bool:
        """Take what the controller notes as owned; return whether it newly notes a promise.

        A promise of an earlier process binds this one: it is treated like a PREPARE. Without effect
        where formations own blocks.
        """
        if self.owned is None:
            return False
        if sense.promised is not None and sense.promised != self.promised:
            self.on_prepare(Prepare(sense.promised, (), (self.vehicle,)))
        before = self.promise_noted
        self.owned, self.noted_transfer = frozenset(sense.estate), sense.deed
        self.promise_noted = sense.promised == self.promised
        return self.promise_noted and not before

    def on_state(self, state: VehicleState) -> None:
        """V4: remember what another member of the same plan has shown."""
        self.rules.take(self, STATE, state)

    def tick(self, t_s: float) -> PlannedMove | None:
        """V5 and V6: open the gate when it may, and return the move that starts now, if any."""
        self.t_s = t_s
        self.rules.take(self, GATE, None)
        if self.rules.take(self, TICK, None) is None:
            return None
        return self.next_move

    def end_motion(self) -> None:
        """V7: the motion has ended; the controller holds again."""
        self.rules.take(self, REST, None)

    @property
    def wanted_accepted(self) -> Ballot | None:
        """The plan that the motion controller should note as accepted."""
        return self.plan.ballot if self.plan is not None else None

    @property
    def wanted_promised(self) -> Ballot | None:
        """The promise that the motion controller should note, where it must."""
        return self.promised if self.owned is not None else None

    @property
    def go(self) -> bool:
        """The start gate is open."""
        return self.phase is ExecutionPhase.GOING

    @property
    def done(self) -> bool:
        """All moves of the accepted plan are completed."""
        return self.accepted and self.next_move is None

    @property
    def ready(self) -> bool:
        """Accepted, and not moving or moving in a move of this plan."""
        return self.accepted and (not self.moving or self.moving_in_plan)

    def overdue(self, t_s: float) -> bool:
        """Return whether the next move has been due for too long."""
        plan = self.plan
        if plan is None or self.moving or not self.accepted:
            return False
        return self.is_due(t_s - min(OVERDUE_SLOTS * plan.slot_s, plan.slot_s + OVERDUE_S))

    def state(self, sense: Sense, formation: int, *, attended: bool) -> VehicleState:
        """Return the state to publish.

        Args:
            sense: what the vehicle sensed last.
            formation: block in which it entered.
            attended: whether an agent drives it.
        """
        return VehicleState(
            vehicle=self.vehicle,
            incarnation=self.incarnation,
            formation=formation,
            joined=self.joined,
            promised=self.promised,
            accepted=self.accepted,
            ready=self.ready,
            completed=self.completed,
            hold_cell=self.hold_cell,
            moving=self.moving,
            go=self.go,
            done=self.done,
            overdue=self.overdue(sense.t_s),
            attended=attended,
            s_m=sense.state[0],
            y_m=sense.state[3],
            speed_mps=sense.state[1],
            t_s=sense.t_s,
            estate=sense.estate if sense.promised == self.promised else (),
            deed=sense.deed,
        )

    def needs_states(self, t_s: float) -> bool:
        """Return whether the states of other vehicles matter now.

        They do until the gate is open, and from `LISTEN_S` before the next move is due until that
        is released. States missed in between do no harm: they are published again.
        """
        plan = self.plan
        if plan is None:
            return False
        if self.phase is not ExecutionPhase.GOING:
            return True
        if self.next_move is None or not self.is_due(t_s + LISTEN_S):
            return False
        needs = self.needs[self.completed]
        return any(self.heard.get(other, -1) < count for other, count in needs.items())

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


def is_in_roster(me: PlanExecution, prepare: Prepare) -> bool:
    """I am in the roster."""
    return me.vehicle in prepare.roster


def is_above_promise(me: PlanExecution, prepare: Prepare) -> bool:
    """The ballot is above the one that I promised, if any."""
    return me.promised is None or prepare.ballot > me.promised


def promise(me: PlanExecution, prepare: Prepare) -> None:
    """Promise the ballot, ask the controller to note its blocks as joined."""
    me.promised, me.promise_noted = prepare.ballot, False
    if me.owned is None:
        me.wanted_joined = tuple(sorted({*me.wanted_joined, *prepare.formations}))


def drop_plan(me: PlanExecution, _: object) -> None:
    """Drop the plan: k = 0, nothing heard; the motion under way ends and belongs to no plan."""
    me.plan = None
    me.completed = 0
    me.needs = ()
    me.moving_in_plan = False


def forget_heard(me: PlanExecution, _: object) -> None:
    """Forget what others have shown."""
    me.heard = {}


def show(me: PlanExecution, _: object) -> None:
    """Show my state."""


def is_promised_ballot(me: PlanExecution, plan: Plan) -> bool:
    """Its ballot is the one that I promised."""
    return plan.ballot == me.promised


def names_my_incarnation(me: PlanExecution, plan: Plan) -> bool:
    """It names my incarnation."""
    return plan.incarnations.get(me.vehicle) == me.incarnation


def starts_in_my_cell(me: PlanExecution, plan: Plan) -> bool:
    """I start in my hold cell."""
    return plan.start_cells.get(me.vehicle) == me.hold_cell


def is_executable(_: PlanExecution, plan: Plan) -> bool:
    """It can be executed safely (`plan_problems`)."""
    return not plan_problems(plan)


def keeps_to_its_blocks(me: PlanExecution, plan: Plan) -> bool:
    """Its territory lies in the blocks of its formations."""
    if me.owned is not None:
        return True
    blocks = set(plan.formations)
    return all(
        me.lattice.block_of(column) in blocks and 0 <= lane < me.lattice.lanes
        for column, lane in plan.territory
    )


def has_joined(me: PlanExecution, plan: Plan) -> bool:
    """Its blocks are exactly those that my controller has noted as joined."""
    return me.owned is not None or set(plan.formations) == set(me.joined)


def transfers_only_owned_cells(me: PlanExecution, plan: Plan) -> bool:
    """It transfers cells among their owners only, and counts no cell as mine that I do not own."""
    if me.owned is None:
        return True
    mine = me.owned | set(me.noted_transfer.after if me.noted_transfer is not None else ())
    return not ownership_problems(plan) and set(plan.before[me.vehicle]) <= mine


def accept(me: PlanExecution, plan: Plan) -> None:
    """Take the plan, derive what its moves need, ask the controller to note it."""
    me.plan = plan
    me.needs = dependencies(plan, me.vehicle)
    if me.owned is not None:
        name = me.vehicle
        me.transfer = Deed(plan.ballot, plan.before[name], plan.after[name], plan.roster)


def is_noted(me: PlanExecution, ballot: Ballot | None) -> bool:
    """My controller has noted for me that I accept it."""
    return me.plan is not None and ballot == me.plan.ballot


def is_of_my_plan(me: PlanExecution, state: VehicleState) -> bool:
    """A is another member and shows my plan's ballot as accepted."""
    plan = me.plan
    return (
        plan is not None
        and state.accepted
        and state.promised == plan.ballot
        and state.vehicle in plan.moves
        and state.vehicle != me.vehicle
    )


def shows_open_gate(_: PlanExecution, state: VehicleState) -> bool:
    """A has go."""
    return state.go


def hear(me: PlanExecution, state: VehicleState) -> None:
    """heard[A] = max(heard[A], k if A is ready, else -1)."""
    shown = state.completed if state.ready else -1
    me.heard[state.vehicle] = max(me.heard.get(state.vehicle, -1), shown)


def is_holding(me: PlanExecution, _: object) -> bool:
    """I hold my cell."""
    return not me.moving


def all_are_ready(me: PlanExecution, _: object) -> bool:
    """heard[A] >= 0 for every other member."""
    return me.plan is not None and all(
        me.heard.get(other, -1) >= 0 for other in me.plan.roster if other != me.vehicle
    )


def take_ownership(me: PlanExecution, _: object) -> None:
    """Own the cells of `after`: the transfer is open."""
    if me.transfer is not None:
        me.transfer = Deed(me.transfer.ballot, open=True)


def has_next_move(me: PlanExecution, _: object) -> bool:
    """There is a next move."""
    return me.next_move is not None


def is_time(me: PlanExecution, _: object) -> bool:
    """My clock >= t0 + step * slot."""
    return me.is_due(me.t_s)


def is_released(me: PlanExecution, _: object) -> bool:
    """heard[A] >= need(A) for all dependencies of the move."""
    heard = me.heard
    for other, count in me.needs[me.completed].items():  # noqa: SIM110 (asked at each tick)
        if heard.get(other, -1) < count:
            return False
    return True


def start_move(me: PlanExecution, _: object) -> None:
    """Move: from now on I count as being at the target."""
    move = me.next_move
    if move is not None:
        me.hold_cell = move[2]
        me.moving = me.moving_in_plan = True


def is_moving(me: PlanExecution, _: object) -> bool:
    """I was moving."""
    return me.moving


def moved_in_plan(me: PlanExecution, _: object) -> bool:
    """The motion was a move of my plan."""
    return me.moving_in_plan


def count_move(me: PlanExecution, _: object) -> None:
    """Count it: k += 1."""
    me.completed += 1


def rest(me: PlanExecution, _: object) -> None:
    """Hold the target."""
    me.moving = me.moving_in_plan = False


_ANY = tuple(ExecutionPhase)
_, _PROMISED, _TAKEN, _GATED, _GOING = _ANY

VEHICLE_RULES: RuleBook = RuleBook(
    (
        Transition(
            "V2",
            PREPARE,
            _ANY,
            (is_in_roster, is_above_promise),
            (promise, drop_plan, forget_heard, show),
            _PROMISED,
        ),
        Transition("V2", PREPARE, _ANY, (is_in_roster,), (show,)),
        Transition(
            "V3",
            PLAN,
            (_PROMISED,),
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
            _TAKEN,
        ),
        Transition("V3", NOTED, (_TAKEN,), (is_noted,), (show,), _GATED),
        Transition(
            "V4", STATE, (_GATED,), (is_of_my_plan, shows_open_gate), (hear, take_ownership), _GOING
        ),
        Transition("V4", STATE, (_TAKEN, _GATED, _GOING), (is_of_my_plan,), (hear,)),
        Transition("V5", GATE, (_GATED,), (is_holding, all_are_ready), (take_ownership,), _GOING),
        Transition(
            "V6", TICK, (_GOING,), (is_holding, has_next_move, is_time, is_released), (start_move,)
        ),
        Transition("V7", REST, _ANY, (is_moving, moved_in_plan), (count_move, rest)),
        Transition("V7", REST, _ANY, (is_moving,), (rest,)),
    )
)
"""Rules V2 to V7."""
