"""The search over joint states."""

import pytest
from hypothesis import given

from laneweave.coordinator.planning import conflict_kinds
from laneweave.coordinator.planning.budget import Budget, BudgetSpentError, Stopwatch
from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move
from laneweave.coordinator.planning.exact.reachability import (
    Reachability,
    can_be_made_one_after_another,
    explore,
)
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.plan_validator import problems_of_paths, problems_of_response
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS
from support.examples import examples
from support.planning_oracles import CountingClock, cheapest_plan, requests


def _explore(request: PlanRequest, max_moves: int = 10**6) -> tuple[Problem, Reachability]:
    problem = request.problem()
    return problem, explore(problem, request.choices(), Budget(), max_moves)


@examples(80)
@given(requests())
def test_reachability_agrees_with_the_joint_search(request: PlanRequest) -> None:
    problem, verdict = _explore(request)
    solvable = cheapest_plan(request) is not None
    assert verdict.infeasible != solvable
    assert (verdict.solution is not None) == solvable
    if verdict.solution is not None:
        cells = problem.cells_of(verdict.solution)
        rows = RelativePathMap.padded(["" for _ in cells], cells).rows
        assert problems_of_paths(request, verdict.solution.assignment, rows) == []


PUZZLE = PlanRequest(
    Grid(3, 3),
    1,
    ("node", "edge", "special-1"),
    tuple(
        VehicleRequest(f"v{i}", cell, eligible=(i,))
        for i, cell in enumerate([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1)])
    ),
    ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 1), (2, 0)),
)
"""The eight puzzle with two tiles exchanged, which has no solution."""


def test_a_truncated_search_has_no_result() -> None:
    _, verdict = _explore(PUZZLE, max_moves=500)
    assert verdict == Reachability(solution=None, infeasible=False)


def test_time_is_checked() -> None:
    problem = PUZZLE.problem()
    budget = Budget(deadline_s=3.0, stopwatch=Stopwatch(CountingClock(1.0)))
    with pytest.raises(BudgetSpentError):
        explore(problem, PUZZLE.choices(), budget, max_moves=10**9)


def test_a_crowded_block_is_solved() -> None:
    """The cheapest plan costs 25 (by the oracle)."""
    wishes = {(1, 2): 1, (2, 1): 1, (3, 0): 2, (2, 0): 0, (3, 1): 1, (3, 2): 0}
    request = PlanRequest(
        Grid(4, 3),
        1,
        ("node", "edge", "special-1"),
        tuple(
            VehicleRequest(f"v{number}", cell, lane=lane)
            for number, (cell, lane) in enumerate(wishes.items())
        ),
        ((2, 0), (3, 0), (1, 1), (2, 1), (3, 1), (3, 2)),
    )
    response = plan(request, max_nodes=2_000, solver="branching")
    assert (response.status, response.cost) == ("optimal", 25)
    assert not problems_of_response(request, response)


def test_passing_without_waiting_is_possible() -> None:
    """Wide cells allow oblique passing, but special-4 forbids passing a waiting vehicle."""
    geometry = BodyGeometry(
        length_m=3.5,
        width_m=2.0,
        lane_width_m=8.0,
        pitch_m=26.0,
        move_s=10.0,
        slot_s=10.2,
        speed_mps=27.0,
        clearance_along_m=0.0,
        clearance_across_m=0.0,
    )
    grid = Grid(2, 3, [(0, 2), (1, 0)])
    targets = ((1, 2), (0, 0))
    vehicles = (
        VehicleRequest("a", (0, 1), eligible=(0,)),
        VehicleRequest("b", (1, 1), eligible=(1,)),
    )
    kinds = ("geometric", "special-4")
    request = PlanRequest(grid, 2, kinds, vehicles, targets, geometry=geometry)
    _, verdict = _explore(request)
    assert verdict.solution is not None
    assert verdict.solution.cost == plan(request).cost == 2


def test_a_kind_that_forbids_passing_a_waiting_vehicle_needs_joint_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def beside_waiting(a: Move, b: Move) -> bool:
        longitudinal = a[0] != a[1] and a[0][1] == a[1][1]
        beside = a[0][0] == b[0][0] and abs(a[0][1] - b[0][1]) == 1
        return longitudinal and beside and b[0] == b[1]

    monkeypatch.setattr(conflict_kinds, "CONFLICT_KINDS", (*CONFLICT_KINDS, "beside-waiting"))
    monkeypatch.setitem(conflict_kinds._PREDICATES, "beside-waiting", beside_waiting)
    assert can_be_made_one_after_another(1, ConflictModel(PUZZLE.conflicts))
    model = ConflictModel((*PUZZLE.conflicts, "beside-waiting"))
    assert not can_be_made_one_after_another(1, model)
