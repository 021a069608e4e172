"""A planning problem in the form that the searches use: moves as bits, starts, targets, paths.

A set of moves is one integer with a bit per move, so that the moves that are possible in a step,
or that conflict with a given move, are found with a few bit operations.

Cells are numbered column by column, with two unused lanes between columns so that nothing wraps
around. Each cell has one bit per displacement: bit `cell_bit + d` is the move from that cell with
displacement `d`, and bit `cell_bit` itself (d = 0) is waiting there. A set of *cells* uses the
bits of their waits. Ties go to the lowest bit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Final

import attrs
import numpy as np

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move, conflict_offsets
from laneweave.coordinator.planning.grid import Grid
from laneweave.protocol.lattice import Cell, Mode, displacements

Path = tuple[int, ...]
"""The moves of one vehicle until its final arrival."""

_SPARSE_CELLS: Final = 20
"""Free cells per vehicle above which conflicts are rare."""
_FEW_VEHICLES: Final = 10
"""Minimum number of vehicles for this threshold, so that small grids do not count as sparse."""
_MAX_LOOPED_BITS: Final = 1 << 10
"""Size in bits above which taking bits off one by one is slow, because each copies the rest."""
_MAX_CACHED_BITS: Final = 1 << 15
"""Size in bits above which conflict sets are not cached."""


def bits(mask: int) -> Iterator[int]:
    """Yield the indices of the set bits, lowest first."""
    if mask.bit_length() > _MAX_LOOPED_BITS:
        octets = np.frombuffer(mask.to_bytes(-(-mask.bit_length() // 8), "little"), np.uint8)
        yield from np.flatnonzero(np.unpackbits(octets, bitorder="little")).tolist()
        return
    while mask:
        low = mask & -mask
        yield low.bit_length() - 1
        mask ^= low


class MoveTable:
    """The numbered moves of one grid, and operations on sets of moves and cells."""

    def __init__(self, grid: Grid, mode: Mode, model: ConflictModel) -> None:
        """Number the moves and store the conflict relation as bit patterns."""
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
        """Return the bit index of a cell and of its wait move."""
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
        """Return the bit index of a move given as two cells."""
        (column, lane), (to_column, to_lane) = move
        return self.bit(move[0]) + self.steps.index((to_column - column, to_lane - lane))

    def landing(self, bit: int) -> int:
        """Return the bit index of the cell in which the move ends."""
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

    def distances(self, cells: int, undrivable: int = 0) -> dict[int, int]:
        """Return the minimum number of steps to each cell from the nearest of these cells.

        Args:
            cells: the cells to start from.
            undrivable: moves that the vehicle cannot drive.
        """
        found: dict[int, int] = {}
        reached, steps = cells, 0
        while cells:
            found.update(dict.fromkeys(bits(cells), steps))
            cells = self.ends(self.starting_in(cells) & ~undrivable) & ~reached
            reached |= cells
            steps += 1
        return found

    def with_displacements(self, displaced: Iterable[int]) -> int:
        """Return all moves with one of these displacements, given by index."""
        return sum(self.cells << d for d in displaced) & self.valid

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
    """The set of moves that conflict with each move, computed on first access."""

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
        self._cached = table.valid.bit_length() <= _MAX_CACHED_BITS

    def __missing__(self, bit: int) -> int:
        cell, d = divmod(bit, self._fan)
        up = (cell - self._base) * self._fan
        pattern = self._patterns[d]
        found = (pattern << up if up >= 0 else pattern >> -up) & self._valid
        if self._cached:
            self[bit] = found
        return found


@attrs.frozen
class Bans:
    """The moves a vehicle must not make; steps count from 0.

    at: moves that are banned in a single step, by step.
    since: moves that are banned in a step and all later ones, by step.
    earliest, latest: the minimum and maximum number of steps until the final arrival.
    """

    at: dict[int, int] = attrs.field(factory=dict)
    since: dict[int, int] = attrs.field(factory=dict)
    earliest: int = 0
    latest: int | None = None


@attrs.frozen(eq=False)
class Diagram:
    """All minimum-cost paths of a vehicle to a target, as a multi-valued decision diagram.

    layers: for each of the `cost` steps, the moves that lie on at least one such path.
    target: bit index of the target cell and of its wait move.
    """

    layers: tuple[int, ...]
    target: int

    @property
    def cost(self) -> int:
        """Return the number of steps until the final arrival."""
        return len(self.layers)

    def layer(self, step: int) -> int:
        """Return the possible moves of a step; after arrival, only waiting at the target."""
        return self.layers[step] if step < len(self.layers) else 1 << self.target


@attrs.frozen
class Solution:
    """A conflict-free path set for an assignment (0-based targets)."""

    assignment: tuple[int, ...]
    paths: tuple[Path, ...]

    @property
    def cost(self) -> int:
        """Return the cost of the path set."""
        return sum(len(path) for path in self.paths)


@attrs.define(eq=False)
class Search:
    """Base class of the solvers: a search for the cheapest path set.

    best: the cheapest path set so far.
    lower_bound: lower bound on the cost of all path sets; infinite: no path set exists.
    finished: whether it is proven that `best` is optimal or that no path set exists.
    aborted: whether this solver cannot decide the problem within its limits; another might.
    tried: number of assignments that were examined one by one.
    has_fewest_moves: whether it is proven that no path set of the same cost has fewer moves.
    """

    best: Solution | None = None
    lower_bound: float = 0
    finished: bool = False
    aborted: bool = False
    tried: int = 0
    has_fewest_moves: bool = False

    def run(self) -> None:
        """Search until the optimum is proven or the budget is spent."""
        raise NotImplementedError


class Problem:
    """Vehicles and targets on a grid.

    starts, targets: bit indices of the start cells and of the target cells.
    excluded: the displacements that each vehicle cannot drive, by index.
    undrivable: the moves that each vehicle cannot drive.
    max_steps: maximum number of steps of a path set; None: any number.
    free_paths: cache of `shortest_paths.free_paths`, shared by all constraint trees.
    """

    def __init__(
        self,
        grid: Grid,
        mode: Mode,
        model: ConflictModel,
        starts: Sequence[Cell],
        targets: Sequence[Cell],
        drivable: Sequence[Collection[Cell] | None] | None = None,
        max_steps: int | None = None,
    ) -> None:
        """Number the moves of the grid.

        Args:
            grid: the grid.
            mode: relative motion mode.
            model: definition of conflicts.
            starts: start cell of each vehicle.
            targets: target cells.
            drivable: moves (columns, lanes) that each vehicle can drive; None, for a vehicle or
                for all: all moves of the mode.
            max_steps: maximum number of steps of a path set; None: any number.
        """
        self.table = MoveTable(grid, mode, model)
        self.starts = tuple(self.table.bit(cell) for cell in starts)
        self.targets = tuple(self.table.bit(cell) for cell in targets)
        steps = self.table.steps
        self.excluded = tuple(
            frozenset(
                d for d, step in enumerate(steps) if d and moves is not None and step not in moves
            )
            for moves in ((None,) * len(starts) if drivable is None else drivable)
        )
        self.max_steps = max_steps
        self.undrivable = tuple(map(self.table.with_displacements, self.excluded))
        self.free_paths: dict[tuple[int, int], Diagram | None] = {}

    @property
    def is_sparse(self) -> bool:
        """Whether the grid has so many free cells that conflicts are rare."""
        return self.table.cell_count > _SPARSE_CELLS * max(len(self.starts), _FEW_VEHICLES)

    def is_too_long(self, solution: Solution) -> bool:
        """Return whether a path set has more steps than are permitted."""
        most = max(map(len, solution.paths), default=0)
        return self.max_steps is not None and most > self.max_steps

    @property
    def max_cost(self) -> float:
        """The cost that no path set exceeds; infinite if its number of steps is not limited."""
        return math.inf if self.max_steps is None else len(self.starts) * self.max_steps

    def cells_of(self, solution: Solution) -> list[list[Cell]]:
        """Return the paths as cells, each beginning at the vehicle's start."""
        table = self.table
        return [
            [table.cell(start), *(table.cell(table.landing(move)) for move in path)]
            for start, path in zip(self.starts, solution.paths, strict=True)
        ]
