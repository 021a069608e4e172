"""The joint search against Dijkstra's algorithm over all joint states of single vehicles."""

import math

from hypothesis import given, settings

from laneweave.coordinator.planning import PlanRequest, problems_of_paths
from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.facade import cells_of, problem_of
from laneweave.coordinator.planning.joint import JointSearch
from laneweave.coordinator.planning.path_map import RelativePathMap
from unit.planning.planning_oracles import cheapest_plan, requests


@settings(max_examples=150, deadline=None)
@given(requests())
def test_path_set_is_optimal_and_legal_or_there_is_none(request: PlanRequest) -> None:
    problem = problem_of(request)
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
        [vehicle.id for vehicle in request.vehicles], cells_of(problem, search.solution)
    ).rows
    assert problems_of_paths(request, search.solution.assignment, rows) == []
