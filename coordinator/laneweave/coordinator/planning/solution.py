"""A conflict-free path set, and how it is rid of needless moves."""

from __future__ import annotations

import attrs

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.paper.path_diagram import Bans, shortest_paths
from laneweave.coordinator.planning.paper.sppa import Path, choose_path
from laneweave.coordinator.planning.problem import Problem


@attrs.frozen
class Solution:
    """A conflict-free path set for an assignment."""

    assignment: tuple[int, ...]
    paths: tuple[Path, ...]

    @property
    def cost(self) -> int:
        """Return the cost of the path set."""
        return sum(len(path) for path in self.paths)


def tidied(problem: Problem, solution: Solution, budget: Budget) -> Solution:
    """Return the path set without needless moves.

    Each vehicle in turn takes, among its cheapest paths around all others, the one with the
    fewest moves. Stops when nothing changes any more, or when time is up.
    """
    while True:
        before = solution
        for vehicle in range(len(solution.paths)):
            try:
                budget.check_time()
            except BudgetSpentError:
                return solution
            solution = _tidied_for(problem, solution, vehicle)
        if solution == before:
            return solution


def _tidied_for(problem: Problem, solution: Solution, vehicle: int) -> Solution:
    bans = Bans()
    for other, path in enumerate(solution.paths):
        if other != vehicle:
            _avoid(problem, bans, path, problem.targets[solution.assignment[other]])
    target = problem.targets[solution.assignment[vehicle]]
    diagram = shortest_paths(problem.table, problem.starts[vehicle], target, bans)
    if diagram is None:
        return solution
    path = choose_path(problem.table, diagram, [0] * diagram.cost)
    paths = (*solution.paths[:vehicle], path, *solution.paths[vehicle + 1 :])
    return Solution(solution.assignment, paths)


def _avoid(problem: Problem, bans: Bans, path: Path, target: int) -> None:
    """Add all moves that conflict with a path, and with waiting at its target ever after."""
    conflicts = problem.table.conflicts
    for step, move in enumerate(path):
        bans.at[step] = bans.at.get(step, 0) | conflicts[move]
    bans.since[len(path)] = bans.since.get(len(path), 0) | conflicts[target]
