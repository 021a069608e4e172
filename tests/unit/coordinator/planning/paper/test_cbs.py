"""CBSA against a search over all joint states, for one assignment and with every switch."""

import math

import attrs
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.paper.cbs import ConstraintTree, Improvements, Node
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.plan_validator import problems_of_paths
from laneweave.coordinator.planning.problem import Solution
from laneweave.coordinator.planning.request import PlanRequest
from support.examples import examples
from support.planning_oracles import cheapest_plan, requests

ENOUGH = 600
EVERY_SWITCH = st.builds(Improvements, cardinal=st.booleans(), bicliques=st.booleans())


def _assignment(request: PlanRequest) -> tuple[int, ...]:
    return tuple(range(len(request.vehicles)))


def _tree(request: PlanRequest, switches: Improvements, nodes: int = ENOUGH) -> ConstraintTree:
    budget = Budget(max_nodes=nodes)
    return ConstraintTree(request.problem(), _assignment(request), budget, switches, record=True)


def _search(tree: ConstraintTree, limit: float = math.inf) -> Node | None:
    """Search until the end or the node limit."""
    try:
        return tree.search(lambda: limit)
    except BudgetSpentError:
        return None


@pytest.mark.slow
@examples(40)
@given(requests(), EVERY_SWITCH)
def test_cost_is_that_of_the_joint_search(request: PlanRequest, switches: Improvements) -> None:
    assume(all(vehicle.eligible is None for vehicle in request.vehicles))
    tree = _tree(request, switches)
    node = _search(tree)
    expected = cheapest_plan(request, fixed=_assignment(request))
    if node is None:
        assert expected is None or tree.lower_bound <= expected
        return
    assert node.cost == expected
    problem = request.problem()
    cells = problem.cells_of(Solution(_assignment(request), node.paths))
    path_map = RelativePathMap.padded(["" for _ in cells], cells)
    assert problems_of_paths(request, _assignment(request), path_map.rows) == []
    assert path_map.cost() == node.cost


@examples(40)
@given(requests(), st.integers(-1, 2))
def test_a_limit_excludes_exactly_the_solutions_that_are_not_better(
    request: PlanRequest, margin: int
) -> None:
    best = _search(_tree(request, Improvements(), 300))
    assume(best is not None)
    assert best is not None
    node = _search(_tree(request, Improvements(), 1000), best.cost + margin)
    assert (None if node is None else node.cost) == (best.cost if margin > 0 else None)


@examples(40)
@given(requests(most_vehicles=4, most_cells=12))
def test_a_literal_node_has_a_child_for_each_entry_of_its_conflict_list(
    request: PlanRequest,
) -> None:
    tree = _tree(request, Improvements.none(), 40)
    _search(tree)
    assert tree.nodes is not None
    for node in tree.nodes:
        children = [child for child in tree.nodes if child.parent == node.number]
        if not node.expanded:
            assert children == []
            continue
        assert len(children) <= 2 * len(node.conflicts)
        for child in children:
            assert child.constraints[:-1] == node.constraints
            assert child.cost >= node.cost
        added = [child.constraints[-1] for child in children]
        assert {c.vehicle for c in added} <= {v for c in node.conflicts for v in c[2:]}


@pytest.mark.parametrize("name", [field.name for field in attrs.fields(Improvements)])
def test_without_improvements_every_switch_is_off(name: str) -> None:
    assert getattr(Improvements(), name) is True
    assert getattr(Improvements.none(), name) is False
