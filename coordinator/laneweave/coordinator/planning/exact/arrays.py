"""A planning problem as arrays, for the compiled parts of the planner.

Cells are numbered column by column; `cell = column * lanes + lane`. A move is a displacement and a
from-cell. Vehicles with equal eligibility are one *team*: they may swap their targets, so it does
not matter which of them goes where. A *pair* is a team and a target that it may have.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.conflict_cliques import Row, row_patterns
from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.exact.arrays_kernel import UNREACHABLE, least_steps
from laneweave.coordinator.planning.grid import Cell, Grid, Mode, displacements

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

__all__ = ["UNREACHABLE", "Bools", "Floats", "Ints", "Lattice", "Teams", "lattice", "part", "teams"]


class Lattice(NamedTuple):
    """The moves of a grid under a conflict model.

    Shapes: D displacements, X cells, M most rows that a move is in.
    """

    lanes: int
    step: Ints
    """(D,) difference of cell numbers."""
    valid: Bools
    """(D, X) whether the move stays on free cells."""
    row: Ints
    """(D, X, M) numbers of the rows that a move is in; -1: no more."""
    row_count: int
    near: Ints
    """(X,) a number from 0 to `near_count` - 1 that tells the from-cells of the moves in one row
    apart: they are no farther away from each other than conflicts reach."""
    near_count: int


class Teams(NamedTuple):
    """Vehicles and targets. Shapes: N vehicles, J targets, K teams, P pairs, X cells."""

    start: Ints
    """(N,) cells."""
    team: Ints
    """(N,) numbers of the vehicles' teams."""
    target: Ints
    """(J,) cells."""
    pairs_from: Ints
    """(K + 1,) team k has the pairs from `pairs_from[k]` to `pairs_from[k + 1]`."""
    pair_target: Ints
    """(P,) number of the target."""
    pair_cell: Ints
    """(P,) its cell."""
    pair: Ints
    """(K, J) number of a pair; -1: the team may not have the target."""
    distance: Floats
    """(X, P) least steps from each cell to a target; `UNREACHABLE`: there is no way."""


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
    row, row_count = _rows(grid, patterns, len(steps), valid)
    cell = np.arange(grid.columns * grid.lanes)
    columns, lanes = (reach + 1 for reach in model.reach)
    near = cell // grid.lanes % columns * lanes + cell % grid.lanes % lanes
    step = steps[:, 0] * grid.lanes + steps[:, 1]
    return Lattice(grid.lanes, step, valid, row, row_count, near, columns * lanes)


def _rows(
    grid: Grid, patterns: tuple[Row, ...], displacement_count: int, valid: Bools
) -> tuple[Ints, int]:
    """Number the rows; those of a single move do not restrict anything."""
    members: dict[tuple[int, int, int], list[tuple[int, int]]] = {}
    for number, pattern in enumerate(patterns):
        for c, across, d in pattern:
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
    return row, len(real)


def teams(
    ways: Lattice,
    starts: Sequence[Cell],
    targets: Sequence[Cell],
    choices: Sequence[frozenset[int]],
) -> Teams:
    """Return vehicles and targets as arrays, teams in the order of their first vehicles."""
    numbers: dict[frozenset[int], int] = {}
    team = [numbers.setdefault(choice, len(numbers)) for choice in choices]
    pair_target = [j for choice in numbers for j in sorted(choice)]
    pairs_from = np.cumsum([0, *map(len, numbers)])
    pair = np.full((len(numbers), len(targets)), -1, dtype=np.int64)
    for k in range(len(numbers)):
        first, end = pairs_from[k : k + 2]
        pair[k, pair_target[first:end]] = np.arange(first, end)
    target = _cells(targets, ways)
    numbered = np.array(pair_target, dtype=np.int64)
    return Teams(
        start=_cells(starts, ways),
        team=np.array(team, dtype=np.int64),
        target=target,
        pairs_from=pairs_from.astype(np.int64),
        pair_target=numbered,
        pair_cell=target[numbered],
        pair=pair,
        distance=least_steps(ways.valid, ways.step, target[numbered]),
    )


def _cells(cells: Sequence[Cell], ways: Lattice) -> Ints:
    return np.array([column * ways.lanes + lane for column, lane in cells], dtype=np.int64)


def part(whole: Teams, vehicles: Ints, targets: Ints) -> Teams:
    """Return some vehicles (n,) and the targets (m,) that they may share; all must be at one.

    Beyond the steps with prices there is no way to a target any more: `distance` is 0 there, and
    elsewhere `UNREACHABLE`.
    """
    numbers = np.unique(whole.team[vehicles])
    pair = np.full((len(numbers), len(targets)), -1, dtype=np.int64)
    may = whole.pair[numbers][:, targets] >= 0
    pair[may] = np.arange(np.count_nonzero(may))
    _, pair_target = np.nonzero(may)
    cell = whole.target[targets]
    distance = np.full((len(whole.distance), len(pair_target)), UNREACHABLE)
    distance[cell[pair_target], np.arange(len(pair_target))] = 0.0
    return Teams(
        start=whole.start[vehicles],
        team=np.searchsorted(numbers, whole.team[vehicles]).astype(np.int64),
        target=cell,
        pairs_from=np.concatenate([[0], np.cumsum(may.sum(axis=1))]).astype(np.int64),
        pair_target=pair_target.astype(np.int64),
        pair_cell=cell[pair_target],
        pair=pair,
        distance=distance,
    )
