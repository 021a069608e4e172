"""Prioritized planning finds legal path sets on sparse grids where solvers have none in time."""

from __future__ import annotations

import random
from itertools import product

import attrs
import pytest

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError, Stopwatch
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.plan_validator import problems_of_paths
from laneweave.coordinator.planning.prioritized import prioritized
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import Cell, Mode
from laneweave.protocol.scenario.formation_table import BASE_CONFLICTS
from support.planning_oracles import CountingClock


def own_targets(
    grid: Grid, vehicles: int, *, mode: Mode = 1, seed: int = 0, deadline_s: float = 10.0
) -> PlanRequest:
    """Return a request in which each vehicle has a target of its own, at random."""
    rng = random.Random(seed)
    cells = [*product(range(grid.columns), range(grid.lanes))]
    starts, targets = rng.sample(cells, vehicles), rng.sample(cells, vehicles)
    return PlanRequest(
        grid,
        mode,
        BASE_CONFLICTS,
        tuple(VehicleRequest(f"v{i}", start, eligible=(i,)) for i, start in enumerate(starts)),
        tuple(targets),
        deadline_s,
    )


@pytest.mark.parametrize("mode", [1, 2])
def test_nearly_always_there_is_a_path_set_and_it_is_legal(mode: Mode) -> None:
    found = 0
    for seed in range(20):
        request = own_targets(Grid(40, 3), 10, mode=mode, seed=seed)
        problem = request.problem()
        solution = prioritized(problem, range(10), Budget())
        if solution is not None:
            found += 1
            rows = RelativePathMap.padded(request.ids, problem.cells_of(solution)).rows
            assert problems_of_paths(request, solution.assignment, rows) == []
    assert found >= 18


def test_a_vehicle_without_a_path_is_the_first_one_of_the_next_attempt() -> None:
    """The vehicle with the long path would enter the cell that the other one is leaving."""
    blocked = frozenset((column, 1) for column in range(8) if column != 2)
    vehicles = (VehicleRequest("long", (0, 0)), VehicleRequest("short", (1, 0)))
    request = PlanRequest(Grid(8, 2, blocked), 1, BASE_CONFLICTS, vehicles, ((7, 0), (2, 1)))
    solution = prioritized(request.problem(), (0, 1), Budget())
    assert solution is not None
    assert [len(path) for path in solution.paths] == [8, 2]


@pytest.mark.parametrize("blocked", [(), ((1, 0),)])
def test_there_may_be_no_path_set(blocked: tuple[Cell, ...]) -> None:
    """Two vehicles cannot pass each other in a single lane; a blocked cell divides it."""
    vehicles = (VehicleRequest("a", (0, 0)), VehicleRequest("b", (3, 0)))
    request = PlanRequest(Grid(4, 1, blocked), 1, ("node", "edge"), vehicles, ((3, 0), (0, 0)))
    assert prioritized(request.problem(), (0, 1), Budget()) is None


def test_it_ends_at_the_deadline() -> None:
    budget = Budget(deadline_s=0.002, stopwatch=Stopwatch(CountingClock(0.001)))
    with pytest.raises(BudgetSpentError):
        prioritized(own_targets(Grid(40, 3), 10).problem(), range(10), budget)


def test_a_large_request_has_a_plan_where_no_solver_finds_one_in_time() -> None:
    """TAPPA has spent its share at its first nodes, and branching cannot plan such requests."""
    request = own_targets(Grid(300, 3), 30, deadline_s=1000.0)
    response = plan(request, clock=CountingClock(0.5))
    assert response.status == "feasible"
    assert response.cost is not None
    assert (response.lower_bound or 0) <= response.cost
    alone = plan(attrs.evolve(request, solver="tappa"), clock=CountingClock(0.5), fallback=False)
    assert (alone.status, alone.solver) == ("timeout", "tappa")
