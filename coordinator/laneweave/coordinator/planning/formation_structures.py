"""Targets of the two formation structures: parallel and interlaced (paper, Sections 2.2 and 5.2.1).

The cells of a structure are free cells in its lanes: all of them if it is parallel; only those with
even column + lane, or only those with odd column + lane, if it is interlaced. In each lane, a
structure takes as many neighbouring cells as it has vehicles there; only blocked cells make gaps:

- If every vehicle names a lane, the cells in each lane minimize its vehicles' total distance.
- Otherwise cells are filled from a common front to the rear, column by column, and in each column
  from the right lane to the left. A lane's cells go first to the vehicles that name it, then to
  vehicles that name none. The front is the one that minimizes the total distance along the road.

The interlaced structure with the shorter total distance is chosen; ties go to the even one.
Ties between positions go to the one nearest the middle of the grid.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.grid import Grid
from laneweave.protocol.lattice import Cell

PARALLEL: Final = "parallel"
INTERLACED: Final = "interlaced"
STRUCTURES: Final = (PARALLEL, INTERLACED)

_Columns = Mapping[int, Sequence[int]]
"""Columns of a structure's cells, ascending, for each of its lanes."""
_Placed = tuple[float, list[Cell]]
"""Total distance along the road plus a tie-breaker, and the cells."""


def structure_targets(
    structure: str,
    lanes: Sequence[int],
    grid: Grid,
    cells: Sequence[Cell],
    preferred: Sequence[int | None],
) -> tuple[Cell, ...]:
    """Return the targets of a structure, one for each vehicle, sorted by lane and column.

    Args:
        structure: one of `STRUCTURES`.
        lanes: lanes of the structure.
        grid: the grid with its blocked cells.
        cells: current cells of the vehicles.
        preferred: the preferred lane of each vehicle, one of `lanes`; None: any.

    Raises:
        ValueError: the structure has too few cells; see `shortage`.
    """
    placed = [
        _place(columns, grid, cells, preferred)
        for columns in _variants(structure, lanes, grid)
        if _shortage(columns, preferred) is None
    ]
    if not placed:
        raise ValueError(shortage(structure, lanes, grid, preferred))
    _, targets = min(placed, key=lambda one: one[0])
    return tuple(sorted(targets, key=lambda cell: (cell[1], cell[0])))


def shortage(
    structure: str, lanes: Sequence[int], grid: Grid, preferred: Sequence[int | None]
) -> str | None:
    """Return why a structure has too few cells for its vehicles, or None."""
    found = [_shortage(columns, preferred) for columns in _variants(structure, lanes, grid)]
    return None if None in found else found[0]


def is_formed(structure: str, lanes: Sequence[int], grid: Grid, cells: Sequence[Cell]) -> bool:
    """Return whether vehicles that name no lane form a structure, wherever its front is.

    Args:
        structure: one of `STRUCTURES`.
        lanes: lanes of the structure.
        grid: the grid with its blocked cells.
        cells: current cells of the vehicles.
    """
    unnamed, occupied = [None] * len(cells), sorted(cells)
    for columns in _variants(structure, lanes, grid):
        lanes_of = _lanes_by_column(columns)
        if any(sorted(_fill(front, lanes_of, unnamed) or ()) == occupied for front in lanes_of):
            return True
    return False


def ranked_runs(
    columns: Sequence[int], free: Sequence[int], width: int, *, ahead: bool = False
) -> list[tuple[float, int]]:
    """Return the runs of neighbouring cells in a lane, nearest to its vehicles first.

    Assigning the cells to vehicles in column order minimizes the total distance.

    Args:
        columns: columns of the vehicles; at most as many as there are in `free`.
        free: columns of the cells that may be taken, ascending.
        width: number of columns of the grid.
        ahead: whether ties go to the run further ahead, not to the one nearer the middle.

    Returns:
        For each run, the total distance along the road plus a small tie-breaker, and the index of
        its first cell in `free`.
    """
    runs = np.lib.stride_tricks.sliding_window_view(np.asarray(free), len(columns))
    tie_breaker = (
        (width - 1 - runs.mean(axis=1)) / (10 * width)
        if ahead
        else _distance_from_middle(runs, width)
    )
    totals = np.abs(runs - np.sort(columns)).sum(axis=1) + tie_breaker
    return [(float(totals[first]), int(first)) for first in np.argsort(totals, kind="stable")]


def _variants(structure: str, lanes: Sequence[int], grid: Grid) -> list[_Columns]:
    """Return the possible cells of a structure: one variant if parallel, two if interlaced."""
    parities = ((0, 1),) if structure == PARALLEL else ((0,), (1,))
    return [
        {
            lane: [
                column
                for column in range(grid.columns)
                if (column + lane) % 2 in parity and grid.is_free((column, lane))
            ]
            for lane in lanes
        }
        for parity in parities
    ]


def _shortage(columns: _Columns, preferred: Sequence[int | None]) -> str | None:
    for lane, count in sorted(_vehicles_per_lane(preferred).items()):
        if count > len(columns[lane]):
            return f"lane {lane} has {len(columns[lane])} such cells for {count} vehicles"
    cells = sum(map(len, columns.values()))
    if cells < len(preferred):
        return f"its lanes have {cells} such cells for {len(preferred)} vehicles"
    return None


def _vehicles_per_lane(preferred: Sequence[int | None]) -> Counter[int]:
    """Return how many vehicles name each lane."""
    return Counter(lane for lane in preferred if lane is not None)


def _place(
    columns: _Columns, grid: Grid, cells: Sequence[Cell], preferred: Sequence[int | None]
) -> _Placed:
    if None in preferred:
        return _filled(columns, grid, [column for column, _ in cells], preferred)
    total, targets = 0.0, []
    for lane in sorted(_vehicles_per_lane(preferred)):
        starts = [cell[0] for cell, own in zip(cells, preferred, strict=True) if own == lane]
        distance, first = ranked_runs(starts, columns[lane], grid.columns)[0]
        total += distance
        targets += [(column, lane) for column in columns[lane][first : first + len(starts)]]
    return total, targets


def _filled(
    columns: _Columns, grid: Grid, starts: Sequence[int], preferred: Sequence[int | None]
) -> _Placed:
    """Fill a structure from each front; return the result nearest to the starts."""
    lanes_of = _lanes_by_column(columns)
    starts_in_order = np.sort(starts)
    found: list[_Placed] = []
    for front in sorted(lanes_of):
        targets = _fill(front, lanes_of, preferred)
        if targets is not None:
            places = np.sort([column for column, _ in targets])
            distance = float(
                np.abs(places - starts_in_order).sum() + _distance_from_middle(places, grid.columns)
            )
            found.append((distance, targets))
    return min(found, key=lambda one: one[0])


def _lanes_by_column(columns: _Columns) -> dict[int, list[int]]:
    """Return the lanes of a structure's cells, ascending, for each column that has any."""
    lanes_of: dict[int, list[int]] = {}
    for lane in sorted(columns):
        for column in columns[lane]:
            lanes_of.setdefault(column, []).append(lane)
    return lanes_of


def _fill(
    front: int, lanes_of: Mapping[int, Sequence[int]], preferred: Sequence[int | None]
) -> list[Cell] | None:
    """Fill cells backwards from column `front`; return None if there are too few."""
    per_lane = _vehicles_per_lane(preferred)
    others = len(preferred) - per_lane.total()
    targets: list[Cell] = []
    for column in range(front, min(lanes_of) - 1, -1):
        for lane in lanes_of.get(column, ()):
            if per_lane[lane]:
                per_lane[lane] -= 1
            elif others:
                others -= 1
            else:
                continue
            targets.append((column, lane))
        if len(targets) == len(preferred):
            return targets
    return None


def _distance_from_middle(columns: NDArray[np.int64], width: int) -> NDArray[np.float64]:
    """Return a tie-breaker below 0.06 that grows with the distance from the middle."""
    return np.asarray(np.abs(columns.mean(axis=-1) - (width - 1) / 2) / (10 * width))
