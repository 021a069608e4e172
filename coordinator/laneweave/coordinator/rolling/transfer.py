"""One ballot of the rolling operation: vehicles move, and the cells that they need change owners.

The roster comprises the vehicles that move and the owners of the cells in their footprints. Each
vehicle makes at most one move; all moves are in one slot. A ballot is aborted if it is outbid, a
vehicle restarts, or time runs out; its vehicles then hold, and the next slot is planned from there.
`TRANSFER_RULES` is the table, shown in docs/PROTOCOL.md.
"""

from __future__ import annotations

from collections.abc import Mapping

from attrs import define, evolve, field
from msgspec.structs import replace

from laneweave.coordinator.ballots.ballot_round import (
    FAILED,
    MEMBERS,
    PLAN_RULES,
    PLANNED,
    PROMISED,
    STATE,
    TOO_LATE,
    UNFINISHED,
    BallotPhase,
    BallotRound,
    count_promise,
    had_promised,
    has_higher_promise,
    is_promise,
    restarted,
)
from laneweave.coordinator.planning.conflict_kinds import Move
from laneweave.coordinator.rolling.ownership import ReplacedBallots, States
from laneweave.protocol.lattice import Cell, PlannedMove, footprint
from laneweave.protocol.names import first_names
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.vehicle.plans import ownership_problems, plan_problems
from laneweave.protocol.wire.messages import Ballot, Name, Plan, VehicleState

MAX_NAMED = 3
"""Maximum number of vehicles that a reason names."""


@define(kw_only=True)
class CellTransfer(BallotRound):
    """A leader's state for a single ballot."""

    rules: RuleBook = field(factory=lambda: TRANSFER_RULES)
    ballot: Ballot
    roster: tuple[Name, ...]
    moves: Mapping[Name, Move]
    """Move of each vehicle that moves."""
    t0_s: float
    """Road time at which the moves begin."""
    slot_s: float
    replaced: ReplacedBallots = field(factory=ReplacedBallots)
    """Ballots whose members all promise newer ones."""
    awaits_replaced: bool = False
    """Whether all have promised, and members of replaced ballots in other rosters have not, so that
    the owners of some cells are not known yet."""
    gone: frozenset[Name] = frozenset()
    """Departed vehicles that are in rosters of pending transfers; changes with the census."""
    reason: str = ""
    """Why the ballot was aborted."""
    unanswered: tuple[Name, ...] = ()
    """Members that had not answered when time had run out."""

    @property
    def unfinished(self) -> bool:
        """Whether the ballot may still come into force."""
        return self.phase in UNFINISHED

    def on_state(self, state: VehicleState, states: States, now_s: float) -> None:
        """Handle a newer state of a member; `states` are the newest states of all vehicles."""
        self.take(STATE, now_s, state)
        self.plan_from_promises(states, now_s)

    def plan_from_promises(self, states: States, now_s: float) -> None:
        """Plan if all have promised, and what they own does not depend on others' promises."""
        self.awaits_replaced = self._awaits_replaced(states)
        if self.take(PROMISED, now_s):
            plan = self._make_plan(states)
            self.take(PLANNED if isinstance(plan, Plan) else FAILED, now_s, plan)

    def _awaits_replaced(self, states: States) -> bool:
        preparing = self.phase is BallotPhase.PREPARING
        if not (preparing and self.replaced and len(self.promises) == len(self.roster)):
            return False
        known = dict(states) | self.promises
        return any(
            promise.record.transfer is not None
            and promise.record.transfer.ballot in self.replaced
            and self.replaced.owned_cells(promise, known, self.gone) is None
            for promise in self.promises.values()
        )

    def on_left(self, vehicle: Name) -> bool:
        """Abort because a member has left the road; return whether this ends the ballot."""
        return self.rules.take(self, MEMBERS, f"{vehicle} has left") is not None

    def abort(self, reason: str) -> bool:
        """Abort because time has run out; return whether this ends the ballot."""
        return self.rules.take(self, TOO_LATE, reason) is not None

    def _make_plan(self, states: States) -> Plan | str:
        """Return the plan from the promises, or the reason why there is none."""
        before: dict[Name, frozenset[Cell]] = {}
        known = dict(states) | self.promises
        for name, promise in self.promises.items():
            owned = self.replaced.owned_cells(promise, known, self.gone)
            if owned is None:
                return f"the cells of {name} are not known"
            before[name] = owned
        for name, (origin, _) in self.moves.items():
            promise = self.promises[name]
            if promise.hold_cell != origin or not promise.attended:
                return f"{name} is not in the cell that was planned from"
        plan = self._plan(before)
        return "; ".join([*plan_problems(plan), *ownership_problems(plan)]) or plan

    def _plan(self, before: Mapping[Name, frozenset[Cell]]) -> Plan:
        needed = {name: footprint(*move) for name, move in self.moves.items()}
        given = {cell for cells in needed.values() for cell in cells}
        after = {name: (cells - given) | needed.get(name, set()) for name, cells in before.items()}
        moves: dict[Name, tuple[PlannedMove, ...]] = dict.fromkeys(self.roster, ())
        moves |= {name: ((0, *move),) for name, move in self.moves.items()}
        formations = tuple(sorted({promise.block for promise in self.promises.values()}))
        return replace(
            self.make_plan(formations, moves, self.t0_s, self.slot_s),
            before={name: tuple(sorted(before[name])) for name in self.roster},
            after={name: tuple(sorted(after[name])) for name in self.roster},
        )


# --- guards and actions -----------------------------------------------------------------------


def reports_owned_cells(_: CellTransfer, state: VehicleState) -> bool:
    """The state reports owned cells: the controller has stored the promise."""
    return bool(state.record.owned)


def knows_owners(transfer: CellTransfer, _: object) -> bool:
    """What the members own does not depend on promises of other members of replaced ballots."""
    return not transfer.awaits_replaced


def record_outbid(transfer: CellTransfer, _: object) -> None:
    """Record the reason; wait for the next slot."""
    transfer.reason = "outbid"


def record_restart(transfer: CellTransfer, state: VehicleState) -> None:
    """Record the reason; wait for the next slot."""
    transfer.reason = f"{state.vehicle} has restarted"


def record_reason(transfer: CellTransfer, reason: str) -> None:
    """Record the reason; wait for the next slot."""
    transfer.reason = reason


def record_unanswered(transfer: CellTransfer, reason: str) -> None:
    """Record the reason, and the members that have not promised or accepted the plan."""
    issuing = transfer.phase is BallotPhase.ISSUING
    answers = transfer.accepted if issuing else transfer.promises
    transfer.unanswered = tuple(name for name in transfer.roster if name not in answers)
    awaited = first_names(transfer.unanswered, MAX_NAMED) or "a member of a replaced ballot"
    transfer.reason = f"{reason}, and {awaited} did not answer"


_PREPARING, _PLANNING, _ISSUING = UNFINISHED
_WAITING, _ABORTED = (_PREPARING, _ISSUING), BallotPhase.ABORTED

_WHEN_PROMISED, *_MORE_PLAN_RULES = PLAN_RULES

TRANSFER_RULES: RuleBook = RuleBook(
    (
        Transition("L7", STATE, _WAITING, (has_higher_promise,), (record_outbid,), _ABORTED),
        Transition("L8", STATE, _WAITING, (had_promised, restarted), (record_restart,), _ABORTED),
        Transition("L4", STATE, (_PREPARING,), (is_promise, reports_owned_cells), (count_promise,)),
        evolve(_WHEN_PROMISED, guards=(*_WHEN_PROMISED.guards, knows_owners)),
        *_MORE_PLAN_RULES,
        Transition("L5", FAILED, (_PLANNING,), (), (record_reason,), _ABORTED),
        Transition("L8", MEMBERS, _WAITING, (), (record_reason,), _ABORTED),
        Transition("L8", TOO_LATE, _WAITING, (), (record_unanswered,), _ABORTED),
    )
)
"""Rules L4 to L8 of cell transfers."""
