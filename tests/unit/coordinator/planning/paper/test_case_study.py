"""Every number that the paper prints for its case study (section `case`).

The figure is not in the source; this instance reproduces the text. Cells here count from 0, the
names of vehicles, targets and nodes from 1 as in the paper.
"""

import math

import pytest

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.paper.assignments import (
    Assignment,
    Weights,
    assignments,
    cost_matrix,
    preference_matrix,
)
from laneweave.coordinator.planning.paper.cbs import ConstraintTree, Improvements, Node
from laneweave.coordinator.planning.paper.explanation import entries
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.problem import Problem, Solution

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


def _searched(problem: Problem, assignment: Assignment, switches: Improvements) -> ConstraintTree:
    tree = ConstraintTree(problem, assignment.targets, Budget(), switches, record=True)
    tree.search(lambda: math.inf)
    return tree


def _nodes(problem: Problem) -> list[Node]:
    nodes = _searched(problem, _assignments()[0], Improvements.none()).nodes
    assert nodes is not None
    return nodes


def _entries(problem: Problem, node: Node) -> list[str]:
    return list(entries(problem.table, node, ["1", "2", "3", "4", "5"]))


def test_assignments() -> None:
    first, second, third = _assignments()[:3]
    assert [j + 1 for j in first.targets] == [1, 4, 2, 5, 3]
    assert [j + 1 for j in second.targets] == [1, 4, 5, 2, 3]
    assert [first.cost, second.cost, third.cost] == [6, 6, 8]


def test_root_has_a_node_conflict_of_2_and_5_and_an_edge_conflict_of_2_and_3(
    problem: Problem,
) -> None:
    n1 = _nodes(problem)[0]
    assert n1.cost == 6
    assert n1.constraints == ()
    assert _entries(problem, n1) == [
        "{N | (1,1), 1, 2}",
        "{N | (1,1), 1, 5}",
        "{E | (0,2), (1,1), 1, 2}",
        "{E | (1,1), (0,2), 1, 3}",
    ]


def test_n2_and_n4_are_feasible_with_cost_7_and_n3_and_n5_have_conflicts(problem: Problem) -> None:
    n1, n2, n3, n4, n5 = _nodes(problem)
    assert [node.parent for node in (n2, n3, n4, n5)] == [1, 1, 1, 1]
    constraints = [node.constraints[0] for node in (n2, n3, n4, n5)]
    names = ["1", "2", "3", "4", "5"]
    assert [c.notation(problem.table, names[c.vehicle]) for c in constraints] == _entries(
        problem, n1
    )
    assert n2.conflicts == ()
    assert n4.conflicts == ()
    assert n2.cost == n4.cost == 7
    assert n3.conflicts != ()
    assert n5.conflicts != ()


@pytest.mark.parametrize("switches", [Improvements.none(), Improvements()], ids=["literal", "fast"])
def test_best_path_sets_of_both_assignments(problem: Problem, switches: Improvements) -> None:
    costs = []
    for assignment in _assignments()[:2]:
        solution = _searched(problem, assignment, switches).solution
        assert solution is not None
        costs.append(solution.cost)
    assert costs == [7, 8]


def test_relative_path_map_of_the_root(problem: Problem) -> None:
    n1 = _nodes(problem)[0]
    cells = problem.cells_of(Solution(_assignments()[0].targets, n1.paths))
    assert str(RelativePathMap.padded(["1", "2", "3", "4", "5"], cells)).splitlines() == [
        "Vehicle ID  step 0  step 1  step 2",
        "1           (0,0)   (0,0)   (0,0)",
        "2           (0,2)   (1,1)   (2,0)",
        "3           (1,1)   (0,2)   (0,2)",
        "4           (2,0)   (2,1)   (2,2)",
        "5           (2,2)   (1,1)   (1,1)",
    ]
