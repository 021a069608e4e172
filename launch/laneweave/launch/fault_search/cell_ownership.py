"""Who owns which cells in a simulated run of the rolling operation; part of the checker.

It looks into the motion controllers. Whose newest deed is not open may not know what it owns; the
checker does: what the deed gives if anybody in its roster has taken possession, else what was
before. So for the checker a cell has one owner at most, always. (An agent may have opened its gate
and died before its controller knew: nobody has moved then, and nothing has changed hands.)
"""

from __future__ import annotations

from collections.abc import Callable

from attrs import frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Deed

Cells = frozenset[Cell]
Tell = Callable[[str, float, list[str], str], None]
"""Reports a violation: kind, virtual time, vehicles, text."""


@frozen
class Holding:
    """What a motion controller says that its vehicle owns."""

    estate: Cells
    deed: Deed | None

    def certain(self, opened: set[Ballot]) -> Cells:
        """Return what the vehicle owns, for somebody who knows who has taken possession."""
        deed = self.deed
        if deed is None or deed.open:
            return self.estate
        return frozenset(deed.after) if deed.ballot in opened else self.estate


class Estates:
    """All holdings of a run; `tell` is told of what must not be."""

    def __init__(self, tell: Tell) -> None:
        """Begin without vehicles."""
        self._tell = tell
        self._holdings: dict[str, Holding] = {}
        self._owner: dict[Cell, str] = {}
        self._owned: dict[str, Cells] = {}
        """What each vehicle owns; the inverse of `_owner`."""
        self._opened: set[Ballot] = set()
        """Ballots of which somebody has taken possession."""
        self._bodies: dict[str, Cells] = {}
        """Cells that each body occupies."""

    def show(
        self,
        t_s: float,
        vehicle: str,
        estate: tuple[Cell, ...],
        deed: Deed | None,
        body: Cells | None = None,
    ) -> None:
        """A motion controller shows what its vehicle owns.

        Args:
            t_s: virtual time.
            vehicle: which.
            estate: its cells.
            deed: its newest deed.
            body: the cells that its body occupies from now on, where that changes, too.
        """
        known = self._holdings.get(vehicle)
        if body is not None:
            self._bodies[vehicle] = body
        elif known is not None and known.deed == deed and known.estate == frozenset(estate):
            return
        self._holdings[vehicle] = Holding(frozenset(estate), deed)
        concerned = [vehicle]
        if deed is not None and deed.open and deed.ballot not in self._opened:
            self._opened.add(deed.ballot)
            concerned += [
                name
                for name, holding in self._holdings.items()
                if name != vehicle and holding.deed and holding.deed.ballot == deed.ballot
            ]
        self._settle(t_s, concerned)

    def occupy(self, t_s: float, vehicle: str, cells: Cells) -> None:
        """A body occupies other cells than before."""
        self._bodies[vehicle] = cells
        self._check_body(t_s, vehicle)

    def move(self, t_s: float, vehicle: str, ballot: Ballot) -> None:
        """A body begins a motion of a plan."""
        if ballot not in self._opened:
            self._tell("gate", t_s, [vehicle], "moves, and nobody has taken possession")

    def leave(self, vehicle: str) -> None:
        """A vehicle left the road, and its cells are nobody's."""
        self._holdings.pop(vehicle, None)
        self._bodies.pop(vehicle, None)
        for cell in self._owned.pop(vehicle, frozenset()):
            if self._owner.get(cell) == vehicle:
                del self._owner[cell]

    def _settle(self, t_s: float, vehicles: list[str]) -> None:
        """Look what some vehicles own now: nobody else may own it."""
        for vehicle in vehicles:
            for cell in self._owned.pop(vehicle, frozenset()):
                if self._owner.get(cell) == vehicle:
                    del self._owner[cell]
        for vehicle in vehicles:
            owned = self._holdings[vehicle].certain(self._opened)
            self._owned[vehicle] = owned
            for cell in sorted(owned):
                other = self._owner.setdefault(cell, vehicle)
                if other != vehicle:
                    self._tell("owner", t_s, [vehicle, other], f"both own {cell}")
            self._check_body(t_s, vehicle)

    def _check_body(self, t_s: float, vehicle: str) -> None:
        body = self._bodies.get(vehicle)
        holding = self._holdings.get(vehicle)
        if body is None or holding is None:
            return
        foreign = body - (holding.estate & self._owned[vehicle])
        if foreign:
            text = f"its body is in {sorted(foreign)}, and it does not own that"
            self._tell("trespass", t_s, [vehicle], text)
