"""Storage of a vehicle's record: what its motion controller keeps for the process in charge.

The rules by which the record changes (docs/PROTOCOL.md, V2 and V3; docs/SAFETY.md on owned cells).
Requests that are repeated, late, or from an earlier process in charge change nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

from attrs import define
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.territory import Territory
from laneweave.protocol.wire.bounds import MAX_COLUMN, blocks_in_range
from laneweave.protocol.wire.messages import Ballot, PendingTransfer, VehicleRecord

MAX_CELLS = 2000
"""Maximum number of cells, vehicles or blocks in a record; plans need far fewer."""


@define
class RecordStore:
    """The record of one vehicle, and the cells that only the roadside and the controller know."""

    record: VehicleRecord
    territory: Territory
    lanes: int
    """Number of lanes of the road."""
    _granted: frozenset[Cell] = frozenset()
    """Cells assigned by the roadside that are not part of any plan yet."""
    _given_up: frozenset[Cell] = frozenset()
    """Cells that the vehicle may have owned when it left the lattice."""

    def put_in_charge(self, incarnation: int) -> None:
        """Put another process in charge.

        Raises:
            ValueError: the incarnation is not higher than that of the process in charge.
        """
        if incarnation <= self.record.incarnation:
            raise ValueError(f"incarnation {incarnation} is not above {self.record.incarnation}")
        self.record = replace(self.record, incarnation=incarnation, accepted=None)

    def store(self, wanted: VehicleRecord) -> bool:
        """Store what the process in charge requests; return whether anything has changed."""
        before = self.record
        if wanted.incarnation != before.incarnation or not blocks_in_range(wanted.joined):
            return False
        if wanted == replace(before, owned=wanted.owned):
            return False  # the usual case
        self.join(wanted.joined)
        if wanted.transfer is not None and wanted.transfer.open:
            self.complete_transfer(wanted.transfer.ballot)
        if wanted.promised is not None:
            self.store_promise(wanted.promised)
        if wanted.transfer is not None and not wanted.transfer.open:
            self.begin_transfer(wanted.transfer)
        if wanted.accepted is not None:
            self.store_acceptance(wanted.accepted)
        return replace(self.record, owned=before.owned) != before

    def join(self, blocks: Iterable[int]) -> None:
        """Add joined blocks, unless they are too many for a record."""
        joined = tuple(sorted({*self.record.joined, *blocks}))
        if len(joined) > MAX_CELLS:
            return
        self.record = replace(self.record, joined=joined)

    def store_promise(self, ballot: Ballot) -> None:
        """Store a promise unless a newer one is stored."""
        promised = self.record.promised
        newest = ballot if promised is None else max(promised, ballot)
        self.record = replace(self.record, promised=newest)

    def store_acceptance(self, ballot: Ballot) -> None:
        """Store an acceptance by the process in charge unless a newer one is stored."""
        if not self.territory.may_accept(self.record, ballot):
            return
        accepted = self.record.accepted
        newest = ballot if accepted is None else max(accepted, ballot)
        self.record = replace(self.record, accepted=newest)

    def begin_transfer(self, transfer: PendingTransfer) -> None:
        """Store the pending transfer of an accepted plan unless a higher ballot is promised.

        The vehicle keeps cells that the roadside has assigned since the plan was made.
        """
        stored, promised = self.record.transfer, self.record.promised
        newer = stored is None or transfer.ballot > stored.ballot
        if (
            newer
            and self._is_possible(transfer)
            and promised is not None
            and transfer.ballot >= promised
        ):
            self._granted -= set(transfer.before)
            begun = _with_cells(transfer, self._granted)
            self.record = replace(self.record, transfer=begun, owned=begun.before)

    def _is_possible(self, transfer: PendingTransfer) -> bool:
        """Return whether all cells of a transfer are in lanes, and not too many."""
        cells = (*transfer.before, *transfer.after)
        return max(len(cells), len(transfer.roster)) <= MAX_CELLS and all(
            0 <= lane < self.lanes and abs(column) <= MAX_COLUMN for column, lane in cells
        )

    def complete_transfer(self, ballot: Ballot) -> None:
        """Complete the pending transfer of a plan whose start gate is open."""
        transfer = self.record.transfer
        if transfer is not None and transfer.ballot == ballot and transfer.undecided:
            done = PendingTransfer(ballot, open=True)
            self.record = replace(self.record, owned=transfer.after, transfer=done)

    def assign_cell(self, cell: Cell) -> None:
        """Add an empty cell that the roadside has assigned to the vehicle."""
        self._granted |= {cell}
        transfer = self.record.transfer
        if transfer is not None and transfer.undecided:
            transfer = _with_cells(transfer, {cell})
        owned = tuple(sorted({*self.record.owned, cell}))
        self.record = replace(self.record, owned=owned, transfer=transfer)

    def give_up_cells(self) -> None:
        """Give up all cells, since the vehicle leaves the lattice."""
        self._given_up, self._granted = self.possible_cells, frozenset()
        transfer = self.territory.transfer_of_departed(self.record)
        self.record = replace(self.record, owned=(), accepted=None, transfer=transfer)

    def enter_block(self, block: int, cells: Iterable[Cell]) -> None:
        """Take cells in a block; in formations the vehicle leaves those to which it belonged."""
        self.record = replace(self.record, joined=(block,))
        for cell in self.territory.owned_among(cells):
            self.assign_cell(cell)

    @property
    def certain_cells(self) -> frozenset[Cell]:
        """Cells that the vehicle owns whether or not the gate of its pending transfer opens."""
        transfer = self.record.transfer
        if transfer is None or not transfer.undecided:
            return frozenset(self.record.owned)
        return frozenset(transfer.before) & frozenset(transfer.after)

    @property
    def possible_cells(self) -> frozenset[Cell]:
        """Cells that the vehicle owns if the gate of its pending transfer opens, or if not.

        Cells that it gave up when it left the lattice are included.
        """
        transfer, owned = self.record.transfer, self._given_up | frozenset(self.record.owned)
        if transfer is None or not transfer.undecided:
            return owned
        return owned | frozenset(transfer.before) | frozenset(transfer.after)


def _with_cells(transfer: PendingTransfer, cells: Iterable[Cell]) -> PendingTransfer:
    """Return a transfer with additional cells that the vehicle keeps."""
    return replace(
        transfer,
        before=tuple(sorted({*transfer.before, *cells})),
        after=tuple(sorted({*transfer.after, *cells})),
    )
