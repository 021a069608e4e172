"""Cells that vehicles own in the rolling operation, derived from their states.

A plan gives every vehicle of its roster a *pending transfer*: the vehicle owns the cells `before`
until it knows that the start gate is open, and the cells `after` from then on. A vehicle with a
closed gate cannot determine alone which of the two applies, since others may have opened theirs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from enum import Enum

from attrs import define, field

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Name, PendingTransfer, VehicleState

States = Mapping[Name, VehicleState]


def owned_cells(
    state: VehicleState, states: States, gone: Collection[Name] = ()
) -> frozenset[Cell] | None:
    """Return the cells that a vehicle owns, from its state and the states of others.

    The start gate of its pending transfer is open if any member of the roster reports it open. It
    never opens if any member has promised a higher ballot and was never ready for the plan, or if
    all have promised higher ballots with closed gates. If a member can no longer report the gate,
    because it has a newer transfer or has left the road, only cells in both `before` and `after`
    are certain; while the vehicle moves, no cells are, since it may still be in another one.

    Args:
        state: state of the vehicle, with owned cells.
        states: newest states of all vehicles; what they report about transfers stays true.
        gone: vehicles that have left the road.

    Returns:
        None: not known yet.
    """
    transfer = state.record.transfer
    if transfer is None or not transfer.undecided:
        return frozenset(state.record.owned)
    before, after = frozenset(transfer.before), frozenset(transfer.after)
    signs = _signs(state, transfer, states, gone)
    if _Sign.OPEN in signs:
        return after
    if _Sign.NEVER_READY in signs or signs == {_Sign.CLOSED}:
        return before
    if state.moving or signs.isdisjoint({_Sign.NEWER, _Sign.GONE}):
        return None
    return before & after


def certain_cells(
    state: VehicleState, states: States, gone: Collection[Name] = ()
) -> frozenset[Cell]:
    """Return the cells that a vehicle owns whether or not its pending transfer opens."""
    owned, transfer = owned_cells(state, states, gone), state.record.transfer
    if owned is not None or transfer is None:
        return owned or frozenset()
    return frozenset(transfer.before) & frozenset(transfer.after)


def partners(state: VehicleState, states: States) -> frozenset[Name]:
    """Return the vehicles whose promises determine what a vehicle owns; none if that is known."""
    transfer = state.record.transfer
    if transfer is None or not transfer.undecided:
        return frozenset()
    signs = _signs(state, transfer, states, ())
    if _Sign.OPEN in signs or _Sign.NEVER_READY in signs or signs == {_Sign.CLOSED}:
        return frozenset()
    return frozenset(name for name in transfer.roster if name in states)


@define
class ReplacedBallots:
    """Replaced ballots, and what their members have reported about the start gates.

    The members drop their moves when they promise higher ballots, one by one. What a member has
    reported stays true when it has a newer transfer, so it is kept as long as any vehicle stores a
    transfer of the ballot.
    """

    _shown: dict[Ballot, dict[Name, VehicleState]] = field(factory=dict)
    """States with evidence about a start gate, by ballot and member."""
    _members: dict[Ballot, tuple[Name, ...]] = field(factory=dict)

    def __contains__(self, ballot: Ballot) -> bool:
        """Return whether a ballot has been replaced."""
        return ballot in self._members

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self._members)

    def copy(self) -> ReplacedBallots:
        """Return an independent copy."""
        shown = {ballot: dict(states) for ballot, states in self._shown.items()}
        return ReplacedBallots(shown, dict(self._members))

    def replace(self, ballot: Ballot, members: tuple[Name, ...], states: States) -> None:
        """Add a ballot, with the newest states of all vehicles."""
        self._members[ballot], self._shown[ballot] = members, {}
        for name in members:
            if name in states:
                self.on_state(states[name])

    def keep(self, ballot: Ballot) -> None:
        """Remove a ballot, which stays in force."""
        del self._members[ballot], self._shown[ballot]

    def on_state(self, state: VehicleState) -> None:
        """Note what a newer state of a vehicle shows."""
        for ballot, members in self._members.items():
            if state.vehicle not in members:
                continue
            sign, shown = _sign(state, ballot), self._shown[ballot]
            # One that was never ready says more than that its own gate is closed.
            if sign is _Sign.NEVER_READY or (sign in _LASTING and state.vehicle not in shown):
                shown[state.vehicle] = state

    def to_ask(self, states: States) -> set[Name]:
        """Return the members that have promised no higher ballot: they have not dropped theirs."""
        return {
            name
            for ballot, members in self._members.items()
            for name in members
            if name in states and (states[name].record.promised or ballot) <= ballot
        }

    def forget(self, states: States) -> None:
        """Forget the ballots of which no vehicle stores a transfer."""
        stored = {each.record.transfer.ballot for each in states.values() if each.record.transfer}
        for ballot in [each for each in self._members if each not in stored]:
            del self._members[ballot], self._shown[ballot]

    def owned_cells(
        self, state: VehicleState, states: States, gone: Collection[Name] = ()
    ) -> frozenset[Cell] | None:
        """Return the cells that a vehicle owns; None: not known yet. See `owned_cells`."""
        transfer = state.record.transfer
        if transfer is None or transfer.ballot not in self:
            return owned_cells(state, states, gone)
        shown = self._shown[transfer.ballot]
        left = [name for name in gone if name not in shown]
        return owned_cells(state, {**states, **shown}, left)

    def cells_before(
        self, state: VehicleState, states: States, gone: Collection[Name]
    ) -> frozenset[Cell]:
        """Return the cells that a vehicle owns for certain.

        Of a replaced ballot these are the cells `before` unless its gate is known to be open, since
        it is expected that all members promise higher ballots with closed gates.
        """
        transfer = state.record.transfer
        if transfer is None or transfer.ballot not in self:
            return certain_cells(state, states, gone)
        owned = self.owned_cells(state, states, gone)
        return frozenset(transfer.before) if owned is None else owned


class _Sign(Enum):
    """One vehicle's evidence about the start gate of a transfer; all but `NONE` stays true."""

    OPEN = "the gate is open"
    CLOSED = "the vehicle has promised a higher ballot with a closed gate"
    NEVER_READY = "the vehicle has promised a higher ballot, and was never ready for the plan"
    NEWER = "the vehicle has a newer transfer"
    GONE = "the vehicle has left the road, or the lattice"
    NONE = "no evidence"


_LASTING = (_Sign.OPEN, _Sign.CLOSED, _Sign.NEVER_READY)
"""Evidence that a vehicle no longer reports once it has a newer transfer."""


def _signs(
    state: VehicleState, transfer: PendingTransfer, states: States, gone: Collection[Name]
) -> set[_Sign]:
    others = [name for name in transfer.roster if name != state.vehicle]
    signs = {_sign(states.get(name), transfer.ballot) for name in others if name not in gone}
    if any(name in gone for name in others):
        signs.add(_Sign.GONE)
    return signs | {_sign(state, transfer.ballot)}


def _sign(state: VehicleState | None, ballot: Ballot) -> _Sign:
    if state is None:
        return _Sign.NONE
    theirs = state.record.transfer
    if theirs is not None and theirs.ballot > ballot:
        return _Sign.NEWER
    if theirs is not None and theirs.withdrawn and theirs.ballot == ballot:
        return _Sign.GONE
    if theirs is not None and theirs.ballot < ballot:
        theirs = None  # of an earlier plan
    if theirs is not None and theirs.open:
        return _Sign.OPEN
    if state.record.promised is None or state.record.promised <= ballot or not state.record.owned:
        return _Sign.NONE
    if theirs is None:
        return _Sign.NEVER_READY  # it has not accepted the plan
    # With a closed gate, a vehicle that was ready is still in its start cell, which is in `after`.
    elsewhere = not state.moving and state.hold_cell not in theirs.after
    return _Sign.NEVER_READY if elsewhere else _Sign.CLOSED
