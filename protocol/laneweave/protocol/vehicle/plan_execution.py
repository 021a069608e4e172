"""Plan execution: the vehicle's side of the protocol, rules V1 to V8.

A vehicle holds its cell until all conditions of its next move are *known* to be true: it has
accepted a plan, every member of the roster has reported that it accepted the same plan (start
gate), and every vehicle with an earlier interfering move has reported completing it. The clock can
delay moves, but never releases one; without messages, vehicles hold. `execution_rules` has the
rules.

The process in charge of a vehicle runs this machine: its agent, or its caretaker in the bridge,
which never moves the vehicle. It lives in the protocol because the bridge does not import agents.
"""

from __future__ import annotations

from enum import Enum

from attrs import define, field
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.plans import Needs
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
    rules: RuleBook
    """`execution_rules.VEHICLE_RULES`; tests plant bugs in it."""
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
    followers: tuple[int, ...] = ()
    """Steps of the moves of other vehicles that depend on moves of this one."""
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

    def on_sense(self, sense: Sense, *, arrived: bool, displaced: bool) -> PlannedMove | None:
        """Handle the measurements of a tick; return the move that starts now, if any.

        Args:
            sense: the measurements.
            arrived: whether the body has completed its motion.
            displaced: whether the body is out of the cell that the vehicle should hold.
        """
        self.on_record(sense.record)
        self.on_body(arrived=arrived, displaced=displaced)
        return self.tick(sense.t_s)

    def on_body(self, *, arrived: bool = False, displaced: bool = False) -> None:
        """V7 and V8: complete the current motion; move back to the cell."""
        if arrived:
            self.rules.take(self, REST, None)
        if displaced:
            self.rules.take(self, BODY, None)

    def tick(self, t_s: float) -> PlannedMove | None:
        """V5 and V6: open the gate if possible, and return the move that starts now, if any."""
        self.t_s = t_s
        self.rules.take(self, GATE, None)
        if self.rules.take(self, TICK, None) is None:
            return None
        return self.next_move

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
            s_m=sense.measured[0],
            y_m=sense.measured[3],
            speed_mps=sense.measured[1],
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
        return self.is_due(t_s + LISTEN_S) and not self.released

    def is_awaited(self, t_s: float, ahead_s: float) -> bool:
        """Return whether a move is due within a time: of this vehicle, or of one that waits for it.

        Others have heard of the completed moves of this vehicle `LISTEN_S` after theirs are due.
        """
        plan = self.plan
        if plan is None:
            return False
        due_s = (plan.t0_s + step * plan.slot_s for step in self.followers)
        return self.is_due(t_s + ahead_s) or any(
            one_s - ahead_s <= t_s <= one_s + LISTEN_S for one_s in due_s
        )

    @property
    def next_move(self) -> PlannedMove | None:
        """First uncompleted move of the plan, or None."""
        if self.plan is None or self.completed >= len(self.plan.moves[self.vehicle]):
            return None
        return self.plan.moves[self.vehicle][self.completed]

    @property
    def released(self) -> bool:
        """Whether all moves on which the next move depends are reported as completed."""
        progress = self.progress
        for other, count in self.needs[self.completed].items():
            if progress.get(other, -1) < count:
                return False
        return True

    @property
    def too_late(self) -> bool:
        """Whether the next move can no longer end before one of its lanes does."""
        plan, move = self.plan, self.next_move
        if plan is None or move is None or not self.lane_ends:
            return False
        step, origin, target = move
        begin_s = max(self.t_s, plan.t0_s + step * plan.slot_s)
        return self.lane_ends.too_late(origin, target, begin_s, plan.slot_s)

    @property
    def stuck(self) -> bool:
        """Whether the gate is open for a move that can no longer begin."""
        return self.go and not self.moving and self.too_late

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
