"""Answer a request with the selected solver; fall back to others."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import attrs

from laneweave.coordinator.planning.budget import (
    DEFAULT_MEMORY_MB,
    Budget,
    BudgetSpentError,
    Clock,
    Stopwatch,
)
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.paper.assignments import Weights, assignments, matrices
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.plan_validator import problems_of_response
from laneweave.coordinator.planning.plug_ins.registry import PLANNERS, PlanLimits, check_solver
from laneweave.coordinator.planning.plug_ins.search import PluggedInSearch
from laneweave.coordinator.planning.prioritized import prioritized
from laneweave.coordinator.planning.problem import Problem, Search, Solution
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse, Status
from laneweave.coordinator.planning.shortest_paths import without_needless_moves

TAPPA_SHARE: Final = 0.75
"""Share of the deadline, and of the node limit, after which branching replaces TAPPA.

With more vehicles than the joint search can plan, TAPPA needs 3 to 5 s of CPU for 15,000 nodes, its
share of a scenario's default limit; branching needs 0.1 s for formations of six to eight (95th
percentile), at most 0.6 s.
"""
PLUG_IN_SHARE: Final = 0.5
"""Share of the deadline for a planner of a user; if it fails, built-in solvers need the rest."""
MAX_NODES: Final = 500_000
"""Node limit that keeps TAPPA's trees below about 1 GB; reaching it takes minutes."""


@attrs.frozen
class _Result:
    """The result of a solver, without the data structures of its search."""

    solver: str
    nodes: int
    found: Search


def plan(
    request: PlanRequest,
    *,
    max_nodes: int | None = None,
    max_memory_mb: float = DEFAULT_MEMORY_MB,
    weights: Weights | None = None,
    solver: str | None = None,
    fallback: bool = True,
    compiled_only: bool = False,
    clock: Clock = time.monotonic,
) -> PlanResponse:
    """Answer one request; check the plan with `plan_validator`.

    Identical requests get identical plans, unless the deadline passes first or is too short for the
    set-up of branching.

    Args:
        request: what to plan.
        max_nodes: limit on search nodes, for repeatable results; at most `MAX_NODES`.
        max_memory_mb: limit on the arrays of branch and bound. When it is reached, the other
            solver continues; a path set that is not proven optimal has status `feasible`.
        weights: weights that make the formation relative distance a lower bound on steps.
        solver: name of a solver or plug-in, overriding the request's; if neither names one, one
            is chosen (docs/PLANNING.md, "Which solver plans").
        fallback: branching continues when TAPPA has spent `TAPPA_SHARE`, and the cheaper path set
            is returned; where conflicts are rare and neither has one, prioritized planning looks
            for one. False: TAPPA may spend the whole budget, and plans alone. A solver that cannot
            handle the request at all, or a plug-in without a valid plan, is always replaced by
            others.
        compiled_only: without the compiled kernels of branching, TAPPA answers instead, without its
            joint search; False: they are compiled when they are needed, so that the plan does not
            depend on them.
        clock: returns the time for the deadline [s].

    Raises:
        BadInputError: there is no such solver, or it cannot be loaded.
        CacheError: the kernels cannot be compiled, see `kernels`.
        RuntimeError: the plan is invalid because of an error in the planner.
    """
    stopwatch = Stopwatch(clock)
    original, request = request, request.resolved()
    requested = solver or request.solver
    check_solver(requested)
    weights = (weights or Weights.for_mode(request.mode)).checked(request.mode)
    nodes = MAX_NODES if max_nodes is None else min(max_nodes, MAX_NODES)
    problem = request.problem()
    order = _order(requested, problem, fallback=fallback)
    if compiled_only and BRANCHING.known_missing:
        order = tuple(name for name in order if name != BRANCHING.name) or ("tappa",)
    results: list[_Result] = []
    for name in order:
        with stopwatch.paused():
            available = _load(name, compiled_only=compiled_only)
        if not available:
            continue
        is_limited = name == "tappa" and order[-1] != name
        share = TAPPA_SHARE if is_limited else 1.0
        left = nodes - sum(result.nodes for result in results)
        budget = Budget(
            deadline_s=share * request.deadline_s,
            max_nodes=math.ceil(share * left),
            max_memory_mb=max_memory_mb,
            compiled_only=compiled_only,
            stopwatch=stopwatch,
        )
        left_s = request.deadline_s - stopwatch.time_s
        limits = PlanLimits(max(PLUG_IN_SHARE * left_s, 0.0), math.ceil(left))
        results.append(_solve(name, problem, request, weights, budget, limits))
        if results[-1].found.finished or not (results[-1].found.aborted or is_limited):
            break
    rest = Budget(deadline_s=request.deadline_s, stopwatch=stopwatch)
    searches = [result.found for result in results]
    found = [search.best for search in reversed(searches) if search.best is not None]
    best = min(found, key=lambda solution: solution.cost, default=None)
    finished = any(search.finished for search in searches)
    if fallback and problem.is_sparse and best is None and not finished:
        best = _prioritized(problem, request, weights, rest)
    response = _response(request, problem, requested or results[0].solver, results, best, rest)
    if original.structure is not None:
        response = attrs.evolve(response, targets=request.targets)
    problems = problems_of_response(original, response)
    if problems:
        raise RuntimeError("the planner made an invalid plan: " + "; ".join(problems))
    return response


def _order(requested: str | None, problem: Problem, *, fallback: bool) -> tuple[str, ...]:
    """Return the solvers in the order in which to run them.

    Where conflicts are rare, TAPPA plans first: branching needs arrays over all cells and steps.
    """
    if requested is not None and not PLANNERS.is_built_in(requested):
        return (requested, *_order(None, problem, fallback=fallback))
    if problem.table.model.vehicles_share_cells:
        return ("tappa",)
    if requested == "tappa" or (requested is None and problem.is_sparse):
        return ("tappa", "branching") if fallback else ("tappa",)
    return ("branching", "tappa")


def _load(solver: str, *, compiled_only: bool) -> bool:
    """Load a solver; return whether it is available."""
    if solver == BRANCHING.name:
        return BRANCHING.available(compiled_only=compiled_only)
    prepare(solver)
    return True


def _solve(
    solver: str,
    problem: Problem,
    request: PlanRequest,
    weights: Weights,
    budget: Budget,
    limits: PlanLimits,
) -> _Result:
    """Run one solver until it finishes, aborts or has spent its budget.

    A plug-in has `limits`, which leave a part of the budget to other solvers.
    """
    found = Search()
    with suppress(BudgetSpentError):
        search: Search
        if PLANNERS.is_built_in(solver):
            search = PLANNERS.load(solver, "solver")(request, problem, weights, budget)
        else:
            from laneweave.coordinator.planning.plug_ins.process import ask_planner  # noqa: PLC0415

            search = PluggedInSearch(solver, request, problem, limits, budget, ask_planner)
        search.run()
        found = Search(**attrs.asdict(search, recurse=False))
    return _Result(solver, budget.nodes, found)


def _prioritized(
    problem: Problem, request: PlanRequest, weights: Weights, budget: Budget
) -> Solution | None:
    """Return a path set by prioritized planning for the cheapest assignment; None: none found."""
    with suppress(BudgetSpentError):
        assignment = next(assignments(*matrices(request, problem, weights, budget), budget), None)
        if assignment is not None:
            return prioritized(problem, assignment.targets, budget)
    return None


def _response(
    request: PlanRequest,
    problem: Problem,
    requested: str,
    results: Sequence[_Result],
    best: Solution | None,
    budget: Budget,
) -> PlanResponse:
    """Combine the best path set, if there is one, with the highest lower bound of the solvers."""
    searches = [result.found for result in results]
    is_own = PLANNERS.is_built_in(results[-1].solver)  # paths of a plug-in stay as they are
    if best is not None and is_own and not any(search.has_fewest_moves for search in searches):
        best = without_needless_moves(problem, best, budget)
    cells = [] if best is None else problem.cells_of(best)
    path_map = RelativePathMap.padded(request.ids[: len(cells)], cells)
    bound = max(search.lower_bound for search in searches)
    cost = None if best is None else best.cost
    finished = any(search.finished for search in searches) or cost == bound
    last = results[-1].solver
    return PlanResponse(
        status=_status(found=best is not None, finished=finished),
        cost=cost,
        lower_bound=None if math.isinf(bound) else int(bound if cost is None else min(bound, cost)),
        steps=None if best is None else path_map.steps,
        assignment=() if best is None else best.assignment,
        paths=path_map.rows,
        solve_ms=round(1e3 * budget.stopwatch.wall_s, 3),
        assignments_tried=sum(search.tried for search in searches),
        nodes_expanded=sum(result.nodes for result in results),
        solver=last,
        fallback=last != requested,
    )


def _status(*, found: bool, finished: bool) -> Status:
    if found:
        return "optimal" if finished else "feasible"
    return "infeasible" if finished else "timeout"


def prepare(solver: str | None, field: str = "solver", *, keep: bool = True) -> None:
    """Check that a solver exists; start the process of a plug-in, which imports it.

    Args:
        solver: name of the solver; None: none is named.
        field: field or option that contains it.
        keep: whether the process goes on, for plans of this process.

    Raises:
        BadInputError: there is no such solver, or it cannot be loaded.
    """
    check_solver(solver, field)
    if solver is not None and not PLANNERS.is_built_in(solver):
        from laneweave.coordinator.planning.plug_ins import process  # noqa: PLC0415

        process.load_planner(solver, field)
        if not keep:
            process.end_planner(solver)
