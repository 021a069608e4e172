"""A planner of a user as a solver: its plans are checked before they are used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import structlog

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.path_map import final_arrival
from laneweave.coordinator.planning.plan_validator import problems_of_paths
from laneweave.coordinator.planning.plug_ins.registry import (
    PlainPaths,
    PlanLimits,
    PlannerFailedError,
)
from laneweave.coordinator.planning.problem import Problem, Search, Solution
from laneweave.coordinator.planning.request import MAX_STEPS, PlanRequest
from laneweave.protocol.lattice import Cell

log = structlog.get_logger(__name__)

_PROBLEMS_SHOWN: Final = 3


class PluggedInSearch(Search):
    """The search of a planner of a user; aborts if there is no valid plan."""

    def __init__(
        self,
        name: str,
        request: PlanRequest,
        problem: Problem,
        limits: PlanLimits,
        budget: Budget,
        ask: Callable[[str, PlanRequest, PlanLimits, Budget], PlainPaths],
    ) -> None:
        """Prepare the search.

        Args:
            name: name of the planner.
            request: what to plan, with targets.
            problem: the same request in the form that the searches use.
            limits: limits of the planner.
            budget: budget of the whole plan, so that built-in solvers have time left.
            ask: asks the planner for paths.
        """
        super().__init__()
        self._name = name
        self._request = request
        self._problem = problem
        self._limits = limits
        self._budget = budget
        self._ask = ask

    def run(self) -> None:
        """Ask the planner, and check its plan."""
        self.aborted = True
        try:
            paths = self._ask(self._name, self._request, self._limits, self._budget)
            self.best = _solution(self._request, self._problem, paths)
        except (PlannerFailedError, BudgetSpentError) as error:
            reason = str(error) or "it spent the budget"
            log.warning("a planner failed, built-in ones plan", solver=self._name, reason=reason)
            return
        self.aborted = False
        self.lower_bound = _lower_bound(self._request)


def _solution(
    request: PlanRequest, problem: Problem, paths: Sequence[tuple[Cell, ...]]
) -> Solution:
    """Return paths as a solution.

    Raises:
        PlannerFailedError: the paths are not valid.
    """
    steps = max(map(len, paths), default=0) - 1
    if not all(paths) or steps > MAX_STEPS:
        raise PlannerFailedError(f"an invalid plan: paths have 1 to {MAX_STEPS} cells")
    padded = [path + (path[-1],) * (steps + 1 - len(path)) for path in paths]
    targets = {cell: number for number, cell in enumerate(request.targets)}
    for vehicle, path in zip(request.vehicles, padded, strict=False):
        if path[-1] not in targets:
            raise PlannerFailedError(f"an invalid plan: {vehicle.id} ends at {path[-1]}, no target")
    assignment = tuple(targets[path[-1]] for path in padded[: len(request.vehicles)])
    problems = problems_of_paths(request, assignment, padded)
    if problems:
        more = (
            ""
            if len(problems) <= _PROBLEMS_SHOWN
            else f"; and {len(problems) - _PROBLEMS_SHOWN} more"
        )
        shown = "; ".join(problems[:_PROBLEMS_SHOWN])
        raise PlannerFailedError(f"an invalid plan: {shown}{more}")
    number = problem.table.number
    moves = tuple(
        tuple(number((path[step], path[step + 1])) for step in range(final_arrival(path)))
        for path in padded
    )
    return Solution(assignment, moves)


def _lower_bound(request: PlanRequest) -> int:
    """Return a lower bound on the cost: each vehicle takes the nearest target, without others."""

    def steps(start: Cell, target: Cell) -> int:
        columns, lanes = abs(start[0] - target[0]), abs(start[1] - target[1])
        return columns + lanes if request.mode == 1 else max(columns, lanes)

    return sum(
        min(steps(vehicle.cell, request.targets[target]) for target in choice)
        for vehicle, choice in zip(request.vehicles, request.choices(), strict=True)
    )
