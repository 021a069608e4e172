"""One ballot of the rolling operation: some vehicles move, and cells change hands for it.

The roster is whoever moves and whoever owns a cell that is moved through. As with formations the
whole roster promises, from where it then holds the plan is made, and the plan is in force when all
have accepted it (rules L3 to L6). It is short: one move of each vehicle at most, in one slot. What
does not come about in time is given up; everybody holds, and the next slot is planned from there.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from enum import Enum

from attrs import define, field

from laneweave.protocol.lattice import Cell, PlannedMove, footprint, territory
from laneweave.protocol.vehicle.plans import estate_problems, plan_problems
from laneweave.protocol.wire.messages import Ballot, Deed, Name, Plan, Prepare, VehicleState

Moves = Mapping[Name, tuple[Cell, Cell]]
"""(from, to) of each vehicle that moves."""
States = Mapping[Name, VehicleState]


class Phase(Enum):
    """Where a handover stands."""

    PREPARING = "preparing"
    ISSUING = "issuing"
    IN_FORCE = "in force"
    GIVEN_UP = "given up"


def estate_of(
    state: VehicleState, states: States, gone: Collection[Name] = ()
) -> frozenset[Cell] | None:
    """Return what a vehicle owns for certain, from its state and from those of others.

    A vehicle whose newest deed is not open does not know what it owns: others of the roster may
    have opened their gates. They have if one of them shows it. They never will if somebody has
    promised more and has no such deed, or if all have promised more with closed gates. Where
    somebody will never tell, since it has a newer deed or has left the road, only those cells are
    certain that the vehicle owns either way. While it is under way it may still be in one of the
    others.

    Args:
        state: of the vehicle; it shows an estate.
        states: the newest ones of others, what they show stays true.
        gone: who has left the road.

    Returns:
        None: it cannot be told yet.
    """
    deed = state.deed
    if deed is None or deed.open:
        return frozenset(state.estate)
    before, after = frozenset(deed.before), frozenset(deed.after)
    signs = _signs(state, deed, states, gone)
    if _Sign.OPEN in signs:
        return after
    if _Sign.WITHOUT in signs or signs == {_Sign.CLOSED}:
        return before
    if state.moving or signs.isdisjoint({_Sign.NEWER, _Sign.GONE}):
        return None
    return before & after


def sure_of(state: VehicleState, states: States, gone: Collection[Name] = ()) -> frozenset[Cell]:
    """Return what a vehicle owns for certain, or at least whatever becomes of its newest deed."""
    estate, deed = estate_of(state, states, gone), state.deed
    if estate is not None or deed is None:
        return estate or frozenset()
    return frozenset(deed.before) & frozenset(deed.after)


def partners(state: VehicleState, states: States) -> frozenset[Name]:
    """Return those whose promises would tell what a vehicle owns, where that is not certain."""
    deed = state.deed
    if deed is None or deed.open:
        return frozenset()
    signs = _signs(state, deed, states, ())
    if _Sign.OPEN in signs or _Sign.WITHOUT in signs or signs == {_Sign.CLOSED}:
        return frozenset()
    return frozenset(name for name in deed.roster if name in states)


class _Sign(Enum):
    """What somebody shows of the start gate of a deed's plan; all but the last one for ever."""

    OPEN = "it is open"
    CLOSED = "it has promised more with a closed gate"
    WITHOUT = "it has promised more, and has never had the deed"
    NEWER = "it has a newer deed"
    GONE = "it has left the road"
    NONE = "nothing"


def _signs(state: VehicleState, deed: Deed, states: States, gone: Collection[Name]) -> set[_Sign]:
    others = [name for name in deed.roster if name != state.vehicle]
    signs = {_sign(states.get(name), deed) for name in others if name not in gone}
    if any(name in gone for name in others):
        signs.add(_Sign.GONE)
    return signs | {_sign(state, deed)}


def _sign(state: VehicleState | None, deed: Deed) -> _Sign:
    if state is None:
        return _Sign.NONE
    theirs = state.deed
    if theirs is not None and theirs.ballot > deed.ballot:
        return _Sign.NEWER
    known = theirs is not None and theirs.ballot == deed.ballot
    if known and theirs is not None and theirs.open:
        return _Sign.OPEN
    if state.promised is None or state.promised <= deed.ballot or not state.estate:
        return _Sign.NONE
    return _Sign.CLOSED if known else _Sign.WITHOUT


@define
class Handover:
    """A leader's state of one ballot."""

    ballot: Ballot
    roster: tuple[Name, ...]
    moves: Moves
    t0_s: float
    """When the moves begin."""
    slot_s: float
    resend_s: float
    due_s: float
    """When something is to be sent, again (node clock)."""
    gone: frozenset[Name] = frozenset()
    """Who has left the road, of those that members share deeds with."""
    phase: Phase = Phase.PREPARING
    promises: dict[Name, VehicleState] = field(factory=dict)
    accepted: set[Name] = field(factory=set)
    plan: Plan | None = None
    why: str = ""
    """Why it was given up."""

    def on_state(self, state: VehicleState, states: States) -> None:
        """Take a newer state of a member; `states` has the newest one of everybody."""
        name = state.vehicle
        if self.phase not in (Phase.PREPARING, Phase.ISSUING):
            return
        promise = self.promises.get(name)
        if state.promised is not None and state.promised > self.ballot:
            self.give_up("outbid")
        elif promise is not None and state.incarnation != promise.incarnation:
            self.give_up(f"{name} has restarted")
        elif state.promised != self.ballot:
            return
        elif self.phase is Phase.PREPARING and not state.accepted and state.estate:
            self.promises[name] = state
            if len(self.promises) == len(self.roster):
                self._issue(states)
        elif self.phase is Phase.ISSUING and state.accepted:
            self.accepted.add(name)
            if len(self.accepted) == len(self.roster):
                self.phase = Phase.IN_FORCE

    def give_up(self, why: str) -> None:
        """Send nothing more; what has come into force, or was given up before, stays so."""
        if self.wakeup_s is not None:
            self.phase, self.why = Phase.GIVEN_UP, why

    def outgoing(self, now_s: float) -> Iterable[tuple[Name, Prepare | Plan]]:
        """Return what has to be sent (again) now, and to whom."""
        if now_s < self.due_s:
            return []
        if self.phase is Phase.PREPARING:
            self.due_s = now_s + self.resend_s
            message = Prepare(self.ballot, (), self.roster)
            return [(name, message) for name in self.roster if name not in self.promises]
        if self.phase is Phase.ISSUING and self.plan is not None:
            self.due_s = now_s + self.resend_s
            return [(name, self.plan) for name in self.roster if name not in self.accepted]
        return []

    @property
    def wakeup_s(self) -> float | None:
        """When `outgoing` has something to send."""
        return self.due_s if self.phase in (Phase.PREPARING, Phase.ISSUING) else None

    def _issue(self, states: States) -> None:
        """Make the plan from the promises, if it still can be made."""
        before: dict[Name, frozenset[Cell]] = {}
        for name, promise in self.promises.items():
            estate = estate_of(promise, dict(states) | self.promises, self.gone)
            if estate is None:
                self.give_up(f"nobody can tell what {name} owns")
                return
            before[name] = estate
        for name, (origin, _) in self.moves.items():
            promise = self.promises[name]
            if promise.hold_cell != origin or not promise.attended:
                self.give_up(f"{name} is not where it was planned from")
                return
        plan = self._plan(before)
        problems = [*plan_problems(plan), *estate_problems(plan)]
        if problems:
            self.give_up("; ".join(problems))
            return
        self.plan, self.phase = plan, Phase.ISSUING
        self.due_s = 0.0

    def _plan(self, before: Mapping[Name, frozenset[Cell]]) -> Plan:
        needed = {name: footprint(*move) for name, move in self.moves.items()}
        given = {cell for cells in needed.values() for cell in cells}
        after = {name: (cells - given) | needed.get(name, set()) for name, cells in before.items()}
        moves: dict[Name, tuple[PlannedMove, ...]] = dict.fromkeys(self.roster, ())
        moves |= {name: ((0, *move),) for name, move in self.moves.items()}
        start_cells = {name: self.promises[name].hold_cell for name in self.roster}
        return Plan(
            ballot=self.ballot,
            formations=tuple(sorted({promise.formation for promise in self.promises.values()})),
            roster=self.roster,
            incarnations={name: self.promises[name].incarnation for name in self.roster},
            start_cells=start_cells,
            moves=moves,
            t0_s=self.t0_s,
            slot_s=self.slot_s,
            territory=tuple(
                sorted(
                    territory(
                        start_cells.values(), [move for each in moves.values() for move in each]
                    )
                )
            ),
            before={name: tuple(sorted(before[name])) for name in self.roster},
            after={name: tuple(sorted(after[name])) for name in self.roster},
        )
