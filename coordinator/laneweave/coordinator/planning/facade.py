"""One call that plans one request."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Final, Literal, Protocol

import numpy as np

from laneweave.coordinator.planning.assignments import assignments
from laneweave.coordinator.planning.budget import Budget, BudgetSpentError, Clock
from laneweave.coordinator.planning.clearances import close_pairs
from laneweave.coordinator.planning.frd import IntMatrix, Weights, cost_matrix
from laneweave.coordinator.planning.grid import Cell
from laneweave.coordinator.planning.improvements import Improvements
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.preference import BoolMatrix, preference_matrix
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse, Status
from laneweave.coordinator.planning.rows import vehicles_share_cells
from laneweave.coordinator.planning.solution import Solution, tidied
from laneweave.coordinator.planning.tappa import Tappa
from laneweave.coordinator.planning.validate import problems_of_response

Solver = Literal["tappa", "branching"]
"""`tappa`: the paper's algorithm. `branching`: branch and bound with prices, for large formations;
what it cannot do, because vehicles may share a cell or tables get too large, `tappa` does."""

MAX_NODES: Final = 500_000
"""Bounds the memory to about 1 GB; it takes minutes to get there."""


class Search(Protocol):
    """A search for the best path set, by whatever solver."""

    lower_bound: float
    """No path set costs less; infinite: there is none."""
    finished: bool
    """The search is complete: `best` is optimal, or nothing exists."""
    gave_up: bool
    """Another solver is the better tool for this problem."""
    tried: int
    """Assignments that were looked at one by one."""
    has_fewest_moves: bool
    """Nothing as cheap as `best` has fewer moves, for certain."""

    @property
    def best(self) -> Solution | None:
        """The cheapest path set so far."""

    def run(self) -> None:
        """Search until the optimum is proven or the budget is spent."""


def plan(
    request: PlanRequest,
    *,
    max_nodes: int | None = None,
    weights: Weights | None = None,
    solver: Solver = "branching",
    clock: Clock = time.monotonic,
) -> PlanResponse:
    """Plan one request.

    Equal requests get equal plans unless the deadline passes first; `max_nodes` limits the search
    in a repeatable way, and is never above `MAX_NODES`. `weights` of the formation relative
    distance must give a lower bound.
    """
    if solver == "branching":
        _warm_up_branching()  # not on the request's time
    if request.geometry is not None:
        close_pairs(request.geometry)  # nor is its table
    started = clock()
    weights = (weights or Weights.for_mode(request.mode)).checked(request.mode)
    nodes = MAX_NODES if max_nodes is None else min(max_nodes, MAX_NODES)
    budget = Budget(deadline=started + request.deadline_s, max_nodes=nodes, clock=clock)
    problem = problem_of(request)
    choices = request.choices()
    searches: list[Search] = []
    with suppress(BudgetSpentError):
        for search in _searches(solver, problem, request, weights, choices, budget):
            searches.append(search)
            search.run()
            if not search.gave_up:
                break
    found = [search.best for search in searches if search.best is not None]
    best = min(found, key=lambda solution: solution.cost, default=None)
    if best is not None and not any(search.has_fewest_moves for search in searches):
        best = tidied(problem, best, budget)
    cells = [] if best is None else cells_of(problem, best)
    path_map = RelativePathMap.padded([v.id for v in request.vehicles][: len(cells)], cells)
    bound = max((search.lower_bound for search in searches), default=0)
    cost = None if best is None else best.cost
    finished = any(search.finished for search in searches) or cost == bound
    return PlanResponse(
        status=_status(found=best is not None, finished=finished),
        cost=cost,
        lower_bound=None if math.isinf(bound) else int(bound if cost is None else min(bound, cost)),
        steps=None if best is None else path_map.steps,
        assignment=() if best is None else best.assignment,
        paths=path_map.rows,
        solve_ms=round(1e3 * (clock() - started), 3),
        assignments_tried=sum(search.tried for search in searches),
        nodes_expanded=budget.nodes,
    )


def warm_up() -> None:
    """Load the compiled parts of the planners; where there are none yet, compile them.

    Loading takes a second, compiling a minute.
    """
    from laneweave.coordinator.planning import stream  # noqa: PLC0415 (numba is slow to load)

    _warm_up_branching()
    stream.warm_up()


def _warm_up_branching() -> None:
    from laneweave.coordinator.planning import branching  # noqa: PLC0415

    branching.warm_up()


def _searches(
    solver: Solver,
    problem: Problem,
    request: PlanRequest,
    weights: Weights,
    choices: list[frozenset[int]],
    budget: Budget,
) -> Iterator[Search]:
    """Yield what to search with; the next one where one gives up."""
    if solver == "branching":
        from laneweave.coordinator.planning.branching import Branching  # noqa: PLC0415

        if not vehicles_share_cells(problem.table.model):
            yield Branching(problem, choices, budget)
    yield new_tappa(problem, request, weights, budget)


def new_tappa(
    problem: Problem,
    request: PlanRequest,
    weights: Weights,
    budget: Budget,
    improvements: Improvements | None = None,
    *,
    record: bool = False,
) -> Tappa:
    """Return Algorithm 1, ready to run; see `Tappa`."""
    choices = request.choices()
    costs, allowed = matrices(request, weights, choices, budget)
    candidates = assignments(costs, allowed, budget)
    return Tappa(problem, candidates, choices, budget, improvements, record=record)


def problem_of(request: PlanRequest) -> Problem:
    """Return the problem of a request."""
    cells = [vehicle.cell for vehicle in request.vehicles]
    return Problem(request.grid, request.mode, request.conflict_model, cells, request.targets)


def _status(*, found: bool, finished: bool) -> Status:
    if found:
        return "optimal" if finished else "feasible"
    return "infeasible" if finished else "timeout"


def cells_of(problem: Problem, solution: Solution) -> list[list[Cell]]:
    """Return the paths as cells, each beginning at the vehicle's start."""
    table = problem.table
    return [
        [table.cell(start), *(table.cell(table.landing(move)) for move in path)]
        for start, path in zip(problem.starts, solution.paths, strict=True)
    ]


def checked_plan(
    request: PlanRequest,
    *,
    max_nodes: int | None = None,
    weights: Weights | None = None,
    solver: Solver = "branching",
) -> PlanResponse:
    """Plan one request and check the answer against it; see `plan`.

    Raises:
        RuntimeError: the answer is wrong, which would be an error in the planner.
    """
    response = plan(request, max_nodes=max_nodes, weights=weights, solver=solver)
    problems = problems_of_response(request, response)
    if problems:
        raise RuntimeError("the planner made a wrong plan: " + "; ".join(problems))
    return response


def matrices(
    request: PlanRequest, weights: Weights, choices: list[frozenset[int]], budget: Budget
) -> tuple[IntMatrix, BoolMatrix]:
    """Return the cost matrix C and the preference matrix P of a request.

    Blocked cells may make the way longer than the formation relative distance, or cut it off.
    Both only sharpen the lower bound: C takes the larger number, P drops unreachable targets.
    """
    starts = [vehicle.cell for vehicle in request.vehicles]
    costs = cost_matrix(starts, request.targets, weights)
    allowed = preference_matrix(choices, len(request.targets))
    if request.grid.blocked:
        for i, start in enumerate(starts):
            budget.check_time()
            distances = request.grid.distances(start, request.mode, request.targets)
            for j, target in enumerate(request.targets):
                if target in distances:
                    costs[i, j] = max(costs[i, j], distances[target])
                else:
                    allowed[i, j] = np.False_
    return costs, allowed
