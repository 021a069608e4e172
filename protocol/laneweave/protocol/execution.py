"""Plan execution: the vehicle's side of the execution protocol, rules V1 to V7.

The vehicle holds its cell unless everything that its next move needs is *known*: it has promised
and accepted a plan, every member of the roster has shown that it accepted the same plan (start
gate), and every vehicle whose earlier move interferes has shown that it completed it. Time only
paces; silence always means hold. `VEHICLE_RULES` is the table; docs/PROTOCOL.md shows it,
docs/SAFETY.md has the argument.

Whoever is in charge of a vehicle runs this machine: its agent, or its caretaker, which never moves.
"""

from __future__ import annotations

from enum import Enum

from attrs import define, field

from laneweave.protocol.lattice import Cell, Lattice, Move
from laneweave.protocol.messages import Ballot, Name, Plan, Prepare, Sense, VehicleState
from laneweave.protocol.plans import Needs, dependencies, plan_problems
from laneweave.protocol.transitions import RuleBook, Transition, named

TIME_TOLERANCE_S = 1e-6


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


@define
class PlanExecution:
    """What one vehicle remembers of the protocol (V1: nothing promised, no plan).

    `hold_cell`, `moving` and `joined` mirror the motion controller, which outlives this object.
    """

    vehicle: Name
    incarnation: int
    hold_cell: Cell
    lattice: Lattice
    overdue_s: float
    """A move due for longer than this is reported as overdue."""
    joined: tuple[int, ...]
    """Formations whose blocks plans may use, as the motion controller has confirmed; ascending."""
    moving: bool = False
    rules: RuleBook = field(factory=lambda: VEHICLE_RULES)
    phase: Stage = Stage.FREE
    promised: Ballot | None = None
    plan: Plan | None = None
    completed: int = 0
    heard: dict[Name, int] = field(factory=dict)
    """Completed moves of my plan that each other member has shown; -1: not ready yet."""
    wanted_joined: tuple[int, ...] = field(init=False)
    """What the motion controller should remember as joined."""
    moving_in_plan: bool = False
    """The motion under way is a move of the accepted plan."""
    needs: tuple[Needs, ...] = ()
    """For each of my moves what it needs of the others."""
    t_s: float = 0.0
    """Road time of the tick."""

    def __attrs_post_init__(self) -> None:
        """Want no more than the controller has."""
        self.wanted_joined = self.joined

    def on_prepare(self, prepare: Prepare) -> bool:
        """V2: promise a ballot; true when a state should be shown at once."""
        return self.rules.take(self, PREPARE, prepare) is not None

    def on_plan(self, plan: Plan) -> bool:
        """V3: take the plan of the promised ballot, once; true when it was taken now.

        A plan that cannot be executed safely is not taken, whoever sent it. It is accepted, and
        that is shown, when the motion controller has noted it for this very process (`on_noted`).
        """
        return self.rules.take(self, PLAN, plan) is not None

    def on_noted(self, ballot: Ballot | None) -> bool:
        """V3: the controller notes a plan for the process in charge; true when it is mine now."""
        return self.rules.take(self, NOTED, ballot) is not None

    def on_joined(self, formations: tuple[int, ...]) -> bool:
        """The controller has noted formations as joined; true when some were not known yet.

        What it says may be older than what is known already: nothing that has been joined parts.
        """
        if set(formations) <= set(self.joined):
            return False
        self.joined = tuple(sorted({*self.joined, *formations}))
        return True

    def on_state(self, state: VehicleState) -> None:
        """V4: remember what another member of the same plan has shown."""
        self.rules.take(self, STATE, state)

    def tick(self, t_s: float) -> Move | None:
        """V5 and V6: open the gate when it may, and return the move that starts now, if any."""
        self.t_s = t_s
        self.rules.take(self, GATE, None)
        if self.rules.take(self, TICK, None) is None:
            return None
        return self.next_move

    def end_motion(self) -> None:
        """V7: the controller holds again."""
        self.rules.take(self, REST, None)

    @property
    def next_move(self) -> Move | None:
        """The first move of the plan that is not completed."""
        if self.plan is None or self.completed >= len(self.plan.moves[self.vehicle]):
            return None
        return self.plan.moves[self.vehicle][self.completed]

    @property
    def wanted_accepted(self) -> Ballot | None:
        """The plan that the motion controller should note as accepted."""
        return self.plan.ballot if self.plan is not None else None

    @property
    def accepted(self) -> bool:
        """It has a plan, and its motion controller has noted that."""
        return self.phase in _ACCEPTED

    @property
    def go(self) -> bool:
        """The start gate is open."""
        return self.phase is Stage.GOING

    @property
    def done(self) -> bool:
        """All moves of the accepted plan are completed."""
        return self.accepted and self.next_move is None

    @property
    def ready(self) -> bool:
        """Accepted, and not moving or moving in a move of this plan."""
        return bool(self.rules.functions["is_ready"](self, None))

    def overdue(self, t_s: float) -> bool:
        """Tell whether the next move has been due for too long."""
        return self.accepted and not self.moving and self.is_due(t_s - self.overdue_s)

    def is_due(self, t_s: float) -> bool:
        """Tell whether the time of the next move has come."""
        plan, move = self.plan, self.next_move
        if plan is None or move is None:
            return False
        return t_s + TIME_TOLERANCE_S >= plan.t0_s + move[0] * plan.slot_s

    def state(self, sense: Sense, formation: int, *, attended: bool) -> VehicleState:
        """Return what to show to others.

        Args:
            sense: what the vehicle sensed last.
            formation: in whose block it entered.
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
        )

    def needs_states(self, t_s: float) -> bool:
        """Tell whether what other vehicles show matters now.

        It does until the gate is open, and from shortly before the plan's start on as long as a
        move waits for somebody. What is missed in between is shown again: it stays true.
        """
        plan = self.plan
        if plan is None:
            return False
        if not self.go:
            return True
        return t_s >= plan.t0_s - plan.slot_s and any(
            self.heard.get(other, -1) < count
            for needs in self.needs[self.completed :]
            for other, count in needs.items()
        )


PREPARE, PLAN, NOTED, STATE = "PREPARE", "PLAN", "SENSE", "STATE"
GATE, TICK, REST = "tick (gate)", "tick (move)", "motion ends"


# --- guards and actions: their first lines are the words of docs/PROTOCOL.md ----------------------


def _is_in_roster(me: PlanExecution, prepare: Prepare) -> bool:
    """I am in the roster."""
    return me.vehicle in prepare.roster


def _is_above_promise(me: PlanExecution, prepare: Prepare) -> bool:
    """The ballot is above the one that I promised, if any."""
    return me.promised is None or prepare.ballot > me.promised


def _promise(me: PlanExecution, prepare: Prepare) -> None:
    """Promise the ballot, ask the controller to join its formations."""
    me.promised = prepare.ballot
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
    blocks = set(plan.formations)
    return all(
        me.lattice.block_of(column) in blocks and 0 <= lane < me.lattice.lanes
        for column, lane in plan.territory
    )


def _has_joined(me: PlanExecution, plan: Plan) -> bool:
    """My controller has confirmed that its formations are joined."""
    return set(plan.formations) <= set(me.joined)


def _accept(me: PlanExecution, plan: Plan) -> None:
    """Take the plan, derive what its moves need, ask the controller to note it."""
    me.plan = plan
    me.needs = me.rules.functions["dependencies"](plan, me.vehicle)


def _is_noted(me: PlanExecution, ballot: Ballot | None) -> bool:
    """My controller has noted for me that I accept it."""
    return me.plan is not None and ballot == me.wanted_accepted


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
    return me.accepted and (not me.moving or me.moving_in_plan)


def _is_holding(me: PlanExecution, _: object) -> bool:
    """I hold my cell."""
    return not me.moving


def _all_are_ready(me: PlanExecution, _: object) -> bool:
    """heard[A] >= 0 for every other member."""
    return me.plan is not None and all(
        me.heard.get(other, -1) >= 0 for other in me.plan.roster if other != me.vehicle
    )


def _has_next_move(me: PlanExecution, _: object) -> bool:
    """There is a next move."""
    return me.next_move is not None


def _is_time(me: PlanExecution, _: object) -> bool:
    """My clock >= t0 + step * slot."""
    return me.is_due(me.t_s)


def _is_released(me: PlanExecution, _: object) -> bool:
    """heard[A] >= need(A) for all dependencies of the move."""
    return all(me.heard.get(other, -1) >= count for other, count in me.needs[me.completed].items())


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
_ACCEPTED = (Stage.GATED, Stage.GOING)

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
            ("hear",),
            Stage.GOING,
        ),
        Transition("V4", STATE, _WITH_PLAN, ("is_of_my_plan",), ("hear",)),
        Transition("V5", GATE, (Stage.GATED,), ("is_holding", "all_are_ready"), (), Stage.GOING),
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
        _accept,
        _is_noted,
        _is_of_my_plan,
        _shows_open_gate,
        _hear,
        _is_ready,
        _is_holding,
        _all_are_ready,
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
"""Rules V2 to V7; V1 is the construction of a `PlanExecution`."""
