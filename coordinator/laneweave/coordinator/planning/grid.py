"""The bounded part of the lattice on which one formation is planned."""

from __future__ import annotations

from collections.abc import Iterable

import attrs

from laneweave.protocol.lattice import Cell


def _as_cells(cells: Iterable[Cell]) -> frozenset[Cell]:
    return frozenset(cells)


@attrs.frozen
class Grid:
    """The `columns` x `lanes` cells (column, lane) of one formation; both indices start at 0."""

    columns: int
    lanes: int
    blocked: frozenset[Cell] = attrs.field(default=frozenset(), converter=_as_cells)

    def contains(self, cell: Cell) -> bool:
        """Return whether the cell lies on the grid, blocked or not."""
        return 0 <= cell[0] < self.columns and 0 <= cell[1] < self.lanes

    def is_free(self, cell: Cell) -> bool:
        """Return whether a vehicle may be in this cell."""
        return self.contains(cell) and cell not in self.blocked
