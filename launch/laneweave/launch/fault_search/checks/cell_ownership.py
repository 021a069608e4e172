"""Checks of cell ownership in the rolling operation; part of the checker.

The checks read the motion controllers. A vehicle with a pending transfer does not know its owned
cells, but the checker does: the cells after the transfer if any vehicle of its roster has taken
possession, otherwise the cells before it. Every cell must have at most one owner at any time. If an
agent opens its gate and exits before its controller is informed, its vehicle has not moved, and
no cell has been transferred.
"""

from __future__ import annotations

from attrs import frozen

from laneweave.launch.fault_search.checks.violations import Report, once
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, PendingTransfer

Cells = frozenset[Cell]


@frozen
class Holding:
    """Owned cells and newest transfer of a vehicle, according to its motion controller."""

    cells: Cells
    transfer: PendingTransfer | None

    def owned(self, opened: set[Ballot]) -> Cells:
        """Return the owned cells, given the ballots under which a vehicle has taken possession."""
        transfer = self.transfer
        if transfer is not None and transfer.undecided and transfer.ballot in opened:
            return frozenset(transfer.after)
        return self.cells


class CellOwnership:
    """Checker of cell ownership in a run."""

    def __init__(self, report: Report) -> None:
        """Start without vehicles; `report` is called once for each violation."""
        self._report = once(report)
        self._holdings: dict[str, Holding] = {}
        self._opened: set[Ballot] = set()
        """Ballots under which a vehicle has taken possession."""
        self._bodies: dict[str, Cells] = {}
        """Cells occupied by each body."""

    def update(
        self,
        t_s: float,
        vehicle: str,
        cells: tuple[Cell, ...],
        transfer: PendingTransfer | None,
        body: Cells | None = None,
    ) -> None:
        """Update a vehicle's owned cells and newest transfer and, if given, its body's cells."""
        holding = Holding(frozenset(cells), transfer)
        if body is not None:
            self._bodies[vehicle] = body
        elif self._holdings.get(vehicle) == holding:
            return
        self._holdings[vehicle] = holding
        if transfer is not None and transfer.open:
            self._opened.add(transfer.ballot)
        self._check(t_s)

    def occupy(self, t_s: float, vehicle: str, cells: Cells) -> None:
        """Update the cells that a body occupies."""
        self._bodies[vehicle] = cells
        self._check(t_s)

    def move(self, t_s: float, vehicle: str, ballot: Ballot) -> None:
        """Check that a motion may begin under a ballot."""
        if ballot not in self._opened:
            self._report("gate", t_s, [vehicle], "moves although no vehicle has taken possession")

    def leave(self, vehicle: str) -> None:
        """Remove a vehicle that has left the road, and free its cells."""
        self._holdings.pop(vehicle, None)
        self._bodies.pop(vehicle, None)

    def _check(self, t_s: float) -> None:
        owners: dict[Cell, str] = {}
        for vehicle, holding in self._holdings.items():
            owned = holding.owned(self._opened)
            for cell in owned:
                other = owners.setdefault(cell, vehicle)
                if other != vehicle:
                    self._report("owner", t_s, [vehicle, other], f"both own {cell}")
            foreign = self._bodies.get(vehicle, frozenset()) - (holding.cells & owned)
            if foreign:
                text = f"its body is in {sorted(foreign)}, which it does not own"
                self._report("trespass", t_s, [vehicle], text)
