"""The record by `explain` must agree with the run of the algorithms."""

import json
import math
from pathlib import Path

import attrs
import pytest

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.paper.explanation import ExplainedAssignment, explain
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import block_request, traffic_request
from support.variants import variants

CASE_STUDY = Path(__file__).parents[4] / "docs" / "examples" / "case-study.json"


def _case_study() -> PlanRequest:
    return PlanRequest.from_dict(json.loads(CASE_STUDY.read_text(encoding="utf-8")))


def _check_tree(one: ExplainedAssignment) -> None:
    """Costs do not decrease from parent to child; the solution has no conflicts."""
    by_number = {node.number: node for node in one.nodes}
    assert [node.number for node in one.nodes] == list(range(1, len(one.nodes) + 1))
    for node in one.nodes[1:]:
        assert node.constraint
        assert node.parent < node.number
        assert node.cost >= by_number[node.parent].cost
        assert by_number[node.parent].status == "expanded"
    for node in one.nodes:
        assert node.cost == node.path_map.cost()
        if node.status == "solution":
            assert not node.conflicts
            assert node.cost == one.best_cost
    assert (one.best_cost is None) == all(node.status != "solution" for node in one.nodes)


def test_case_study() -> None:
    told = explain(_case_study())
    assert told.literal
    assert told.optimal
    assert [(one.cost, one.best_cost, one.best_so_far) for one in told.assignments] == [
        (6, 7, 7),
        (6, 8, 7),
    ]
    assert told.next_cost == 8
    assert told.stop_reason == "C_3 = 8 >= C'* = 7"
    tree = told.assignments[0]
    assert [node.cost for node in tree.nodes] == [6, 7, 7, 7, 7]
    assert [node.constraint for node in tree.nodes[1:]] == list(tree.nodes[0].conflicts)
    for one in told.assignments:
        _check_tree(one)


@pytest.mark.parametrize("seed", variants(range(12), count=6))
def test_costs_are_those_of_the_plan(seed: int) -> None:
    drawn = traffic_request(seed) if seed % 2 else block_request(seed, vehicles=4)
    request = attrs.evolve(drawn, deadline_s=60.0)
    told = explain(request)
    assert told.optimal
    assert told.best_cost == plan(request).cost
    for one in told.assignments:
        _check_tree(one)
    by_trees = [one.best_cost for one in told.assignments if one.best_cost is not None]
    assert min([*by_trees, math.inf if told.joint_cost is None else told.joint_cost]) == (
        told.best_cost
    )


def test_the_joint_search_may_prove_that_there_is_no_plan() -> None:
    """Of four assignments only the first one was tried."""
    vehicles = (
        VehicleRequest("a", (0, 0), eligible=(2, 3)),
        VehicleRequest("b", (1, 0), eligible=(0, 1)),
    )
    kinds, targets = ("node", "edge", "special-1"), ((1, 0), (2, 0), (3, 0), (4, 0))
    told = explain(PlanRequest(Grid(5, 1), 1, kinds, vehicles, targets, 20.0))
    assert told.optimal
    assert told.next_cost is not None
    assert told.stop_reason == "joint search: there is no path set, C'* = infinite"


def test_a_run_without_a_plan_is_explained() -> None:
    vehicles = (
        VehicleRequest("a", (0, 0), eligible=(1,)),
        VehicleRequest("b", (1, 0), eligible=(0,)),
    )
    request = PlanRequest(Grid(2, 1), 1, ("node", "edge"), vehicles, ((0, 0), (1, 0)))
    told = explain(request)
    assert told.optimal
    assert told.best_cost == math.inf
    assert not told.literal
    assert "infinite" in told.stop_reason
