"""One ballot of a leader: prepare, promise, plan, accept (rules L4 to L8).

The leader asks every vehicle of the roster for a promise, has a plan made from the cells in which
they will hold, and issues that one plan under the ballot. Nothing here is needed for safety, except
that a ballot is never used twice and that a plan is made only from the promises of the *whole*
roster; vehicles check the rest.

Each operation has a table of its own, with the rows of `PLAN_RULES` in both. They differ where a
ballot is outbid, a vehicle has restarted, or planning has failed: formations try again, the rolling
operation gives up until the next slot. Between the events `PROMISED` and `PLANNED` the plan is
made: by the planner, beside the core (formations), or at once from the promises (rolling).
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum

from attrs import define, field

from laneweave.protocol.lattice import Cell, PlannedMove, territory
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.wire.messages import Ballot, Name, Plan, Prepare, VehicleState

ISSUE_S = 30.0
"""A plan that is not accepted by all in this time is given up: a vehicle refuses it (L8)."""


class BallotPhase(Enum):
    """Where a leader stands with its newest ballot."""

    OBSERVING = "observing"
    """L2: is a plan in force that can be adopted?"""
    PREPARING = "preparing"
    """L3, L4: collecting promises."""
    PLANNING = "planning"
    """L5: the whole roster has promised."""
    ISSUING = "issuing"
    """L6: the plan is being sent until all have accepted."""
    IN_FORCE = "in force"
    """All have accepted the plan."""
    BACKING_OFF = "backing off"
    """L7: a vehicle promised a higher ballot."""
    ABORTED = "aborted"
    """Nothing more is sent; the vehicles hold, or follow the plan that is in force."""


UNFINISHED = (BallotPhase.PREPARING, BallotPhase.PLANNING, BallotPhase.ISSUING)

STATE, TIME, MEMBERS = "STATE", "time", "census"
PROMISED, PLANNED, FAILED, TOO_LATE = "promised", "planned", "planning failed", "too late"


@define(kw_only=True)
class BallotRound:
    """A leader's state of one ballot at a time; subclasses say for whom, and feed it events."""

    rules: RuleBook
    resend_s: float
    """Period of sending PREPARE and PLAN again."""
    phase: BallotPhase = BallotPhase.PREPARING
    ballot: Ballot | None = None
    plan: Plan | None = None
    promises: dict[Name, VehicleState] = field(factory=dict)
    accepted: set[Name] = field(factory=set)
    failures: int = 0
    """Plannings that failed under this ballot."""
    back_offs: int = 0
    """Pauses in a row without an acceptance between them."""
    now_s: float = 0.0
    """Time of the current event (node clock)."""
    due_s: float = 0.0
    """When the phase's timer fires, or something is to be sent again (node clock)."""
    until_s: float = 0.0
    """When the phase has lasted for long enough (node clock)."""

    @property
    def roster(self) -> tuple[Name, ...]:
        """All vehicles whose promises and acceptances the ballot needs."""
        raise NotImplementedError

    @property
    def blocks(self) -> tuple[int, ...]:
        """Blocks of columns that the plan may use; empty where vehicles own cells."""
        return ()

    @property
    def hold_cells(self) -> dict[Name, Cell]:
        """Where each vehicle will hold, from its promise."""
        return {name: self.promises[name].hold_cell for name in self.roster}

    @property
    def incarnations(self) -> dict[Name, int]:
        """Incarnation of the process of each vehicle that promised."""
        return {name: self.promises[name].incarnation for name in self.roster}

    def make_plan(
        self,
        formations: tuple[int, ...],
        moves: dict[Name, tuple[PlannedMove, ...]],
        t0_s: float,
        slot_s: float,
    ) -> Plan:
        """Return the plan of these moves from the cells that were promised."""
        assert self.ballot is not None  # noqa: S101 (set before planning begins)
        cells, every_move = self.hold_cells, [move for each in moves.values() for move in each]
        return Plan(
            ballot=self.ballot,
            formations=formations,
            roster=tuple(cells),
            incarnations=self.incarnations,
            start_cells=cells,
            moves=moves,
            t0_s=t0_s,
            slot_s=slot_s,
            territory=tuple(sorted(territory(cells.values(), every_move))),
        )

    def take(self, event: str, now_s: float, message: object = None) -> bool:
        """Take an event of the rule table; return whether a row of it fits."""
        self.now_s = now_s
        return self.rules.take(self, event, message) is not None

    def outgoing(self, now_s: float) -> Iterable[tuple[Name, Prepare | Plan]]:
        """Return what has to be sent (again) now, and to which vehicle."""
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
        """When a timer fires, or `outgoing` has something to send; None: never."""
        if self.phase in _WITHOUT_TIMER:
            return None
        return self.due_s


_WITHOUT_TIMER = (BallotPhase.PLANNING, BallotPhase.IN_FORCE, BallotPhase.ABORTED)


# --- guards and actions -----------------------------------------------------------------------


def has_higher_promise(ballot_round: BallotRound, state: VehicleState) -> bool:
    """It promised more than b."""
    return (
        ballot_round.ballot is not None
        and state.promised is not None
        and state.promised > ballot_round.ballot
    )


def had_promised(ballot_round: BallotRound, state: VehicleState) -> bool:
    """Its promise was counted."""
    return state.vehicle in ballot_round.promises


def restarted(ballot_round: BallotRound, state: VehicleState) -> bool:
    """Its incarnation is not the one that promised."""
    promise = ballot_round.promises.get(state.vehicle)
    return promise is None or promise.incarnation != state.incarnation


def is_promise(ballot_round: BallotRound, state: VehicleState) -> bool:
    """It promised b and has not accepted."""
    return state.promised == ballot_round.ballot and not state.accepted


def count_promise(ballot_round: BallotRound, state: VehicleState) -> None:
    """Count the promise, with hold cell and incarnation."""
    ballot_round.promises[state.vehicle] = state
    if len(ballot_round.promises) == len(ballot_round.roster) and not ballot_round.failures:
        ballot_round.due_s = ballot_round.now_s


def all_have_promised(ballot_round: BallotRound, _: object) -> bool:
    """The whole roster has promised."""
    return set(ballot_round.promises) == set(ballot_round.roster)


def may_plan(ballot_round: BallotRound, _: object) -> bool:
    """The pause after failed planning is over."""
    return not ballot_round.failures or ballot_round.now_s >= ballot_round.due_s


def order_plan(ballot_round: BallotRound, _: object) -> None:
    """Plan from the hold cells."""


def issue(ballot_round: BallotRound, plan: Plan) -> None:
    """PLAN, the one and only of b."""
    ballot_round.plan = plan
    ballot_round.failures = 0
    ballot_round.accepted = set()
    ballot_round.due_s = ballot_round.now_s
    ballot_round.until_s = ballot_round.now_s + ISSUE_S


def is_acceptance(ballot_round: BallotRound, state: VehicleState) -> bool:
    """It accepted b."""
    return state.promised == ballot_round.ballot and state.accepted


def is_last_acceptance(ballot_round: BallotRound, state: VehicleState) -> bool:
    """All others have accepted."""
    return ballot_round.accepted | {state.vehicle} >= set(ballot_round.roster)


def count_acceptance(ballot_round: BallotRound, state: VehicleState) -> None:
    """Count the acceptance."""
    ballot_round.accepted.add(state.vehicle)
    ballot_round.back_offs = 0


# --- the rows that both operations share ------------------------------------------------------

_PREPARING, _PLANNING, _ISSUING = UNFINISHED
_IN_FORCE = BallotPhase.IN_FORCE

PLAN_RULES = (
    Transition(
        "L5", PROMISED, (_PREPARING,), (all_have_promised, may_plan), (order_plan,), _PLANNING
    ),
    Transition("L5", PLANNED, (_PLANNING,), (), (issue,), _ISSUING),
    Transition(
        "L6",
        STATE,
        (_ISSUING,),
        (is_acceptance, is_last_acceptance),
        (count_acceptance,),
        _IN_FORCE,
    ),
    Transition("L6", STATE, (_ISSUING,), (is_acceptance,), (count_acceptance,)),
)
"""From the promises of all to a plan in force (L5, L6)."""


def is_older(state: VehicleState, other: VehicleState) -> bool:
    """Return whether a state of a vehicle was sent before another one of it.

    Between two ticks it shows states with equal times; it never promises less or takes back an
    acceptance, so a late state cannot pass for a newer one.
    """
    if state.incarnation == other.incarnation and state.t_s != other.t_s:
        return state.t_s < other.t_s
    return _age(state) < _age(other)


def _age(state: VehicleState) -> tuple[object, ...]:
    transfer = state.transfer
    return (
        state.incarnation,
        state.t_s,
        state.promised or (),
        bool(state.owned),
        state.accepted,
        (transfer.ballot, transfer.open) if transfer is not None else (),
    )
