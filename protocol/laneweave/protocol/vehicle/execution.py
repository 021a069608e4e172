"""Plan execution: the vehicle's side of the execution protocol, rules V1 to V7.

The vehicle holds its cell unless everything that its next move needs is *known*: it has promised
and accepted a plan, every member of the roster has shown that it accepted the same plan (start
gate), and every vehicle whose earlier move interferes has shown that it completed it. Time only
paces; silence always means hold. `VEHICLE_RULES` is the table; docs/PROTOCOL.md shows it,
docs/SAFETY.md has the argument.

The process in charge of a vehicle runs this machine: its agent, or its caretaker, which never
moves it.
"""

from __future__ import annotations

from attrs import define

from laneweave.protocol.lattice import PlannedMove
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.execution_rules import (
    GATE,
    NOTED,
    PLAN,
    PREPARE,
    REST,
    STATE,
    TICK,
    VEHICLE_RULES,
    ExecutionPhase,
    ExecutionState,
)
from laneweave.protocol.wire.messages import Ballot, Plan, Prepare, Sense, VehicleState

LISTEN_S = 1.0
"""A vehicle receives the states of its predecessors from this time before a move is due."""
OVERDUE_SLOTS = 1.5
OVERDUE_S = 2.0
"""A move is overdue when it has been due for 1.5 slots, or for a slot and 2 s if that is less."""


@define
class PlanExecution(ExecutionState):
    """The machine of one vehicle: takes messages and ticks, returns what to do and to publish."""

    rules: RuleBook = VEHICLE_RULES

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
