"""Cell ownership in a simulated run of the rolling operation; part of the checker.

It reads the motion controllers. A vehicle whose newest transfer is pending does not know what it
owns, but the checker does: the result of the transfer if any vehicle of its roster has taken
possession, otherwise the cells before it. Therefore the checker always expects at most one owner
per cell. (An agent that opens its gate and ends before its controller knows of it has not moved,
and no cell has been transferred.)
"""

from __future__ import annotations

from collections.abc import Callable

from attrs import frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Deed

Cells = frozenset[Cell]
Report = Callable[[str, float, list[str], str], None]
"""Receives a violation: kind, virtual time, vehicles, text."""


@frozen
class Holding:
    """Owned cells and newest transfer of one vehicle, as its motion controller shows them."""

    cells: Cells
    transfer: Deed | None

    def owned(self, opened: set[Ballot]) -> Cells:
        """Return the owned cells, given the ballots under which possession has been taken."""
        transfer = self.transfer
        if transfer is None or transfer.open or transfer.ballot not in opened:
            return self.cells
        return frozenset(transfer.after)


class CellOwnership:
    """Checks the ownership of all cells of a run."""

    def __init__(self, report: Report) -> None:
        """Start without vehicles; `report` receives the violations."""
        self._report = report
        self._holdings: dict[str, Holding] = {}
        self._owner: dict[Cell, str] = {}
        self._owned: dict[str, Cells] = {}
        """Owned cells of each vehicle; the inverse of `_owner`."""
        self._opened: set[Ballot] = set()
        """Ballots under which a vehicle has taken possession."""
        self._bodies: dict[str, Cells] = {}
        """Cells occupied by each body."""

    def show(
        self,
        t_s: float,
        vehicle: str,
        cells: tuple[Cell, ...],
        transfer: Deed | None,
        body: Cells | None = None,
    ) -> None:
        """Update what a motion controller shows.

        Args:
            t_s: virtual time.
            vehicle: name of the vehicle.
            cells: its owned cells.
            transfer: its newest transfer.
            body: cells that its body occupies from now on; None: unchanged.
        """
        known = self._holdings.get(vehicle)
        holding = Holding(frozenset(cells), transfer)
        if body is not None:
            self._bodies[vehicle] = body
        elif known == holding:
            return
        self._holdings[vehicle] = holding
        changed = [vehicle]
        if transfer is not None and transfer.open and transfer.ballot not in self._opened:
            self._opened.add(transfer.ballot)
            changed += [
                name
                for name, other in self._holdings.items()
                if name != vehicle and other.transfer and other.transfer.ballot == transfer.ballot
            ]
        self._update_owners(t_s, changed)

    def occupy(self, t_s: float, vehicle: str, cells: Cells) -> None:
        """Update the cells that a body occupies."""
        self._bodies[vehicle] = cells
        self._check_body(t_s, vehicle)

    def move(self, t_s: float, vehicle: str, ballot: Ballot) -> None:
        """Check the start of a motion under a ballot."""
        if ballot not in self._opened:
            self._report("gate", t_s, [vehicle], "moves, but no vehicle has taken possession")

    def leave(self, vehicle: str) -> None:
        """Remove a vehicle that has left the road, and free its cells."""
        self._holdings.pop(vehicle, None)
        self._bodies.pop(vehicle, None)
        self._free(vehicle)

    def _free(self, vehicle: str) -> None:
        for cell in self._owned.pop(vehicle, frozenset()):
            if self._owner.get(cell) == vehicle:
                del self._owner[cell]

    def _update_owners(self, t_s: float, vehicles: list[str]) -> None:
        for vehicle in vehicles:
            self._free(vehicle)
        for vehicle in vehicles:
            owned = self._holdings[vehicle].owned(self._opened)
            self._owned[vehicle] = owned
            for cell in sorted(owned):
                other = self._owner.setdefault(cell, vehicle)
                if other != vehicle:
                    self._report("owner", t_s, [vehicle, other], f"both own {cell}")
            self._check_body(t_s, vehicle)

    def _check_body(self, t_s: float, vehicle: str) -> None:
        body = self._bodies.get(vehicle)
        holding = self._holdings.get(vehicle)
        if body is None or holding is None:
            return
        foreign = body - (holding.cells & self._owned[vehicle])
        if foreign:
            text = f"its body is in {sorted(foreign)}, which it does not own"
            self._report("trespass", t_s, [vehicle], text)
