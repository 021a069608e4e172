"""Plan execution: the vehicle's side of the protocol, rules V1 to V8.

A vehicle holds its cell until all conditions of its next move are *known* to be true: it has
accepted a plan, every member of the roster has reported that it accepted the same plan (start
gate), and every vehicle with an earlier interfering move has reported completing it. The clock can
delay moves, but never releases one; without messages, vehicles hold. `VEHICLE_RULES` is the table;
the first lines of its guards and actions are shown in docs/PROTOCOL.md. docs/SAFETY.md has the
proof.

The process in charge of a vehicle runs this machine: its agent, or its caretaker, which never moves
the vehicle.
"""

from __future__ import annotations

from enum import Enum

from attrs import define, field
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.plans import Needs, dependencies, plan_problems
from laneweave.protocol.vehicle.territory import Territory
from laneweave.protocol.wire.messages import (
    Ballot,
    Name,
    PendingTransfer,
    Plan,
    Prepare,
    Sense,
    VehicleRecord,
    VehicleState,
)

LISTEN_S = 1.0
"""Lead time before a move is due at which the vehicle subscribes to the others' states."""
OVERDUE_SLOTS = 1.5
OVERDUE_S = 2.0
"""A move that has been due for 1.5 slots, or a slot and 2 s if that is less, is overdue."""
TIME_TOLERANCE_S = 1e-6
LATE_S = 0.2
"""Delay with which a move that leads out of a lane may still begin; longer ones could end with the
body partly in the lane at its stop line."""


class ExecutionPhase(Enum):
    """Progress of a vehicle with the newest ballot."""

    FREE = "free"
    """No ballot is promised."""
    PROMISED = "promised"
    TAKEN = "taken"
    """The vehicle has the plan; its motion controller has not stored the acceptance yet."""
    GATED = "gated"
    """The plan is accepted; the start gate is closed."""
    GOING = "going"
    """The start gate is open."""


PREPARE, PLAN, STORED, STATE = "PREPARE", "PLAN", "SENSE", "STATE"
GATE, TICK, REST, BODY = "tick (gate)", "tick (move)", "motion ends", "body out of its cell"


@define
class PlanExecution:
    """State machine of one vehicle: handles messages and ticks, and decides when moves begin.

    The machine begins without a promise or a plan (V1). `hold_cell`, `moving` and `stored` mirror
    the motion controller, which outlives this object.
    """

    vehicle: Name
    incarnation: int
    hold_cell: Cell
    territory: Territory
    stored: VehicleRecord
    """Record of the vehicle, as last reported; joined blocks are never removed."""
    moving: bool = False
    phase: ExecutionPhase = ExecutionPhase.FREE
    promised: Ballot | None = None
    plan: Plan | None = None
    completed: int = 0
    progress: dict[Name, int] = field(factory=dict)
    """Number of moves that each other member reports as completed; -1: not ready yet."""
    wanted_joined: tuple[int, ...] = field(init=False)
    """Blocks that the motion controller should store."""
    moving_in_plan: bool = False
    """Whether the current motion is a move of the accepted plan."""
    needs: tuple[Needs, ...] = ()
    """Dependencies of each move of this vehicle."""
    t_s: float = 0.0
    """Road time of the tick."""
    promise_stored: bool = False
    """Whether the motion controller has stored the promise; only then does it count."""
    transfer: PendingTransfer | None = None
    """Transfer in the newest plan taken."""
    lane_ends: LaneEnds | None = None
    """Ends of lanes before the end of the road; None: there are none."""
    drivable: frozenset[Cell] | None = None
    """Moves (columns, lanes) that the type of the vehicle drives; None: all."""
    rules: RuleBook = field(factory=lambda: VEHICLE_RULES)

    def __attrs_post_init__(self) -> None:
        """Request no additional blocks."""
        self.wanted_joined = self.stored.joined

    def on_prepare(self, prepare: Prepare) -> bool:
        """V2: promise a ballot; return whether to publish the state at once."""
        return self.rules.take(self, PREPARE, prepare) is not None

    def on_plan(self, plan: Plan) -> bool:
        """V3: take the promised ballot's plan, once; return whether it was taken now.

        A plan that cannot be executed safely is never taken. A taken plan is accepted once the
        motion controller has stored it for this process (`on_record`).
        """
        return self.rules.take(self, PLAN, plan) is not None

    def on_record(self, record: VehicleRecord) -> bool:
        """Copy what the controller stores; return whether to publish the state at once.

        That is so if blocks are newly joined, the taken plan is stored, so that it is accepted now
        (V3), or the promise is newly stored. A promise from an earlier process binds this one and
        is treated like a PREPARE.
        """
        joined = self._joined_with(record)
        changed = joined != self.stored.joined
        if changed:
            self.wanted_joined = tuple(sorted({*joined, *self.wanted_joined}))
            self.stored = replace(self.stored, joined=joined)
        changed |= self.rules.take(self, STORED, record) is not None
        if self.territory.stores_promises:
            promised, before = record.promised, self.promise_stored
            if promised is not None and promised != self.promised:
                self.on_prepare(Prepare(promised, (), (self.vehicle,)))
            self.promise_stored = promised == self.promised
            changed |= self.promise_stored and not before
        self.stored = record if record.joined == joined else replace(record, joined=joined)
        return changed

    def _joined_with(self, record: VehicleRecord) -> tuple[int, ...]:
        """Return all joined blocks: none is ever removed, so an old report has no effect."""
        known = self.stored.joined
        if record.joined == known:
            return known
        return tuple(sorted({*known, *record.joined}))

    def on_state(self, state: VehicleState) -> None:
        """V4: record the progress of another member of the same plan."""
        self.rules.take(self, STATE, state)

    def tick(self, t_s: float) -> PlannedMove | None:
        """V5 and V6: open the gate if possible, and return the move that starts now, if any."""
        self.t_s = t_s
        self.rules.take(self, GATE, None)
        if self.rules.take(self, TICK, None) is None:
            return None
        return self.next_move

    def end_motion(self) -> None:
        """V7: complete the current motion."""
        self.rules.take(self, REST, None)

    def displace(self) -> None:
        """V8: the body is out of the cell that the vehicle should hold."""
        self.rules.take(self, BODY, None)

    @property
    def wanted(self) -> VehicleRecord:
        """Record that the motion controller should store."""
        return VehicleRecord(
            incarnation=self.incarnation,
            joined=self.wanted_joined,
            promised=self.promised if self.territory.stores_promises else None,
            accepted=self.plan.ballot if self.plan is not None else None,
            transfer=self.transfer,
        )

    @property
    def go(self) -> bool:
        """Whether the start gate is open."""
        return self.phase is ExecutionPhase.GOING

    @property
    def done(self) -> bool:
        """Whether all moves of the accepted plan are complete."""
        return self.accepted and self.next_move is None

    @property
    def ready(self) -> bool:
        """Whether the plan is accepted and the vehicle holds or makes a move of this plan."""
        return self.accepted and (not self.moving or self.moving_in_plan)

    def overdue(self, t_s: float) -> bool:
        """Return whether the next move has been due for too long."""
        plan = self.plan
        if plan is None or self.moving or not self.accepted:
            return False
        return self.is_due(t_s - min(OVERDUE_SLOTS * plan.slot_s, plan.slot_s + OVERDUE_S))

    def state(self, sense: Sense, *, attended: bool) -> VehicleState:
        """Return the state to publish.

        Args:
            sense: the newest measurements.
            attended: whether an agent drives the vehicle.
        """
        stored = sense.record
        return VehicleState(
            vehicle=self.vehicle,
            block=sense.block,
            record=VehicleRecord(
                incarnation=self.incarnation,
                joined=self.stored.joined,
                promised=self.promised,
                accepted=self.plan.ballot if self.plan is not None and self.accepted else None,
                owned=stored.owned if stored.promised == self.promised else (),
                transfer=stored.transfer,
            ),
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
        """Return whether the states of other vehicles are needed now.

        They are needed until the gate opens, and from `LISTEN_S` before the next move is due until
        the move is released. States are repeated, so missing some in between is harmless.
        """
        if self.plan is None:
            return False
        if self.phase is not ExecutionPhase.GOING:
            return True
        return self.is_due(t_s + LISTEN_S) and not is_released(self, None)

    @property
    def next_move(self) -> PlannedMove | None:
        """First uncompleted move of the plan, or None."""
        if self.plan is None or self.completed >= len(self.plan.moves[self.vehicle]):
            return None
        return self.plan.moves[self.vehicle][self.completed]

    @property
    def accepted(self) -> bool:
        """Whether a plan is accepted: the motion controller has stored it."""
        return self.phase in (ExecutionPhase.GATED, ExecutionPhase.GOING)

    def is_due(self, t_s: float) -> bool:
        """Return whether there is a next move that is due at a road time."""
        plan, move = self.plan, self.next_move
        if plan is None or move is None:
            return False
        return t_s + TIME_TOLERANCE_S >= plan.t0_s + move[0] * plan.slot_s


# --- guards and actions ---------------------------------------------------------------------------


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
    execution.needs = ()
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
    plan, move, ends = execution.plan, execution.next_move, execution.lane_ends
    if plan is None or move is None or not ends:
        return True
    step, origin, target = move
    front = max(origin[0], target[0])
    begin_s = max(execution.t_s, plan.t0_s + step * plan.slot_s)
    if origin[1] == target[1]:
        return not ends.has_passed((front, origin[1]), begin_s + plan.slot_s - LATE_S, begin_s)
    # It may be planned for later in its slot, when both lanes are open (`both_lanes_are_open`).
    opens_s = max(ends.opens_s((origin[0], lane), begin_s) for lane in (origin[1], target[1]))
    begin_s = opens_s if opens_s < begin_s + plan.slot_s else begin_s
    end_s = begin_s + plan.slot_s - LATE_S
    for lane in (origin[1], target[1]):
        body_m = ends.in_section_m((origin[0], lane), begin_s)
        for has_passed in (ends.has_passed, ends.ends_changes):
            if has_passed((front, lane), end_s, body_m=body_m):
                return False
    return True


def both_lanes_are_open(execution: PlanExecution, _: object) -> bool:
    """The cell is where moves may begin in both lanes."""
    # A move may be planned for later in its slot.
    move, ends = execution.next_move, execution.lane_ends
    return move is None or ends is None or ends.may_begin(*move[1:], execution.t_s)


def is_released(execution: PlanExecution, _: object) -> bool:
    """progress[A] >= needs[A] for all dependencies of the move."""
    progress = execution.progress
    for other, count in execution.needs[execution.completed].items():
        if progress.get(other, -1) < count:
            return False
    return True


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
