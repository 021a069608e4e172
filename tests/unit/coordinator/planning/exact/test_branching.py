"""The solver `branching`, beyond the comparison with the oracle in `test_against_milp`."""

from itertools import combinations

import pytest
from attrs import evolve

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.exact.branching import Branching
from laneweave.coordinator.planning.exact.lagrangian_bound import upper_bound_of
from laneweave.coordinator.planning.exact.multipliers_kernel import PER_MOVE
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.plan_validator import problems_of_response
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import formation_request
from laneweave.protocol.lattice import Cell, Mode, displacements
from support.variants import variants


def solved(request: PlanRequest, max_nodes: int | None = None) -> PlanResponse:
    response = plan(request, solver="branching", max_nodes=max_nodes)
    assert problems_of_response(request, response) == []
    return response


@pytest.mark.slow
@pytest.mark.parametrize("seed", variants(range(4)))
@pytest.mark.parametrize("size", [7, 8])
@pytest.mark.parametrize(
    ("mode", "conflicts"),
    [(1, ("node", "edge")), (1, None), (2, ("node", "edge")), (2, None)],
    ids=["node and edge", "following", "mode 2, node and edge", "geometric"],
)
def test_both_solvers_agree_on_formations(
    seed: int, size: int, mode: Mode, conflicts: tuple[str, ...] | None
) -> None:
    request = formation_request(
        seed, vehicles=size, mode=mode, conflicts=conflicts, deadline_s=60.0
    )
    branching = solved(request)
    tappa = plan(request, solver="tappa", max_nodes=300, fallback=False)
    assert branching.status == "optimal"
    assert branching.cost is not None
    assert tappa.lower_bound is not None
    assert tappa.lower_bound <= branching.cost
    assert tappa.status == "timeout" or tappa.cost is not None
    assert tappa.cost is None or branching.cost <= tappa.cost
    assert tappa.status != "optimal" or tappa.cost == branching.cost


def test_equal_requests_get_equal_plans() -> None:
    request = formation_request(5, vehicles=9, deadline_s=60.0)
    first, second = solved(request), solved(request)
    assert (first.paths, first.assignment) == (second.paths, second.assignment)


@pytest.mark.parametrize(
    ("wishes", "targets"),
    [
        ((((0, 0), None), ((2, 0), None)), ((1, 0),)),
        ((((0, 0), (0,)), ((2, 0), (0,))), ((1, 0), (2, 0))),
        ((((0, 0), ()),), ((2, 0),)),
        ((((0, 2), (1,)), ((2, 2), (0,))), ((0, 2), (2, 2))),
    ],
    ids=["fewer targets than vehicles", "one target for two", "no target", "no room to swap"],
)
def test_infeasible_requests_are_proven_infeasible(
    wishes: tuple[tuple[Cell, tuple[int, ...] | None], ...], targets: tuple[Cell, ...]
) -> None:
    grid = Grid(3, 3, [(column, 1) for column in range(3)])
    kinds = ("node", "edge", "special-1")
    vehicles = [VehicleRequest(f"v{cell}", cell, eligible=wish) for cell, wish in wishes]
    request = PlanRequest(grid, 1, kinds, tuple(vehicles), targets)
    for response in (plan(request, solver="tappa"), solved(request)):
        assert (response.status, response.cost, response.lower_bound) == ("infeasible", None, None)
        assert response.paths == ()


def test_large_requests_without_enough_targets_are_infeasible() -> None:
    """A path set must only use eligible targets."""
    block = [(1 + number // 3, number % 3) for number in range(20)]
    vehicles = (
        VehicleRequest("a", (0, 0), eligible=(0,)),
        VehicleRequest("b", (0, 2), eligible=(0,)),
        *(VehicleRequest(f"v{number}", cell) for number, cell in enumerate(block[:18])),
    )
    targets = ((13, 1), *block, (14, 0))
    request = PlanRequest(Grid(16, 3), 1, ("node", "edge", "special-1"), vehicles, targets)
    response = solved(request)
    assert (response.status, response.lower_bound) == ("infeasible", None)


def test_rounding_does_not_refute_a_cost() -> None:
    """The value of 24 vehicles that move 180 times each, added up move by move."""
    moved = sum(1.0 + PER_MOVE for _ in range(24 * 180))
    assert moved > 24 * 180 * (1.0 + PER_MOVE)
    assert moved <= upper_bound_of(24 * 180) < 24 * 180 + 1


def test_a_distant_target_is_reached() -> None:
    """Longer paths than those to the nearest targets are needed."""
    vehicles = (
        VehicleRequest("a", (0, 0)),
        VehicleRequest("b", (0, 1)),
        VehicleRequest("c", (1, 0), lane=1),
    )
    request = PlanRequest(Grid(60, 3), 1, ("geometric",), vehicles, ((0, 0), (59, 0), (1, 1)))
    response = solved(request)
    assert response.status == "optimal"
    assert response.cost == plan(request, solver="tappa").cost


@pytest.mark.slow
def test_arrays_above_the_memory_limit_are_not_made() -> None:
    vehicles = (VehicleRequest("a", (0, 0)),)
    request = PlanRequest(Grid(1000, 16), 1, ("geometric",), vehicles, ((999, 15),), 20.0)
    assert solved(request).cost == 999 + 15


@pytest.mark.slow
def test_a_limit_on_memory_ends_with_a_feasible_plan() -> None:
    """Arrays for more steps with multipliers do not fit; a path set was found before."""
    request = formation_request(0, vehicles=24, deadline_s=60.0)
    limited = plan(request, solver="branching", max_nodes=60, max_memory_mb=1.5)
    assert (limited.status, limited.solver, limited.fallback) == ("feasible", "tappa", True)
    assert problems_of_response(request, limited) == []
    unlimited = plan(request, solver="branching", max_nodes=60)
    assert (unlimited.solver, unlimited.fallback) == ("branching", False)


def test_arrays_for_too_many_targets_are_not_allocated() -> None:
    """Each vehicle has a different list: 60 teams with 399 targets on 16,000 cells."""
    targets = [(column, lane) for column in range(900, 925) for lane in range(16)]
    vehicles = tuple(
        VehicleRequest(f"v{i}", (i, 0), eligible=tuple(j for j in range(400) if j != i))
        for i in range(60)
    )
    kinds = ("node", "edge", "special-1")
    request = PlanRequest(Grid(1000, 16), 1, kinds, vehicles, tuple(targets))
    search = Branching(request.problem(), request.choices(), Budget())
    search.run()
    assert search.aborted


def test_vehicles_that_drive_different_moves_are_different_teams() -> None:
    """60 of them have the same 400 targets on 16,000 cells."""
    targets = [(column, lane) for column in range(900, 925) for lane in range(16)]
    moves = [subset for size in range(9) for subset in combinations(displacements(2)[1:], size)]
    vehicles = tuple(VehicleRequest(f"v{i}", (i, 0), moves=moves[i]) for i in range(60))
    request = PlanRequest(Grid(1000, 16), 2, ("geometric",), vehicles, tuple(targets))
    assert Branching(request.problem(), request.choices(), Budget()).aborted


def test_wide_roads_and_long_paths_are_planned() -> None:
    vehicles = tuple(VehicleRequest(f"v{lane}", (0, lane), lane=15 - lane) for lane in (0, 5, 11))
    request = PlanRequest(Grid(4, 16), 2, ("geometric",), vehicles, ((3, 15), (3, 10), (3, 4)))
    response = solved(request)
    assert (response.status, response.cost) == ("optimal", 15 + 5 + 7)


def test_requests_that_branching_cannot_handle_go_to_tappa() -> None:
    request = evolve(formation_request(1, vehicles=4, mode=2), conflicts=("edge",))
    assert solved(request).status == "optimal"


def test_an_unfinished_search_returns_its_bound() -> None:
    request = formation_request(3, vehicles=12, deadline_s=60.0)
    response = solved(request, max_nodes=30)
    assert response.status in ("timeout", "feasible")
    assert response.lower_bound is not None
    assert 39 <= response.lower_bound <= 42
