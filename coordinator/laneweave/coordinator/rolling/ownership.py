"""What each vehicle owns in the rolling operation, as far as a leader can tell from states.

A plan gives every vehicle of its roster a *pending transfer*: it owns the cells `before` until it
knows that the start gate is open, then `after`. A vehicle whose own gate is closed does not know
which of the two holds, since others of the roster may have opened theirs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from enum import Enum

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Name, PendingTransfer, VehicleState

States = Mapping[Name, VehicleState]


def owned_cells(
    state: VehicleState, states: States, gone: Collection[Name] = ()
) -> frozenset[Cell] | None:
    """Return the cells that a vehicle owns, from its state and from those of others.

    The gate of its pending transfer is open if a vehicle of the roster shows it. It never opens if
    one has promised more without ever having had the transfer, or if all have promised more with
    closed gates. Where a vehicle will never tell, since it has a newer transfer or has left the
    road, only those cells are certain that the vehicle owns either way. While it moves it may still
    be in one of the others.

    Args:
        state: of the vehicle; it shows cells that it owns.
        states: the newest ones of others; what they show stays true.
        gone: vehicles that have left the road.

    Returns:
        None: it cannot be told yet.
    """
    transfer = state.transfer
    if transfer is None or transfer.open:
        return frozenset(state.owned)
    before, after = frozenset(transfer.before), frozenset(transfer.after)
    signs = _signs(state, transfer, states, gone)
    if _Sign.OPEN in signs:
        return after
    if _Sign.WITHOUT in signs or signs == {_Sign.CLOSED}:
        return before
    if state.moving or signs.isdisjoint({_Sign.NEWER, _Sign.GONE}):
        return None
    return before & after


def certain_cells(
    state: VehicleState, states: States, gone: Collection[Name] = ()
) -> frozenset[Cell]:
    """Return the cells that a vehicle owns whichever way its pending transfer resolves."""
    owned, transfer = owned_cells(state, states, gone), state.transfer
    if owned is not None or transfer is None:
        return owned or frozenset()
    return frozenset(transfer.before) & frozenset(transfer.after)


def partners(state: VehicleState, states: States) -> frozenset[Name]:
    """Return the vehicles whose promises would tell what a vehicle owns; none if that is known."""
    transfer = state.transfer
    if transfer is None or transfer.open:
        return frozenset()
    signs = _signs(state, transfer, states, ())
    if _Sign.OPEN in signs or _Sign.WITHOUT in signs or signs == {_Sign.CLOSED}:
        return frozenset()
    return frozenset(name for name in transfer.roster if name in states)


class _Sign(Enum):
    """What a vehicle shows of the start gate of a transfer's plan; all but `NONE` stay true."""

    OPEN = "it is open"
    CLOSED = "it has promised more with a closed gate"
    WITHOUT = "it has promised more, and has never had the transfer"
    NEWER = "it has a newer transfer"
    GONE = "it has left the road"
    NONE = "nothing"


def _signs(
    state: VehicleState, transfer: PendingTransfer, states: States, gone: Collection[Name]
) -> set[_Sign]:
    others = [name for name in transfer.roster if name != state.vehicle]
    signs = {_sign(states.get(name), transfer) for name in others if name not in gone}
    if any(name in gone for name in others):
        signs.add(_Sign.GONE)
    return signs | {_sign(state, transfer)}


def _sign(state: VehicleState | None, transfer: PendingTransfer) -> _Sign:
    if state is None:
        return _Sign.NONE
    theirs = state.transfer
    if theirs is not None and theirs.ballot > transfer.ballot:
        return _Sign.NEWER
    known = theirs is not None and theirs.ballot == transfer.ballot
    if known and theirs is not None and theirs.open:
        return _Sign.OPEN
    if state.promised is None or state.promised <= transfer.ballot or not state.owned:
        return _Sign.NONE
    return _Sign.CLOSED if known else _Sign.WITHOUT
