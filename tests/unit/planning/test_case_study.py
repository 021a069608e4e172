"""Every number that the paper prints for its case study (section `case`).

The figure is not in the source; this instance reproduces the text. Cells here count from 0, the
names of vehicles, targets and nodes from 1 as in the paper.
"""

import pytest

from laneweave.coordinator.planning import PlanRequest, VehicleRequest, plan, problems_of_response
from laneweave.coordinator.planning.assignments import Assignment, assignments
from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.cbs import ConflictTree
from laneweave.coordinator.planning.conflict_tree import expand_all, root
from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.frd import Weights, cost_matrix
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.preference import preference_matrix
from laneweave.coordinator.planning.problem import Problem

CELLS = ((0, 0), (0, 2), (1, 1), (2, 0), (2, 2))
VEHICLE_GROUPS = (1, 1, 2, 2, 3)
TARGET_GROUPS = (1, 2, 3, 1, 2)
KINDS = ("node", "edge")

CHOICES = [
    tuple(j for j, group in enumerate(TARGET_GROUPS) if group == wish) for wish in VEHICLE_GROUPS
]


@pytest.fixture(params=[3, 5], ids=["3 columns", "5 columns"])
def problem(request: pytest.FixtureRequest) -> Problem:
    return Problem(Grid(request.param, 3), 2, ConflictModel(KINDS), CELLS, CELLS)


def _assignments() -> list[Assignment]:
    costs = cost_matrix(CELLS, CELLS, Weights(straight=1, oblique=1))
    return list(assignments(costs, preference_matrix([frozenset(c) for c in CHOICES], 5)))


def _best_cost(problem: Problem, assignment: Assignment) -> int:
    node = ConflictTree(problem, assignment.targets, Budget()).search(below=99, nodes=10_000)
    assert node is not None
    return node.cost


def test_assignments() -> None:
    first, second, third = _assignments()[:3]
    assert [j + 1 for j in first.targets] == [1, 4, 2, 5, 3]
    assert [j + 1 for j in second.targets] == [1, 4, 5, 2, 3]
    assert [first.cost, second.cost, third.cost] == [6, 6, 8]


def test_root_has_a_node_conflict_of_2_and_5_and_an_edge_conflict_of_2_and_3(
    problem: Problem,
) -> None:
    n1 = root(problem, _assignments()[0].targets)
    assert n1 is not None
    assert n1.cost == 6
    assert n1.constraints == ()
    assert [str(entry) for entry in n1.conflicts] == [
        "{N | (1,1), 1, 2}",
        "{N | (1,1), 1, 5}",
        "{E | (0,2), (1,1), 1, 2}",
        "{E | (1,1), (0,2), 1, 3}",
    ]


def test_n2_and_n4_are_feasible_with_cost_7_and_n3_and_n5_have_conflicts(problem: Problem) -> None:
    a1 = _assignments()[0].targets
    n1 = root(problem, a1)
    assert n1 is not None
    n2, n3, n4, n5 = expand_all(problem, a1, n1)
    assert [node.constraints for node in (n2, n3, n4, n5)] == [(e,) for e in n1.conflicts]
    assert n2.conflicts == ()
    assert n4.conflicts == ()
    assert n2.cost == n4.cost == 7
    assert n3.conflicts != ()
    assert n5.conflicts != ()
    assert len(expand_all(problem, a1, n3)) == len(n3.conflicts)


def test_best_path_sets_of_both_assignments(problem: Problem) -> None:
    first, second = _assignments()[:2]
    assert _best_cost(problem, first) == 7
    assert _best_cost(problem, second) == 8


def test_relative_path_map_of_the_root(problem: Problem) -> None:
    n1 = root(problem, _assignments()[0].targets)
    assert n1 is not None
    assert str(n1.path_map).splitlines() == [
        "Vehicle ID  step 1  step 2  step 3",
        "1           (0,0)   (0,0)   (0,0)",
        "2           (0,2)   (1,1)   (2,0)",
        "3           (1,1)   (0,2)   (0,2)",
        "4           (2,0)   (2,1)   (2,2)",
        "5           (2,2)   (1,1)   (1,1)",
    ]


def test_planner_proves_7() -> None:
    vehicles = tuple(
        VehicleRequest(f"{i + 1}", cell, eligible=CHOICES[i]) for i, cell in enumerate(CELLS)
    )
    request = PlanRequest(Grid(3, 3), 2, KINDS, vehicles, CELLS, deadline_s=60.0)
    response = plan(request)
    assert (response.status, response.cost, response.lower_bound) == ("optimal", 7, 7)
    assert [j + 1 for j in response.assignment] == [1, 4, 2, 5, 3]
    assert problems_of_response(request, response) == []
