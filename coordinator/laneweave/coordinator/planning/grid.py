"""The bounded part of the lattice on which one formation is planned, and the moves on it.

A cell is `(column, lane)`, both counted from 0; columns grow forwards, lanes to the left. In one
step (duration T_F) a vehicle stays in its cell or moves to a neighbouring one: four neighbours in
relative motion mode 1, eight in mode 2.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from typing import Literal

import attrs

Cell = tuple[int, int]
Move = tuple[Cell, Cell]
"""From-cell and to-cell of one step; both are equal when the vehicle waits."""

Mode = Literal[1, 2]

WAIT: Cell = (0, 0)
STRAIGHT: tuple[Cell, ...] = ((1, 0), (-1, 0), (0, 1), (0, -1))
OBLIQUE: tuple[Cell, ...] = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def displacements(mode: Mode) -> tuple[Cell, ...]:
    """Return what a vehicle may do in one step; the order is the order in which ties are broken.

    Waiting comes first, then straight moves, then oblique ones, so that among equally good paths
    the one with the lowest index is also the plainest.
    """
    return (WAIT, *STRAIGHT) if mode == 1 else (WAIT, *STRAIGHT, *OBLIQUE)


def _as_cells(cells: Iterable[Cell]) -> frozenset[Cell]:
    return frozenset(cells)


@attrs.frozen
class Grid:
    """A block of `columns` x `lanes` cells, some of which may be blocked."""

    columns: int
    lanes: int
    blocked: frozenset[Cell] = attrs.field(default=frozenset(), converter=_as_cells)

    def contains(self, cell: Cell) -> bool:
        """Tell whether the cell lies within the block, blocked or not."""
        return 0 <= cell[0] < self.columns and 0 <= cell[1] < self.lanes

    def is_free(self, cell: Cell) -> bool:
        """Tell whether a vehicle may ever be in this cell."""
        return self.contains(cell) and cell not in self.blocked

    def cells(self) -> Iterator[Cell]:
        """Yield the free cells, column by column."""
        for column in range(self.columns):
            for lane in range(self.lanes):
                if (column, lane) not in self.blocked:
                    yield column, lane

    def neighbours(self, cell: Cell, mode: Mode) -> list[Cell]:
        """Return the cells in which a vehicle may be one step later, its own cell first."""
        reached = ((cell[0] + d[0], cell[1] + d[1]) for d in displacements(mode))
        return [other for other in reached if self.is_free(other)]

    def distances(self, origin: Cell, mode: Mode, wanted: Collection[Cell]) -> dict[Cell, int]:
        """Return the least number of steps from `origin` to those wanted cells it can reach."""
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
