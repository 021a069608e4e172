"""One ballot held by a leader: prepare, promise, plan, accept (rules L4 to L8).

The leader requests a promise from every vehicle in the roster, has a plan made from the hold cells
in the promises, and issues that plan under the ballot. Safety requires only two things: a ballot
is never used twice, and a plan is made only from promises of the *whole* roster. Vehicles
check everything else.

Each operation has its own table, which contains `PLAN_RULES`. The tables differ in how they handle
outbid ballots, restarted vehicles and failed planning: formations try again, the rolling operation
aborts the ballot. The plan is made between the events `PROMISED` and `PLANNED`: by a computation
outside the core (formations) or directly from the promises (rolling).
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum

from attrs import define, field

from laneweave.protocol.lattice import Cell, PlannedMove, territory
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.wire.messages import Ballot, Name, Plan, Prepare, VehicleState

ISSUE_S = 30.0
"""Time for all vehicles to accept a plan; after that, it is abandoned (L8)."""


class BallotPhase(Enum):
    """Progress of a leader with its newest ballot."""

    OBSERVING = "observing"
    """L2: determining whether a plan in force can be adopted."""
    PREPARING = "preparing"
    """L3, L4: collecting promises."""
    PLANNING = "planning"
    """L5: the whole roster has promised; the plan is being made."""
    ISSUING = "issuing"
    """L6: the plan is being sent until all have accepted."""
    IN_FORCE = "in force"
    """All have accepted the plan."""
    BACKING_OFF = "backing off"
    """L7: pausing because a vehicle has promised a higher ballot."""
    ABORTED = "aborted"
    """Nothing more is sent; vehicles hold, or execute an earlier plan in force."""


UNFINISHED = (BallotPhase.PREPARING, BallotPhase.PLANNING, BallotPhase.ISSUING)

STATE, TIME, MEMBERS = "STATE", "time", "census"
PROMISED, PLANNED, FAILED, TOO_LATE = "promised", "planned", "planning failed", "too late"


@define(kw_only=True)
class BallotRound:
    """A leader's state for one ballot at a time; subclasses define the roster and handle events."""

    rules: RuleBook
    resend_s: float
    """Interval at which PREPARE and PLAN are resent."""
    phase: BallotPhase = BallotPhase.PREPARING
    ballot: Ballot | None = None
    plan: Plan | None = None
    promises: dict[Name, VehicleState] = field(factory=dict)
    accepted: set[Name] = field(factory=set)
    failures: int = 0
    """Number of failed planning attempts under this ballot."""
    back_offs: int = 0
    """Number of back-offs since the last acceptance."""
    now_s: float = 0.0
    """Time of the current event (node clock)."""
    due_s: float = 0.0
    """Time of the next timer or resend (node clock)."""
    until_s: float = 0.0
    """Time at which the phase times out (node clock)."""

    @property
    def roster(self) -> tuple[Name, ...]:
        """Vehicles whose promises and acceptances the ballot needs."""
        raise NotImplementedError

    @property
    def blocks(self) -> tuple[int, ...]:
        """Blocks of columns that the plan may use; empty in the rolling operation."""
        return ()

    @property
    def hold_cells(self) -> dict[Name, Cell]:
        """Hold cell of each vehicle, from its promise."""
        return {name: self.promises[name].hold_cell for name in self.roster}

    @property
    def incarnations(self) -> dict[Name, int]:
        """Incarnation of the process that promised for each vehicle."""
        return {name: self.promises[name].record.incarnation for name in self.roster}

    def make_plan(
        self,
        formations: tuple[int, ...],
        moves: dict[Name, tuple[PlannedMove, ...]],
        t0_s: float,
        slot_s: float,
    ) -> Plan:
        """Return the plan with these moves from the promised hold cells."""
        assert self.ballot is not None  # noqa: S101 (set before planning begins)
        cells, every_move = self.hold_cells, [move for each in moves.values() for move in each]
        return Plan(
            ballot=self.ballot,
            blocks=formations,
            roster=tuple(cells),
            incarnations=self.incarnations,
            start_cells=cells,
            moves=moves,
            t0_s=t0_s,
            slot_s=slot_s,
            territory=tuple(sorted(territory(cells.values(), every_move))),
        )

    def take(self, event: str, now_s: float, message: object = None) -> bool:
        """Handle an event of the rule table; return whether a transition was taken."""
        self.now_s = now_s
        return self.rules.take(self, event, message) is not None

    def outgoing(self, now_s: float) -> Iterable[tuple[Name, Prepare | Plan]]:
        """Return the messages to send or resend now, each with its receiver."""
        if now_s < self.due_s or self.ballot is None:
            return []
        if self.phase is BallotPhase.PREPARING:
            missing = [name for name in self.roster if name not in self.promises]
            message = Prepare(self.ballot, self.blocks, self.roster)
            if missing:
                self.due_s = now_s + self.resend_s
            return [(name, message) for name in missing]
        if self.phase is BallotPhase.ISSUING and self.plan is not None:
            plan = self.plan
            self.due_s = now_s + self.resend_s
            return [(name, plan) for name in plan.roster if name not in self.accepted]
        return []

    @property
    def wakeup_s(self) -> float | None:
        """Time of the next timer or resend, or None."""
        if self.phase in _WITHOUT_TIMER:
            return None
        return self.due_s


_WITHOUT_TIMER = (BallotPhase.PLANNING, BallotPhase.IN_FORCE, BallotPhase.ABORTED)


# --- guards and actions -----------------------------------------------------------------------


def has_higher_promise(round_: BallotRound, state: VehicleState) -> bool:
    """The vehicle has promised a ballot above b."""
    ballot = round_.ballot
    return (
        ballot is not None and state.record.promised is not None and state.record.promised > ballot
    )


def had_promised(round_: BallotRound, state: VehicleState) -> bool:
    """A promise from the vehicle is on record."""
    return state.vehicle in round_.promises


def restarted(round_: BallotRound, state: VehicleState) -> bool:
    """No promise from the reported incarnation is on record."""
    promise = round_.promises.get(state.vehicle)
    return promise is None or promise.record.incarnation != state.record.incarnation


def is_promise(round_: BallotRound, state: VehicleState) -> bool:
    """The vehicle has promised but not accepted b."""
    return state.record.promised == round_.ballot and not state.accepted


def count_promise(round_: BallotRound, state: VehicleState) -> None:
    """Record the promise, with hold cell and incarnation."""
    round_.promises[state.vehicle] = state
    if len(round_.promises) == len(round_.roster) and not round_.failures:
        round_.due_s = round_.now_s


def all_have_promised(round_: BallotRound, _: object) -> bool:
    """The whole roster has promised."""
    return set(round_.promises) == set(round_.roster)


def may_plan(round_: BallotRound, _: object) -> bool:
    """The pause after a failed attempt is over."""
    return not round_.failures or round_.now_s >= round_.due_s


def order_plan(round_: BallotRound, _: object) -> None:
    """Plan from the promised hold cells."""


def issue(round_: BallotRound, plan: Plan) -> None:
    """Send PLAN, once per ballot."""
    round_.plan = plan
    round_.failures = 0
    round_.accepted = set()
    round_.due_s = round_.now_s
    round_.until_s = round_.now_s + ISSUE_S


def is_acceptance(round_: BallotRound, state: VehicleState) -> bool:
    """The vehicle has accepted b."""
    return state.record.promised == round_.ballot and state.accepted


def is_last(round_: BallotRound, state: VehicleState) -> bool:
    """All other vehicles have accepted b."""
    return round_.accepted | {state.vehicle} >= set(round_.roster)


def count_acceptance(round_: BallotRound, state: VehicleState) -> None:
    """Record the acceptance."""
    round_.accepted.add(state.vehicle)
    round_.back_offs = 0


# --- transitions that both operations share ---------------------------------------------------

_PREPARING, _PLANNING, _ISSUING = UNFINISHED
_IN_FORCE = BallotPhase.IN_FORCE

PLAN_RULES = (
    Transition(
        "L5", PROMISED, (_PREPARING,), (all_have_promised, may_plan), (order_plan,), _PLANNING
    ),
    Transition("L5", PLANNED, (_PLANNING,), (), (issue,), _ISSUING),
    Transition("L6", STATE, (_ISSUING,), (is_acceptance, is_last), (count_acceptance,), _IN_FORCE),
    Transition("L6", STATE, (_ISSUING,), (is_acceptance,), (count_acceptance,)),
)
"""Transitions from the last promise to a plan in force (L5, L6)."""


def age(state: VehicleState) -> tuple[object, ...]:
    """Return a value that orders the states of a vehicle by the time at which they were sent.

    States sent between two ticks have equal times. Their order follows from the promise and the
    acceptance, which are never undone.
    """
    transfer = state.record.transfer
    return (
        state.record.incarnation,
        state.t_s,
        state.record.promised or (),
        bool(state.record.owned),
        state.accepted,
        (transfer.ballot, transfer.open) if transfer is not None else (),
    )
