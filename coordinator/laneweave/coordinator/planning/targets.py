"""Targets of a formation: the parallel structure after lane sorting (paper, Section 5.2.1).

Each lane offers as many neighbouring cells as vehicles need it, placed where their paths are
shortest. A vehicle without an agent keeps its cell, and the others sort themselves around it.
When a lane has fewer free cells than vehicles that need it, those with the longest path stay out.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import product

from attrs import frozen

from laneweave.coordinator.planning.formation_structures import ranked_runs
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Name


@frozen
class Targets:
    """Where the vehicles of a formation should go."""

    cells: tuple[Cell, ...]
    """All targets, as many as there are vehicles to place."""
    own: dict[Name, Cell]
    """Targets of those that cannot get their lanes: the nearest cell that is left."""


def placements(
    cells: Mapping[Name, Cell],
    preferred_lanes: Mapping[Name, int],
    columns: int,
    lanes: int,
    blocked: Collection[Cell] = (),
    *,
    ahead: bool = False,
) -> Iterator[Targets]:
    """Yield all parallel structures on a grid, those with the shortest paths first.

    Args:
        cells: where each vehicle is.
        preferred_lanes: lane that each of them needs.
        columns: columns of the grid.
        lanes: lanes of the grid.
        blocked: cells that cannot be targets.
        ahead: which of two placements with equal paths comes first: the one further ahead, or the
            one nearer to the middle of the grid.
    """
    choices: list[list[tuple[float, list[Cell]]]] = []
    left_over: list[Name] = []
    for lane in range(lanes):
        free = [column for column in range(columns) if (column, lane) not in blocked]
        wanting = [name for name in cells if preferred_lanes[name] == lane]
        if len(wanting) > len(free):
            # Those furthest away stay out; by name where it makes no difference.
            wanting.sort(key=lambda name: (abs(cells[name][1] - lane), name))
            left_over += wanting[len(free) :]
            wanting = wanting[: len(free)]
        starts = [cells[name] for name in wanting]
        choices.append(_ranked_targets(lane, starts, columns, free, ahead=ahead))
    for chosen in _combinations(choices):
        targets = list(chosen)
        own: dict[Name, Cell] = {}
        for name in left_over:
            own[name] = _nearest_free(cells[name], columns, lanes, {*blocked, *targets})
            targets.append(own[name])
        yield Targets(tuple(targets), own)


def _combinations(choices: Sequence[Sequence[tuple[float, list[Cell]]]]) -> Iterator[list[Cell]]:
    """Yield one choice of each lane, joined, in ascending order of the sum of their ranks."""

    def total(indices: tuple[int, ...]) -> float:
        return sum(lane[index][0] for lane, index in zip(choices, indices, strict=True))

    first = (0,) * len(choices)
    heap, seen = [(total(first), first)], {first}
    while heap:
        _, indices = heapq.heappop(heap)
        yield [
            cell for lane, index in zip(choices, indices, strict=True) for cell in lane[index][1]
        ]
        for place, index in enumerate(indices):
            following = (*indices[:place], index + 1, *indices[place + 1 :])
            if index + 1 < len(choices[place]) and following not in seen:
                seen.add(following)
                heapq.heappush(heap, (total(following), following))


def _ranked_targets(
    lane: int, cells: Sequence[Cell], columns: int, free: Sequence[int], *, ahead: bool
) -> list[tuple[float, list[Cell]]]:
    """Return all runs of neighbouring cells on a lane, each with its rank, the best one first."""
    count = len(cells)
    if count == 0:
        return [(0.0, [])]
    runs = ranked_runs([column for column, _ in cells], free, columns, ahead=ahead)
    return [
        (rank, [(column, lane) for column in free[first : first + count]]) for rank, first in runs
    ]


def _nearest_free(cell: Cell, columns: int, lanes: int, taken: Collection[Cell]) -> Cell:
    """Return the nearest cell that is not taken; there is one, since a vehicle has left it."""
    free = (other for other in product(range(columns), range(lanes)) if other not in taken)
    return min(free, key=lambda other: (abs(other[0] - cell[0]) + abs(other[1] - cell[1]), other))
