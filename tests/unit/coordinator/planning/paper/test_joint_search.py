"""The joint search against Dijkstra's algorithm over all joint states of single vehicles."""

import math

import attrs
import pytest
from hypothesis import given

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.paper.assignments import Weights
from laneweave.coordinator.planning.paper.cbs import Improvements
from laneweave.coordinator.planning.paper.joint_search import JointSearch
from laneweave.coordinator.planning.paper.tappa import Tappa
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.plan_validator import problems_of_paths
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import traffic_request
from support.examples import examples
from support.planning_oracles import cheapest_plan, requests


@pytest.mark.slow
@examples(60)
@given(requests())
def test_path_set_is_optimal_and_legal_or_there_is_none(request: PlanRequest) -> None:
    problem = request.problem()
    search = JointSearch(problem, request.choices(), Budget())
    expected = cheapest_plan(request)
    bounds = [search.lower_bound]
    while not search.ended:
        search.work(10)
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
