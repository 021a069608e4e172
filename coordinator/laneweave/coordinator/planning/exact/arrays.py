"""A planning problem as arrays, for the compiled parts of the planner.

Cells are numbered column by column; `cell = column * lanes + lane`. A move is a displacement and a
from-cell. Vehicles with the same eligible targets that can drive the same moves form a *team* and
may exchange targets. A *pair* is a team and one of its eligible targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.exact.cliques import Clique, clique_patterns
from laneweave.coordinator.planning.exact.multipliers_kernel import cliques_of_moves, min_steps
from laneweave.coordinator.planning.grid import Grid
from laneweave.protocol.lattice import Cell, Mode, displacements

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class MoveArrays(NamedTuple):
    """The moves of a grid under a conflict model.

    Shapes: D displacements, X cells, at most M cliques per move.
    """

    lanes: int
    step: Ints
    """(D,) change in the cell number."""
    valid: Bools
    """(D, X) whether the move stays on free cells."""
    clique: Ints
    """(D, X, M) indices of the cliques that contain a move, padded with -1."""
    clique_count: int
    residue: Ints
    """(X,) label below `residue_count` that differs between the from-cells of the moves in a
    clique: column and lane modulo the reach of conflicts plus one."""
    residue_count: int


class Teams(NamedTuple):
    """Vehicles and targets. Shapes: N vehicles, J targets, K teams, P pairs, X cells."""

    start: Ints
    """(N,) start cell of each vehicle."""
    team: Ints
    """(N,) team index of each vehicle."""
    drives: Bools
    """(K, D, X) whether the vehicles of a team can make a move, on free cells."""
    target: Ints
    """(J,) cell of each target."""
    pairs_from: Ints
    """(K + 1,) team k has the pairs from `pairs_from[k]` to `pairs_from[k + 1] - 1`."""
    pair_target: Ints
    """(P,) target index of each pair."""
    pair_cell: Ints
    """(P,) cell of each pair's target."""
    pair: Ints
    """(K, J) pair index; -1: target not eligible for the team."""
    distance: Floats
    """(X, P) minimum steps from each cell to a pair's target; `UNREACHABLE`: no path."""


@lru_cache(maxsize=16)
def move_arrays(grid: Grid, mode: Mode, model: ConflictModel) -> MoveArrays:
    """Return the moves and conflict cliques of a grid."""
    steps = np.array(displacements(mode), dtype=np.int64)
    valid = valid_moves(grid, mode)
    clique, clique_count = _cliques(grid, clique_patterns(mode, model), len(steps), valid)
    cell = np.arange(grid.columns * grid.lanes)
    columns, lanes = (reach + 1 for reach in model.reach)
    residue = cell // grid.lanes % columns * lanes + cell % grid.lanes % lanes
    step = steps[:, 0] * grid.lanes + steps[:, 1]
    return MoveArrays(grid.lanes, step, valid, clique, clique_count, residue, columns * lanes)


def valid_moves(grid: Grid, mode: Mode) -> Bools:
    """Return (D, X) whether a move stays on free cells."""
    free = np.zeros((grid.columns + 2, grid.lanes + 2), dtype=np.bool_)
    free[1:-1, 1:-1] = True
    for column, lane in grid.blocked:
        free[column + 1, lane + 1] = False
    inside = free[1:-1, 1:-1]
    return np.array(
        [
            (
                inside & free[1 + c : grid.columns + 1 + c, 1 + across : grid.lanes + 1 + across]
            ).ravel()
            for c, across in displacements(mode)
        ]
    )


def _cliques(
    grid: Grid, patterns: tuple[Clique, ...], displacement_count: int, valid: Bools
) -> tuple[Ints, int]:
    """Return each move's cliques of at least two moves on the grid, and the number of cliques."""
    # Sorted by descending offset, so that each move lists its cliques in ascending order.
    members = [
        (number, *member)
        for number, pattern in enumerate(patterns)
        for member in sorted(pattern, reverse=True)
    ]
    valid = valid.reshape(displacement_count, grid.columns, grid.lanes)
    listed = np.array(members, dtype=np.int64).reshape(-1, 4)
    clique, count = cliques_of_moves(listed, valid)
    return clique, int(count)


def teams(
    arrays: MoveArrays,
    starts: Sequence[Cell],
    targets: Sequence[Cell],
    choices: Sequence[frozenset[int]],
    excluded: Sequence[frozenset[int]],
) -> Teams:
    """Return vehicles and targets as arrays; teams are ordered by their first vehicles.

    Args:
        arrays: moves of the grid.
        starts: start cell of each vehicle.
        targets: target cells.
        choices: indices of the targets that each vehicle may be assigned to.
        excluded: displacements that each vehicle cannot drive, by index.
    """
    numbers: dict[tuple[frozenset[int], frozenset[int]], int] = {}
    members = zip(choices, excluded, strict=True)
    team = [numbers.setdefault(member, len(numbers)) for member in members]
    sizes = [len(choice) for choice, _ in numbers]
    pairs_from = np.array([*accumulate(sizes, initial=0)], dtype=np.int64)
    numbered = [j for choice, _ in numbers for j in sorted(choice)]
    pair_target = np.array(numbered, dtype=np.int64)
    pair = np.full((len(numbers), len(targets)), -1, dtype=np.int64)
    pair[np.repeat(np.arange(len(numbers)), sizes), pair_target] = range(len(numbered))
    target = _cells(targets, arrays)
    pair_cell = target[pair_target]
    drives = np.repeat(arrays.valid[None], len(numbers), axis=0)
    for k, (_, excluded_of_team) in enumerate(numbers):
        drives[k, sorted(excluded_of_team)] = False
    return Teams(
        start=_cells(starts, arrays),
        team=np.array(team, dtype=np.int64),
        drives=drives,
        target=target,
        pairs_from=pairs_from,
        pair_target=pair_target,
        pair_cell=pair_cell,
        pair=pair,
        distance=min_steps(drives, arrays.step, pairs_from, pair_cell),
    )


def _cells(cells: Sequence[Cell], arrays: MoveArrays) -> Ints:
    return np.array([column * arrays.lanes + lane for column, lane in cells], dtype=np.int64)
