"""Targets of a formation that sorts its lanes.

- `placements`: the parallel structure (paper, Section 5.2.1).
- `choose_lanes`, `reachable_lanes`: any cells of the goal lanes.

In the parallel structure each lane provides neighbouring cells, one per vehicle that prefers the
lane, where paths are shortest. Vehicles without an agent keep their cells, which are blocked for
others. If more vehicles prefer a lane than it has free cells, the vehicles furthest from it get the
nearest other cells.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import combinations, product

import numpy as np
from attrs import frozen
from scipy.optimize import linear_sum_assignment

from laneweave.coordinator.planning.formation_structures import ranked_runs
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Name


@frozen
class Targets:
    """Target cells of a formation."""

    cells: tuple[Cell, ...]
    """All targets, one for each vehicle."""
    off_lane: dict[Name, Cell]
    """Targets of the vehicles that do not fit in their preferred lanes."""


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
        cells: current cell of each vehicle.
        preferred_lanes: preferred lane of each vehicle.
        columns: number of columns of the grid.
        lanes: number of lanes of the grid.
        blocked: cells that cannot be targets.
        ahead: whether ties go to the placement further ahead, not to the one nearer the middle of
            the grid.
    """
    choices: list[list[tuple[float, list[Cell]]]] = []
    displaced: list[Name] = []
    for lane in range(lanes):
        free = [column for column in range(columns) if (column, lane) not in blocked]
        assigned = [name for name in cells if preferred_lanes[name] == lane]
        if len(assigned) > len(free):
            # The furthest vehicles are displaced; ties are broken by name.
            assigned.sort(key=lambda name: (abs(cells[name][1] - lane), name))
            displaced += assigned[len(free) :]
            assigned = assigned[: len(free)]
        starts = [cells[name] for name in assigned]
        choices.append(_ranked_targets(lane, starts, columns, free, ahead=ahead))
    for chosen in _combinations(choices):
        targets = list(chosen)
        off_lane: dict[Name, Cell] = {}
        for name in displaced:
            off_lane[name] = _nearest_free(cells[name], columns, lanes, {*blocked, *targets})
            targets.append(off_lane[name])
        yield Targets(tuple(targets), off_lane)


def choose_lanes(
    cells: Mapping[Name, Cell],
    goal_lanes: Mapping[Name, Collection[int]],
    through_lanes: Collection[int],
    free: Sequence[Cell],
    column_bound: Collection[Name] = (),
) -> dict[Name, frozenset[int]]:
    """Return the lanes in which each vehicle may have its target, so that all have one.

    These are its goal lanes. If they have too few free cells, the vehicles furthest from them get
    the lanes that go on, and if these have too few, too, all lanes.

    Args:
        cells: current cell of each vehicle.
        goal_lanes: goal lanes of each vehicle.
        through_lanes: lanes that go on behind the stage.
        free: cells that can be targets, at least as many as there are vehicles.
        column_bound: vehicles whose targets are in their own columns.
    """
    choices = {
        name: [frozenset(goal_lanes[name]), frozenset(through_lanes) | frozenset(goal_lanes[name])]
        for name in cells
    }
    every = frozenset(lane for _, lane in free)
    # The penalty for a worse choice exceeds the sum of all distances, that for another column the
    # sum of all penalties for choices.
    penalty = 1 + len(cells) * sum(max(cell) + 1 for cell in (*cells.values(), *free))
    other_column = penalty * (1 + 2 * len(cells))
    costs = np.array(
        [
            [
                abs(column - other[0])
                + abs(lane - other[1])
                + penalty * sum(other[1] not in lanes for lanes in choices[name])
                + other_column * (name in column_bound and column != other[0])
                for other in free
            ]
            for name, (column, lane) in cells.items()
        ]
    ).reshape(len(cells), len(free))
    chosen: dict[Name, frozenset[int]] = {}
    for name, index in zip(cells, linear_sum_assignment(costs)[1], strict=True):
        lane = free[index][1]
        chosen[name] = next((lanes for lanes in choices[name] if lane in lanes), every)
    return chosen


def reachable_lanes(
    cells: Mapping[Name, Cell],
    goal_lanes: Mapping[Name, Collection[int]],
    column_bound: Collection[Name],
    free: Collection[Cell],
) -> dict[Name, frozenset[int]]:
    """Return the goal lanes that each vehicle can reach, if some cannot change columns.

    These keep their order in a column, and cannot pass a cell that is not free. As many of them as
    possible reach a goal lane; each of the others gets all lanes that it can reach.

    Args:
        cells: current cell of each vehicle.
        goal_lanes: goal lanes of each vehicle.
        column_bound: vehicles that cannot change columns.
        free: cells that can be targets; includes the current cells.
    """
    found = {name: frozenset(goal_lanes[name]) for name in cells}
    free = frozenset(free)
    sections: dict[tuple[int, int], list[Name]] = {}
    for name in sorted(column_bound, key=lambda name: cells[name]):
        column, first = cells[name]
        while (column, first - 1) in free:
            first -= 1
        sections.setdefault((column, first), []).append(name)
    for (column, first), names in sections.items():
        last = first
        while (column, last + 1) in free:
            last += 1
        chosen = max(
            combinations(range(first, last + 1), len(names)),
            key=lambda lanes: sum(
                lane in found[name] for name, lane in zip(names, lanes, strict=True)
            ),
        )
        for name, lane in zip(names, chosen, strict=True):
            within = found[name].intersection(range(first, last + 1))
            found[name] = within if lane in within else frozenset(range(first, last + 1))
    return found


def _combinations(choices: Sequence[Sequence[tuple[float, list[Cell]]]]) -> Iterator[list[Cell]]:
    """Yield the cells of one choice per lane, in ascending order of the sum of ranks."""

    def rank_sum(indices: tuple[int, ...]) -> float:
        return sum(lane[index][0] for lane, index in zip(choices, indices, strict=True))

    first = (0,) * len(choices)
    heap, seen = [(rank_sum(first), first)], {first}
    while heap:
        _, indices = heapq.heappop(heap)
        yield [
            cell for lane, index in zip(choices, indices, strict=True) for cell in lane[index][1]
        ]
        for place, index in enumerate(indices):
            following = (*indices[:place], index + 1, *indices[place + 1 :])
            if index + 1 < len(choices[place]) and following not in seen:
                seen.add(following)
                heapq.heappush(heap, (rank_sum(following), following))


def _ranked_targets(
    lane: int, cells: Sequence[Cell], columns: int, free: Sequence[int], *, ahead: bool
) -> list[tuple[float, list[Cell]]]:
    """Return all runs of neighbouring cells in a lane, each with its rank, best first."""
    count = len(cells)
    if count == 0:
        return [(0.0, [])]
    runs = ranked_runs([column for column, _ in cells], free, columns, ahead=ahead)
    return [
        (rank, [(column, lane) for column in free[first : first + count]]) for rank, first in runs
    ]


def _nearest_free(cell: Cell, columns: int, lanes: int, taken: Collection[Cell]) -> Cell:
    """Return the nearest cell that is not taken."""
    free = (other for other in product(range(columns), range(lanes)) if other not in taken)
    return min(free, key=lambda other: (abs(other[0] - cell[0]) + abs(other[1] - cell[1]), other))
