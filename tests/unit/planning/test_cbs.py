"""CBSA against a search over all joint states, for one assignment."""

import math

from hypothesis import assume, given, settings
from hypothesis import strategies as st

from laneweave.coordinator.planning import PlanRequest, problems_of_paths
from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.cbs import ConflictTree, Node, least_cover
from laneweave.coordinator.planning.facade import cells_of
from laneweave.coordinator.planning.incumbent import Solution
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.problem import Problem
from unit.planning.planning_oracles import cheapest_plan, requests

ENOUGH = 600


def _problem(request: PlanRequest) -> Problem:
    cells = [vehicle.cell for vehicle in request.vehicles]
    model = request.conflict_model
    return Problem(request.grid, request.mode, model, cells, request.targets)


def _assignment(request: PlanRequest) -> tuple[int, ...]:
    return tuple(range(len(request.vehicles)))


def _anyone_anywhere(request: PlanRequest) -> bool:
    return all(vehicle.eligible is None for vehicle in request.vehicles)


def _check(request: PlanRequest, problem: Problem, node: Node) -> None:
    solution = Solution(_assignment(request), node.paths)
    cells = cells_of(problem, solution)
    path_map = RelativePathMap.padded(["" for _ in cells], cells)
    assert problems_of_paths(request, solution.assignment, path_map.rows) == []
    assert path_map.cost() == node.cost


@settings(max_examples=60, deadline=None)
@given(requests())
def test_cost_is_that_of_the_joint_search(request: PlanRequest) -> None:
    assume(_anyone_anywhere(request))
    problem, assignment = _problem(request), _assignment(request)
    tree = ConflictTree(problem, assignment, Budget())
    node = tree.search(below=math.inf, nodes=ENOUGH)
    expected = cheapest_plan(request, fixed=assignment)
    if node is None:
        assert expected is None or tree.lower_bound <= expected
    else:
        assert node.cost == expected
        _check(request, problem, node)


@settings(max_examples=40, deadline=None)
@given(requests(most_vehicles=4, most_cells=12), st.integers(1, 3))
def test_interrupted_search_gives_the_same_answer(request: PlanRequest, nodes: int) -> None:
    problem, assignment = _problem(request), _assignment(request)
    whole = ConflictTree(problem, assignment, Budget())
    expected = whole.search(below=math.inf, nodes=300)
    tree = ConflictTree(problem, assignment, Budget())
    found, bounds = None, [tree.lower_bound]
    while found is None and tree.lower_bound < math.inf and tree.expanded < whole.expanded:
        found = tree.search(below=math.inf, nodes=min(nodes, whole.expanded - tree.expanded))
        bounds.append(tree.lower_bound)
    assert (found and found.paths) == (expected and expected.paths)
    assert bounds == sorted(bounds)


@settings(max_examples=40, deadline=None)
@given(requests(), st.integers(-1, 2))
def test_a_bound_from_elsewhere_hides_exactly_what_is_no_better(
    request: PlanRequest, margin: int
) -> None:
    problem, assignment = _problem(request), _assignment(request)
    best = ConflictTree(problem, assignment, Budget()).search(below=math.inf, nodes=300)
    assume(best is not None)
    assert best is not None
    tree = ConflictTree(problem, assignment, Budget())
    node = tree.search(below=best.cost + margin, nodes=1000)
    if margin > 0:
        assert node is not None
        assert node.cost == best.cost
    else:
        assert node is None
        assert tree.lower_bound >= best.cost + margin


@settings(deadline=None)
@given(st.sets(st.tuples(st.integers(0, 4), st.integers(5, 8)), max_size=9))
def test_least_cover(edges: set[tuple[int, int]]) -> None:
    expected = min(
        chosen.bit_count()
        for chosen in range(1 << 9)
        if all(chosen >> a & 1 or chosen >> b & 1 for a, b in edges)
    )
    assert least_cover(sorted(edges)) == expected
