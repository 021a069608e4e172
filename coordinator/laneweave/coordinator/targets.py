"""Targets of a formation: the parallel structure after lane sorting (paper, Section 5.2.1).

Each lane offers as many neighbouring cells as vehicles need it, placed where their ways are
shortest. A vehicle that nobody drives keeps its cell, and the others sort themselves around it.
When a lane has fewer free cells than vehicles that need it, those with the longest way stay out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from attrs import frozen

from laneweave.coordinator.planning.structures import nearest_run
from laneweave.protocol.lattice import Cell
from laneweave.protocol.messages import Name


@frozen
class Targets:
    """Where the vehicles of a formation should go."""

    cells: tuple[Cell, ...]
    """All targets, as many as there are vehicles to place."""
    own: dict[Name, Cell]
    """Targets of those that cannot get their lanes: the nearest cell that is left."""


def place(
    cells: Mapping[Name, Cell],
    preferred_lanes: Mapping[Name, int],
    columns: int,
    lanes: int,
    blocked: Collection[Cell] = (),
) -> Targets:
    """Place the targets of vehicles on a grid.

    Args:
        cells: where each vehicle is.
        preferred_lanes: lane that each of them needs.
        columns: columns of the grid.
        lanes: lanes of the grid.
        blocked: cells that cannot be targets.
    """
    targets: list[Cell] = []
    left_over: list[Name] = []
    for lane in range(lanes):
        free = [column for column in range(columns) if (column, lane) not in blocked]
        wanting = [name for name in cells if preferred_lanes[name] == lane]
        if len(wanting) > len(free):
            # Who is furthest away has the least chance; by name where it makes no difference.
            wanting.sort(key=lambda name: (abs(cells[name][1] - lane), name))
            left_over += wanting[len(free) :]
            wanting = wanting[: len(free)]
        targets += parallel_targets(lane, [cells[name] for name in wanting], columns, free)
    own: dict[Name, Cell] = {}
    for name in left_over:
        own[name] = _nearest_free(cells[name], columns, lanes, {*blocked, *targets})
        targets.append(own[name])
    return Targets(tuple(targets), own)


def parallel_targets(
    lane: int, cells: Sequence[Cell], columns: int, free: Sequence[int] | None = None
) -> list[Cell]:
    """Return neighbouring target cells on a lane for the vehicles that need it.

    As many as there are vehicles, without gaps but for blocked cells, placed where the vehicles
    have the shortest way, so that lane sorting moves nobody ahead or back on average.

    Args:
        lane: the lane that all of them need.
        cells: where they are.
        columns: columns of the grid.
        free: columns in which the lane's cells may be targets; None: all.
    """
    free = range(columns) if free is None else free
    if not cells or len(cells) >= len(free):
        return [(column, lane) for column in free] if cells else []
    _, first = nearest_run([column for column, _ in cells], free, columns)
    return [(column, lane) for column in free[first : first + len(cells)]]


def _nearest_free(cell: Cell, columns: int, lanes: int, taken: Collection[Cell]) -> Cell:
    """Return the nearest cell that is not taken; there is one, since a vehicle has left it."""
    return min(
        (
            (column, lane)
            for column in range(columns)
            for lane in range(lanes)
            if (column, lane) not in taken
        ),
        key=lambda other: (abs(other[0] - cell[0]) + abs(other[1] - cell[1]), other),
    )
