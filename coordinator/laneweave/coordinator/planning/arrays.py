"""A planning problem as arrays, for the compiled parts of the planner.

Cells are numbered column by column; `cell = column * lanes + lane`. A move is a displacement and a
from-cell. Vehicles with equal eligibility are one *team*: they may swap their targets, so it does
not matter which of them goes where.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Cell, Grid, Mode, displacements
from laneweave.coordinator.planning.moves import REACH, conflict_offsets
from laneweave.coordinator.planning.rows import RowPatterns, row_patterns

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

UNREACHABLE = 1e9
"""Stands for infinity, and can be added to."""


class Lattice(NamedTuple):
    """The moves of a grid under a conflict model.

    Shapes: D displacements, X cells, M most rows that a move is in.
    """

    columns: int
    lanes: int
    along: Ints
    """(D,) columns that a displacement leads on."""
    across: Ints
    """(D,) lanes that it leads to the left."""
    step: Ints
    """(D,) its difference of cell numbers."""
    valid: Bools
    """(D, X) whether the move stays on free cells."""
    row: Ints
    """(D, X, M) numbers of the rows that a move is in; -1: no more."""
    row_count: int
    row_column: Ints
    """(rows,) the column that each row belongs to: all its moves touch it."""
    conflict: Bools
    """(D, D, 5, 5) whether two moves conflict, by the way from one from-cell to the other, + 2."""


class Teams(NamedTuple):
    """Vehicles and targets. Shapes: N vehicles, J targets, K teams."""

    start: Ints
    """(N,) cells."""
    target: Ints
    """(J,) cells."""
    team: Ints
    """(N,) numbers of the vehicles' teams."""
    eligible: Bools
    """(K, J)."""
    distance: Floats
    """(J, X) least steps from each cell to a target; `UNREACHABLE`: there is no way."""


@lru_cache(maxsize=16)
def lattice(grid: Grid, mode: Mode, model: ConflictModel) -> Lattice:
    """Lay the moves and rows of a conflict model on a grid."""
    patterns = row_patterns(mode, model)
    steps = np.array(displacements(mode), dtype=np.int64)
    free = np.zeros((grid.columns + 2, grid.lanes + 2), dtype=np.bool_)
    free[1:-1, 1:-1] = True
    for column, lane in grid.blocked:
        free[column + 1, lane + 1] = False
    inside = free[1:-1, 1:-1]
    valid = np.array(
        [
            (
                inside & free[1 + c : grid.columns + 1 + c, 1 + across : grid.lanes + 1 + across]
            ).ravel()
            for c, across in steps.tolist()
        ]
    )
    row, row_count, row_column = _rows(grid, patterns, len(steps), valid)
    return Lattice(
        grid.columns,
        grid.lanes,
        steps[:, 0].copy(),
        steps[:, 1].copy(),
        steps[:, 0] * grid.lanes + steps[:, 1],
        valid,
        row,
        row_count,
        row_column,
        _conflicts(mode, model),
    )


def _rows(
    grid: Grid, patterns: RowPatterns, displacement_count: int, valid: Bools
) -> tuple[Ints, int, Ints]:
    """Number the rows; those of a single move do not restrict anything."""
    members: dict[tuple[int, int, int], list[tuple[int, int]]] = {}
    for number, kind in enumerate(patterns.kinds):
        for c, across, d in kind.members:
            for cell in np.flatnonzero(valid[d]).tolist():
                column, lane = divmod(cell, grid.lanes)
                members.setdefault((number, column - c, lane - across), []).append((d, cell))
    real = sorted(key for key, moves in members.items() if len(moves) > 1)
    of_move: dict[tuple[int, int], list[int]] = {}
    for index, key in enumerate(real):
        for move in members[key]:
            of_move.setdefault(move, []).append(index)
    most = max(map(len, of_move.values()), default=1)
    row = np.full((displacement_count, grid.columns * grid.lanes, most), -1, dtype=np.int64)
    for (d, cell), indices in of_move.items():
        row[d, cell, : len(indices)] = indices
    columns = [key[1] + patterns.kinds[key[0]].column for key in real]
    return row, len(real), np.array(columns, dtype=np.int64)


def _conflicts(mode: Mode, model: ConflictModel) -> Bools:
    size, side = len(displacements(mode)), 2 * REACH + 1
    table = np.zeros((size, size, side, side), dtype=np.bool_)
    for d, offsets in enumerate(conflict_offsets(mode, model)):
        for column, lane, e in offsets:
            table[d, e, column + REACH, lane + REACH] = True
    return table


def teams(
    grid: Grid,
    mode: Mode,
    starts: Sequence[Cell],
    targets: Sequence[Cell],
    choices: Sequence[frozenset[int]],
) -> Teams:
    """Return vehicles and targets as arrays, teams in the order of their first vehicles."""
    numbers: dict[frozenset[int], int] = {}
    team = [numbers.setdefault(choice, len(numbers)) for choice in choices]
    eligible = np.zeros((len(numbers), len(targets)), dtype=np.bool_)
    for choice, number in numbers.items():
        eligible[number, sorted(choice)] = True
    cells = [column * grid.lanes + lane for column, lane in targets]
    return Teams(
        np.array([column * grid.lanes + lane for column, lane in starts], dtype=np.int64),
        np.array(cells, dtype=np.int64),
        np.array(team, dtype=np.int64),
        eligible,
        _distances(grid, mode, targets),
    )


def _distances(grid: Grid, mode: Mode, targets: Sequence[Cell]) -> Floats:
    """Return the least steps from every cell to each target, as if it were alone."""
    free = list(grid.cells())
    found = np.full((len(targets), grid.columns * grid.lanes), UNREACHABLE)
    for j, target in enumerate(targets):
        for (column, lane), steps in grid.distances(target, mode, free).items():
            found[j, column * grid.lanes + lane] = steps
    return found
