"""Path sets by negotiation: legal, repeatable, and better with more work."""

import numpy as np
import pytest

from laneweave.coordinator.planning.exact.arrays import MoveArrays, Teams, move_arrays, teams
from laneweave.coordinator.planning.exact.lagrangian_bound import Relaxation
from laneweave.coordinator.planning.exact.multipliers_kernel import PARKED
from laneweave.coordinator.planning.exact.negotiation import Negotiation
from laneweave.coordinator.planning.plan_validator import problems_of_response
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import formation_request
from laneweave.protocol.lattice import Mode


def no_limit() -> None:
    """Let it take its time."""


def arrays_of(request: PlanRequest) -> tuple[MoveArrays, Teams]:
    arrays = move_arrays(request.grid, request.mode, request.conflict_model)
    starts = [vehicle.cell for vehicle in request.vehicles]
    every_move = [frozenset[int]()] * len(starts)
    return arrays, teams(arrays, starts, request.targets, request.choices(), every_move)


def negotiation_of(request: PlanRequest) -> Negotiation:
    arrays, vehicles = arrays_of(request)
    whole = Relaxation(arrays, vehicles, 16)
    whole.improve(20)
    return Negotiation(arrays, vehicles, whole.multipliers, whole.assignment())


def uses_of_rows(request: PlanRequest, negotiation: Negotiation) -> dict[tuple[int, int], int]:
    arrays, vehicles = arrays_of(request)
    uses: dict[tuple[int, int], int] = {}
    for cell, way in zip(vehicles.start.tolist(), negotiation.path.tolist(), strict=True):
        at = cell
        for t, d in enumerate(way):
            move = max(d, 0)
            assert arrays.valid[move, at]
            for row in arrays.clique[move, at][arrays.clique[move, at] >= 0].tolist():
                uses[t, row] = uses.get((t, row), 0) + 1
            at += int(arrays.step[move])
    return uses


@pytest.mark.parametrize(("vehicles", "mode"), [(6, 1), (18, 2), (36, 1), (36, 2)])
def test_negotiation_settles_without_conflicts(vehicles: int, mode: Mode) -> None:
    request = formation_request(3, vehicles=vehicles, mode=mode)
    negotiation = negotiation_of(request)
    for _ in range(2_000):
        if negotiation.work(no_limit):
            break
    assert negotiation.cost == (negotiation.path != PARKED).sum()
    assert max(uses_of_rows(request, negotiation).values()) == 1


def test_more_work_never_makes_a_path_set_more_expensive() -> None:
    request = formation_request(5, vehicles=18)
    negotiation = negotiation_of(request)
    costs = []
    for _ in range(400):
        negotiation.work(no_limit)
        if negotiation.cost is not None:
            costs.append(negotiation.cost)
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < 0.8 * costs[0]
    assert max(uses_of_rows(request, negotiation).values()) == 1


def test_equal_work_gives_equal_paths() -> None:
    request = formation_request(5, vehicles=12)
    a, b = negotiation_of(request), negotiation_of(request)
    for _ in range(100):
        assert a.work(no_limit) == b.work(no_limit)
    assert a.path.tolist() == b.path.tolist()


def test_illegal_suggested_targets_are_ignored() -> None:
    """A refuted node may leave vehicles at any target."""
    arrays, vehicles = arrays_of(formation_request(3, vehicles=6))
    whole = Relaxation(arrays, vehicles, 16)
    legal = whole.assignment()
    negotiation = Negotiation(arrays, vehicles, whole.multipliers, legal)
    forbidden = legal[::-1].copy()
    assert (vehicles.pair[vehicles.team, forbidden] < 0).any()
    for target in (forbidden, np.zeros_like(legal)):
        negotiation.suggest(whole.multipliers, target)
        assert np.array_equal(negotiation._target, legal)
    mates = [i for i in range(6) if vehicles.team[i] == vehicles.team[0]][:2]
    exchanged = legal.copy()
    exchanged[mates] = exchanged[mates[::-1]]
    negotiation.suggest(whole.multipliers, exchanged)
    assert np.array_equal(negotiation._target, exchanged)


@pytest.mark.parametrize("mode", [1, 2])
def test_thirty_six_vehicles_get_a_plan_from_few_nodes(mode: Mode) -> None:
    request = formation_request(1, vehicles=36, mode=mode, deadline_s=60.0)
    response = plan(request, max_nodes=24)
    assert response.status == "feasible"
    assert problems_of_response(request, response) == []
