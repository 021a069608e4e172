"""States and census as known to a leader now and one tick ago.

Each plan is made from the states at one road time, so it does not depend on message delays. That
time is at most one tick ago, so the two newest states of each vehicle suffice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

from attrs import frozen

from laneweave.coordinator.ballots.ballot_round import age
from laneweave.protocol.wire.messages import Census, Name, VehicleState
from laneweave.protocol.wire.newest import Newest

_Message = TypeVar("_Message", Census, VehicleState)


@frozen
class Snapshot:
    """Census and states at one road time."""

    census: Census
    states: Mapping[Name, VehicleState]
    """States of the vehicles on the road; vehicles without a state are missing."""
    gone: frozenset[Name]
    """Departed vehicles that are in rosters of pending transfers."""


class ObservedRoad:
    """The newest and the previous states and census."""

    def __init__(self) -> None:
        """Begin without states or census."""
        self.states: dict[Name, VehicleState] = {}
        """The newest state of each vehicle on the road."""
        self._ages: dict[Name, Newest] = {}
        """`age` of each of these states."""
        self.census: Census | None = None
        """The newest census."""
        self._before: dict[Name, VehicleState] = {}
        """Newest earlier state of each vehicle."""
        self._left: dict[Name, VehicleState] = {}
        """Newest state of each vehicle that has left since the last snapshot."""
        self._census_before: Census | None = None

    def forget(self) -> None:
        """Discard everything: the road is new."""
        self.states.clear()
        self._ages.clear()
        self.take_over()

    def take_over(self) -> None:
        """Discard positions; what states report about transfers stays true."""
        self._before.clear()
        self._left.clear()
        self.census = self._census_before = None

    def on_census(self, census: Census) -> list[Name]:
        """Handle a newer census; return the vehicles that have left the road."""
        if self.census is not None and census.t_s > self.census.t_s:
            self._census_before = self.census
        self.census = census
        listed = {entry.vehicle for entry in census.on_lattice}
        gone = [name for name in self.states if name not in listed]
        for name in gone:
            self._left[name] = self.states.pop(name)
            del self._ages[name]
        return gone

    def on_state(self, state: VehicleState, now_s: float) -> bool:
        """Handle the state of a vehicle; return whether it is the newest."""
        name = state.vehicle
        known = self.states.get(name)
        if not self._ages.setdefault(name, Newest()).take(age(state), now_s):
            if known is not None and state.t_s < known.t_s:
                self._keep_before(state)
            return False
        if known is not None and _is_older(state, known):
            self._before.pop(name, None)  # no longer shown either
        elif known is not None and state.t_s > known.t_s:
            self._keep_before(known)
        self.states[name] = state
        return True

    @property
    def gone(self) -> frozenset[Name]:
        """Departed vehicles that are in rosters of pending transfers."""
        return _gone(self.states.values(), self.census)

    def at(self, t_s: float) -> Snapshot:
        """Return the snapshot at a road time [s], and discard vehicles that have left.

        Raises:
            ValueError: no census has been received.
        """
        census = _at(t_s, self.census, self._census_before) or self.census
        if census is None:
            raise ValueError("no census yet")
        states = {
            entry.vehicle: state
            for entry in census.on_lattice
            if (state := self._state_at(t_s, entry.vehicle)) is not None
        }
        for name in self._left:
            self._before.pop(name, None)
        self._left.clear()
        return Snapshot(census, states, _gone(states.values(), census))

    def _state_at(self, t_s: float, name: Name) -> VehicleState | None:
        newest = self.states.get(name) or self._left.get(name)
        return _at(t_s, newest, self._before.get(name))

    def _keep_before(self, state: VehicleState) -> None:
        before = self._before.get(state.vehicle)
        if before is None or _is_older(before, state):
            self._before[state.vehicle] = state


def _is_older(state: VehicleState, other: VehicleState) -> bool:
    """Return whether a state was sent earlier than another one of the same vehicle."""
    if state.record.incarnation == other.record.incarnation and state.t_s != other.t_s:
        return state.t_s < other.t_s  # as `age`, which takes longer
    return age(state) < age(other)


def _at(t_s: float, newest: _Message | None, before: _Message | None) -> _Message | None:
    """Return the message that was the newest at a road time, or None if there was none."""
    return newest if newest is not None and newest.t_s <= t_s else before


def _gone(states: Iterable[VehicleState], census: Census | None) -> frozenset[Name]:
    listed = {entry.vehicle for entry in census.on_lattice} if census else set[Name]()
    transfers = [state.record.transfer for state in states if state.record.transfer is not None]
    return frozenset(
        name for transfer in transfers for name in transfer.roster if name not in listed
    )
