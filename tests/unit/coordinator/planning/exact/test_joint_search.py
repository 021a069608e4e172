"""The joint search against Dijkstra's algorithm over all joint states of single vehicles."""

import math
from itertools import product
from random import Random

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError, Stopwatch
from laneweave.coordinator.planning.exact import joint_search
from laneweave.coordinator.planning.exact.joint_search import JointSearch
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.paper.assignments import Weights
from laneweave.coordinator.planning.paper.cbs import Improvements
from laneweave.coordinator.planning.paper.tappa import Tappa
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.plan_validator import problems_of_paths
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import traffic_request
from laneweave.protocol.lattice import Mode
from support.examples import examples
from support.planning_oracles import CountingClock, cheapest_plan, requests


@pytest.mark.slow
@examples(60)
@given(requests(), st.sampled_from((1, 10, 1000)))
def test_path_set_is_optimal_and_legal_or_there_is_none(request: PlanRequest, moves: int) -> None:
    problem = request.problem()
    search = JointSearch(problem, request.choices(), Budget())
    expected = cheapest_plan(request)
    bounds = [search.lower_bound]
    while not search.ended:
        search.work(moves)
        bounds.append(search.lower_bound)
        assert search.lower_bound <= (math.inf if expected is None else expected)
    assert bounds == sorted(bounds)
    if expected is None:
        assert search.solution is None
        assert search.lower_bound == math.inf
        return
    assert search.solution is not None
    assert search.solution.cost == search.lower_bound == expected
    rows = RelativePathMap.padded(
        [vehicle.id for vehicle in request.vehicles], problem.cells_of(search.solution)
    ).rows
    assert problems_of_paths(request, search.solution.assignment, rows) == []


def crowded() -> tuple[Problem, list[frozenset[int]]]:
    """Return a formation for which the search needs more states than it begins with room for."""
    request = traffic_request(_crowded_seed())
    cells = tuple(product(range(request.grid.columns), range(request.grid.lanes)))
    request = attrs.evolve(request, targets=cells)
    return request.problem(), request.choices()


def searched(moves: int, budget: Budget | None = None) -> JointSearch:
    """Search in portions of some moves."""
    search = JointSearch(*crowded(), budget or Budget())
    while not search.ended:
        search.work(moves)
    return search


def test_result_does_not_depend_on_portions_or_on_room(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = searched(10_000_000)
    assert whole.solution is not None
    assert [searched(moves).solution for moves in (1000, 33)] == 2 * [whole.solution]
    monkeypatch.setattr(joint_search, "_FIRST_STATES", 64)
    assert searched(1_000_000).solution == whole.solution


def test_nothing_at_or_above_a_given_cost_is_sought() -> None:
    cost = searched(10_000_000).lower_bound
    for below in (cost, cost - 1, cost + 1):
        search = JointSearch(*crowded(), Budget())
        while not search.ended:
            search.work(100_000, below)
        assert (search.solution is None) == (below <= cost)
        assert search.lower_bound == min(below, cost)


@pytest.mark.parametrize(("max_memory_mb", "begins"), [(0.1, False), (1.5, True)])
def test_it_ends_without_proof_at_the_memory_limit(max_memory_mb: float, begins: bool) -> None:
    search = searched(1_000_000, Budget(max_memory_mb=max_memory_mb))
    assert search.solution is None
    assert (search.lower_bound > 0) == begins
    assert search.lower_bound <= searched(10_000_000).lower_bound


def test_it_ends_without_proof_after_many_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_search, "_MAX_MOVES", 10_000)
    search = searched(1000)
    assert search.solution is None
    assert 0 < search.lower_bound <= searched(1000).lower_bound


def test_many_vehicles_that_take_all_targets_have_one_goal() -> None:
    grid = Grid(20, 3)
    cells = [*product(range(20), range(3))]
    vehicles = tuple(VehicleRequest(f"v{i}", cell) for i, cell in enumerate(cells[:36]))
    request = PlanRequest(grid, 1, ("node", "edge"), vehicles, tuple(cells[-36:]), 3600.0)
    search = JointSearch(request.problem(), request.choices(), Budget())
    search.work(1)
    assert not search.ended
    assert search.lower_bound > 0


def test_it_stops_at_the_deadline_and_may_go_on() -> None:
    clock = CountingClock(0.001)
    search = JointSearch(*crowded(), Budget(deadline_s=0.003, stopwatch=Stopwatch(clock)))
    with pytest.raises(BudgetSpentError):
        search.work(10_000_000)
    assert not search.ended
    assert clock.now_s < 0.005


@pytest.mark.parametrize("mode", [1, 2])
@pytest.mark.parametrize(("vehicles", "columns", "lanes"), [(5, 3, 2), (6, 4, 2), (7, 3, 3)])
def test_nearly_full_boards_with_own_targets(
    vehicles: int, columns: int, lanes: int, mode: Mode
) -> None:
    rng = Random(10 * vehicles + mode)
    cells = [*product(range(columns), range(lanes))]
    for _ in range(5):
        targets = tuple(rng.sample(cells, vehicles))
        starts = rng.sample(cells, vehicles)
        asked = tuple(VehicleRequest(f"v{i}", starts[i], eligible=(i,)) for i in range(vehicles))
        request = PlanRequest(Grid(columns, lanes), mode, ("node", "edge"), asked, targets, 3600.0)
        search = JointSearch(request.problem(), request.choices(), Budget())
        search.work(20_000_000)
        assert search.solution is not None
        assert search.solution.cost == plan(request, solver="branching").cost


@pytest.mark.slow
@pytest.mark.more
def test_a_crowded_formation_is_solved_while_trees_do_not_end() -> None:
    request = traffic_request(_crowded_seed(), deadline_s=60.0)
    outcomes = []
    for switches in (Improvements(), attrs.evolve(Improvements(), joint=False)):
        budget = Budget(max_nodes=1_500)
        weights = Weights.for_mode(request.mode)
        run = Tappa(request, request.problem(), weights, budget, switches)
        run.run()
        outcomes.append((run.finished, run.best_cost))
        assert run.lower_bound <= run.best_cost
    assert outcomes == [(True, plan(request).cost), (False, math.inf)]


def _crowded_seed() -> int:
    """Return the first seed whose formation fills six of nine cells and is far from its lanes."""
    return next(
        seed
        for seed in range(1000)
        if (request := traffic_request(seed)).grid.columns == 3
        and len(request.vehicles) == 6
        and sum(v.cell[1] != v.lane for v in request.vehicles) == 6
    )
