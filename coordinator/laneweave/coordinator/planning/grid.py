"""The bounded part of the lattice on which one formation is planned.

A cell is `(column, lane)`, both counted from 0; columns grow forwards, lanes to the left.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable

import attrs

from laneweave.protocol.lattice import Cell, Mode, displacements


def _as_cells(cells: Iterable[Cell]) -> frozenset[Cell]:
    return frozenset(cells)


@attrs.frozen
class Grid:
    """A block of `columns` x `lanes` cells, some of which may be blocked."""

    columns: int
    lanes: int
    blocked: frozenset[Cell] = attrs.field(default=frozenset(), converter=_as_cells)

    def contains(self, cell: Cell) -> bool:
        """Return whether the cell lies within the block, blocked or not."""
        return 0 <= cell[0] < self.columns and 0 <= cell[1] < self.lanes

    def is_free(self, cell: Cell) -> bool:
        """Return whether a vehicle may be in this cell."""
        return self.contains(cell) and cell not in self.blocked

    def neighbours(self, cell: Cell, mode: Mode) -> list[Cell]:
        """Return the cells in which a vehicle may be one step later, its own cell first."""
        reached = ((cell[0] + d[0], cell[1] + d[1]) for d in displacements(mode))
        return [other for other in reached if self.is_free(other)]

    def distances(self, origin: Cell, mode: Mode, wanted: Collection[Cell]) -> dict[Cell, int]:
        """Return the minimum number of steps from `origin` to each reachable cell of `wanted`."""
        found = {origin: 0}
        missing = set(wanted) - {origin}
        frontier = deque([origin])
        while frontier and missing:
            cell = frontier.popleft()
            for other in self.neighbours(cell, mode):
                if other not in found:
                    found[other] = found[cell] + 1
                    missing.discard(other)
                    frontier.append(other)
        return {cell: found[cell] for cell in wanted if cell in found}
