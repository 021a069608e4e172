"""The choice of the solver: by name, by default, and the fallback to the other one."""

from __future__ import annotations

import math

import attrs
import pytest

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import TAPPA_SHARE, plan
from laneweave.launch.bench.request_families import block_request, formation_request
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.formation_table import SOLVERS
from support.planning_oracles import CountingClock

EASY = block_request(1, vehicles=3, deadline_s=3600.0)
HARD = formation_request(1, vehicles=14, deadline_s=3600.0)
"""TAPPA needs thousands of nodes for it, branching less than a hundred."""
NODES = 60


def test_branching_plans_unless_another_solver_is_named() -> None:
    assert plan(EASY).solver == "branching"
    assert plan(attrs.evolve(EASY, solver="branching")).solver == "branching"
    assert plan(attrs.evolve(EASY, solver="branching"), solver="tappa").solver == "tappa"


def test_tappa_plans_first_on_boards_that_are_nearly_empty() -> None:
    wide = attrs.evolve(EASY, grid=Grid(200, 3))
    assert plan(wide).solver == "tappa"
    assert plan(wide, solver="branching").solver == "branching"
    assert plan(wide).cost == plan(wide, solver="branching").cost


def test_a_plan_in_time_is_no_fallback() -> None:
    assert not any(plan(EASY, solver=solver).fallback for solver in SOLVERS)


def test_an_unknown_solver_is_refused() -> None:
    # Where the request is answered: others may have solvers that are not installed here.
    request = PlanRequest.from_dict(EASY.to_dict() | {"solver": "brunching"})
    with pytest.raises(BadInputError, match=r"^solver: got .*tappa, branching.*mean branching"):
        plan(request)
    with pytest.raises(BadInputError, match=r"^solver: got .*; allowed: the name of a solver"):
        PlanRequest.from_dict(EASY.to_dict() | {"solver": "no name"})
    with pytest.raises(BadInputError, match=r"^solver: got .*; allowed: a string"):
        PlanRequest.from_dict(EASY.to_dict() | {"solver": 1})
    with pytest.raises(BadInputError, match=r"^solver: got"):
        plan(EASY, solver="guess")


@pytest.mark.parametrize("solver", [None, *SOLVERS])
def test_a_request_keeps_its_solver_in_json(solver: str | None) -> None:
    request = attrs.evolve(EASY, solver=solver)
    assert PlanRequest.from_dict(request.to_dict()) == request


def test_responses_without_a_solver_are_read() -> None:
    written = plan(EASY).to_dict()
    assert written.pop("solver") == "branching"
    assert "fallback" not in written
    old = PlanResponse.from_dict(written)
    assert (old.solver, old.fallback) == (None, False)
    assert old.to_dict() == written


# --- fallback ---------------------------------------------------------------------------------


def test_branching_continues_when_tappa_has_spent_its_nodes() -> None:
    alone = plan(HARD, max_nodes=NODES, solver="tappa", fallback=False)
    assert (alone.status, alone.solver, alone.fallback) == ("timeout", "tappa", False)
    response = plan(HARD, max_nodes=NODES, solver="tappa")
    best = plan(HARD, solver="branching")
    assert (response.solver, response.fallback) == ("branching", True)
    assert (response.status, response.cost) == ("optimal", best.cost)
    assert TAPPA_SHARE * NODES < response.nodes_expanded <= NODES
    assert response.assignments_tried > 0
    assert PlanResponse.from_dict(response.to_dict()) == response


def test_a_fallback_by_nodes_is_repeatable() -> None:
    one, other = (
        attrs.evolve(plan(HARD, max_nodes=NODES, solver="tappa"), solve_ms=0.0) for _ in range(2)
    )
    assert one == other


@pytest.mark.parametrize(("seed", "nodes"), [(33, 20), (38, 40), (45, 40), (57, 50)])
def test_the_cheaper_path_set_and_the_higher_bound_are_kept(seed: int, nodes: int) -> None:
    """TAPPA has a path set without proof; branching finds a cheaper one or proves its cost."""
    request = formation_request(seed, vehicles=8, deadline_s=3600.0)
    alone = plan(request, max_nodes=math.ceil(TAPPA_SHARE * nodes), solver="tappa", fallback=False)
    both = plan(request, max_nodes=nodes, solver="tappa")
    assert (both.solver, both.fallback) == ("branching", True)
    assert alone.cost is not None
    assert both.cost is not None
    assert both.cost <= alone.cost
    assert (both.lower_bound or 0) >= (alone.lower_bound or 0)


def test_branching_continues_when_tappa_has_spent_its_time() -> None:
    hurried = attrs.evolve(HARD, deadline_s=30.0, solver="tappa")
    response = plan(hurried, clock=CountingClock(0.01))
    assert (response.solver, response.fallback) == ("branching", True)
    assert response.solve_ms <= 30.1e3


def test_tappa_spends_everything_where_branching_cannot_plan() -> None:
    """Where vehicles may share a cell, branching cannot plan at all."""
    request = attrs.evolve(EASY, conflicts=("edge",))
    asked = [plan(request, solver=solver) for solver in (None, *SOLVERS)]
    fallbacks = [False, False, True]
    assert [(one.solver, one.fallback) for one in asked] == [("tappa", each) for each in fallbacks]
