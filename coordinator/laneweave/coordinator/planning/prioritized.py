"""Prioritized planning: vehicles are planned one after another, each around those before it.

Where conflicts are rare it soon finds a path set, without a bound on its cost (Erdmann and
Lozano-Pérez, On multiple moving objects, Algorithmica 2, 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.problem import Bans, Diagram, MoveTable, Path, Problem, Solution
from laneweave.coordinator.planning.shortest_paths import ban_conflicts, free_paths, paths_of

_MAX_ATTEMPTS: Final = 10


def prioritized(problem: Problem, targets: Sequence[int], budget: Budget) -> Solution | None:
    """Return a path set; None: none was found.

    Vehicles with long paths come first. A vehicle without a path is the first one of the next
    attempt.

    Args:
        problem: vehicles and targets.
        targets: index of each vehicle's target.
        budget: deadline.

    Raises:
        BudgetSpentError: the deadline has passed.
    """
    costs: list[int] = []
    for vehicle, number in enumerate(targets):
        budget.check_time()
        free = free_paths(problem, vehicle, number)
        if free is None:
            return None
        costs.append(free.cost)
    max_steps = max(costs) + len(targets)
    order = sorted(range(len(targets)), key=lambda vehicle: -costs[vehicle])
    for _ in range(_MAX_ATTEMPTS):
        bans = Bans(latest=max_steps)
        paths: dict[int, Path] = {}
        for vehicle in order:
            budget.check_time()
            target = problem.targets[targets[vehicle]]
            diagram = paths_of(problem, vehicle, target, bans)
            if diagram is None:
                order = [vehicle, *(other for other in order if other != vehicle)]
                break
            paths[vehicle] = _first_path(problem.table, diagram, problem.starts[vehicle])
            ban_conflicts(problem, bans, paths[vehicle], target)
        else:
            return Solution(tuple(targets), tuple(paths[i] for i in range(len(targets))))
    return None


def _first_path(table: MoveTable, diagram: Diagram, start: int) -> Path:
    """Return a path of a diagram that waits as soon as possible."""
    cell, path = start, []
    for layer in diagram.layers:
        moves = layer >> cell & table.every
        path.append(cell + (moves & -moves).bit_length() - 1)
        cell = table.landing(path[-1])
    return tuple(path)
