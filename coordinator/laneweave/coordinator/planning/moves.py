"""Moves as bits: a set of moves on a grid is one integer.

The planner asks two questions very often: which moves are possible in this step, and with which
of them does this move conflict. With one bit per move both are answered for all moves at once.

Cells are numbered column by column, with two unused lanes between columns so that nothing wraps
around. Each cell owns one bit per displacement: bit `cell_bit + d` is the move from that cell with
displacement `d`, and bit `cell_bit` itself (d = 0) is waiting there. A set of *cells* uses the
bits of their waits. The order of bits is the order in which ties are broken.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Final

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Cell, Grid, Mode, Move, displacements

Offsets = tuple[tuple[int, int, int], ...]
"""Column and lane from A's cell to B's cell, and the displacement of B."""

_REMEMBER_BELOW_BITS: Final = 1 << 15
"""On larger grids conflict sets are computed again instead of being kept."""


def bits(mask: int) -> Iterator[int]:
    """Yield the numbers of the bits that are set, lowest first."""
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low


@lru_cache(maxsize=64)
def conflict_offsets(
    mode: Mode, model: ConflictModel
) -> tuple[tuple[tuple[int, int, int], ...], ...]:
    """Return, per displacement of A, the offsets and displacements of B that conflict with it.

    Conflicts do not depend on where on the lattice they happen, so one table serves all grids.
    """
    steps = displacements(mode)
    columns, lanes = (range(-reach, reach + 1) for reach in model.reach)

    def conflicting(d: int) -> Iterator[tuple[int, int, int]]:
        a: Move = ((0, 0), steps[d])
        for column in columns:
            for lane in lanes:
                for e, step in enumerate(steps):
                    b: Move = ((column, lane), (column + step[0], lane + step[1]))
                    if model.kind(a, b) is not None:
                        yield column, lane, e

    return tuple(tuple(conflicting(d)) for d in range(len(steps)))


class MoveTable:
    """The numbering of moves on one grid, and the sets that follow from it."""

    def __init__(self, grid: Grid, mode: Mode, model: ConflictModel) -> None:
        """Number the moves and lay the conflict relation out as bit patterns."""
        self.grid = grid
        self.mode = mode
        self.model = model
        self.steps = displacements(mode)
        self.fan = len(self.steps)
        self.width = grid.lanes + model.reach[1]
        self.every = (1 << self.fan) - 1
        self.shifts = tuple((c * self.width + lane) * self.fan for c, lane in self.steps)
        self.cells = self._free_cells()
        self.valid = 0
        for d, shift in enumerate(self.shifts):
            landing = self.cells >> shift if shift >= 0 else self.cells << -shift
            self.valid |= (self.cells & landing) << d
        self.cell_count = self.cells.bit_count()
        self.conflicts = _ConflictSets(self)

    def _free_cells(self) -> int:
        lane_bits = ((1 << (self.grid.lanes * self.fan)) - 1) // self.every
        column_size = self.width * self.fan
        columns = ((1 << (self.grid.columns * column_size)) - 1) // ((1 << column_size) - 1)
        free = lane_bits * columns
        for cell in self.grid.blocked:
            free ^= 1 << self.bit(cell)
        return free

    def bit(self, cell: Cell) -> int:
        """Return the bit of a cell, which is also the bit of waiting in it."""
        return (cell[0] * self.width + cell[1]) * self.fan

    def cell(self, bit: int) -> Cell:
        """Return the cell in which the move starts."""
        return divmod(bit // self.fan, self.width)

    def move(self, bit: int) -> Move:
        """Return the move as two cells."""
        column, lane = self.cell(bit)
        step = self.steps[bit % self.fan]
        return (column, lane), (column + step[0], lane + step[1])

    def number(self, move: Move) -> int:
        """Return the bit of a move given as two cells."""
        (column, lane), (to_column, to_lane) = move
        return self.bit(move[0]) + self.steps.index((to_column - column, to_lane - lane))

    def landing(self, bit: int) -> int:
        """Return the bit of the cell in which the move ends."""
        d = bit % self.fan
        return bit - d + self.shifts[d]

    def starting_in(self, cells: int) -> int:
        """Return all moves that start in one of the cells."""
        return (cells * self.every) & self.valid

    def leading_to(self, cells: int) -> int:
        """Return all moves that end in one of the cells."""
        moves = 0
        for d, shift in enumerate(self.shifts):
            up = d - shift
            moves |= cells << up if up >= 0 else cells >> -up
        return moves & self.valid

    def starts(self, moves: int) -> int:
        """Return the cells in which the moves start."""
        cells = moves | moves >> 1
        cells |= cells >> 2
        if self.fan > 5:
            cells |= cells >> 4
        return (cells | moves >> (self.fan - 1)) & self.cells

    def ends(self, moves: int) -> int:
        """Return the cells in which the moves end."""
        lattice = self.cells
        cells = moves & lattice
        for d, shift in enumerate(self.shifts):
            part = (moves >> d) & lattice
            cells |= part << shift if shift >= 0 else part >> -shift
        return cells

    def common_conflicts(self, moves: int) -> int:
        """Return the moves that conflict with every one of the given moves."""
        common = self.valid
        conflicts = self.conflicts
        while moves and common:
            low = moves & -moves
            common &= conflicts[low.bit_length() - 1]
            moves ^= low
        return common


class _ConflictSets(dict[int, int]):
    """For each move, the set of moves that conflict with it; filled in when first asked for."""

    def __init__(self, table: MoveTable) -> None:
        super().__init__()
        columns, lanes = table.model.reach
        self._base = columns * table.width + lanes
        self._fan = table.fan
        self._valid = table.valid
        self._patterns = tuple(
            sum(
                1 << ((c * table.width + lane + self._base) * table.fan + e)
                for c, lane, e in offsets
            )
            for offsets in conflict_offsets(table.mode, table.model)
        )
        self._remember = table.valid.bit_length() <= _REMEMBER_BELOW_BITS

    def __missing__(self, bit: int) -> int:
        cell, d = divmod(bit, self._fan)
        up = (cell - self._base) * self._fan
        pattern = self._patterns[d]
        found = (pattern << up if up >= 0 else pattern >> -up) & self._valid
        if self._remember:
            self[bit] = found
        return found
