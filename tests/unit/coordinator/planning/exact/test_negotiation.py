"""Path sets by negotiation: legal, the same each time, and better with more work."""

import numpy as np
import pytest

from laneweave.coordinator.planning import PlanRequest, plan, problems_of_response
from laneweave.coordinator.planning.exact.arrays import Lattice, Teams, lattice, teams
from laneweave.coordinator.planning.exact.negotiation import Negotiation
from laneweave.coordinator.planning.exact.negotiation_kernel import negotiate
from laneweave.coordinator.planning.exact.relaxation import Relaxation
from laneweave.coordinator.planning.exact.relaxation_kernel import PARKED
from laneweave.coordinator.planning.exact.repair import Repair
from laneweave.coordinator.planning.exact.repair_kernel import put_back
from laneweave.coordinator.planning.exact.trial import trial
from laneweave.coordinator.planning.grid import Mode
from laneweave.coordinator.planning.instances import formation_request


def no_limit() -> None:
    """Let it take its time."""


def arrays_of(request: PlanRequest) -> tuple[Lattice, Teams]:
    ways = lattice(request.grid, request.mode, request.conflict_model)
    starts = [vehicle.cell for vehicle in request.vehicles]
    return ways, teams(ways, starts, request.targets, request.choices())


def negotiation_of(request: PlanRequest) -> Negotiation:
    ways, vehicles = arrays_of(request)
    whole = Relaxation(ways, vehicles, 16)
    whole.improve(20)
    return Negotiation(ways, vehicles, whole.prices, whole.assignment())


def uses_of_rows(request: PlanRequest, negotiation: Negotiation) -> dict[tuple[int, int], int]:
    ways, vehicles = arrays_of(request)
    uses: dict[tuple[int, int], int] = {}
    for cell, way in zip(vehicles.start.tolist(), negotiation.way.tolist(), strict=True):
        at = cell
        for t, d in enumerate(way):
            move = max(d, 0)
            assert ways.valid[move, at]
            for row in ways.row[move, at][ways.row[move, at] >= 0].tolist():
                uses[t, row] = uses.get((t, row), 0) + 1
            at += int(ways.step[move])
    return uses


@pytest.mark.parametrize(("vehicles", "mode"), [(6, 1), (18, 2), (36, 1), (36, 2)])
def test_it_settles_and_no_row_is_used_twice(vehicles: int, mode: Mode) -> None:
    request = formation_request(3, vehicles=vehicles, mode=mode)
    negotiation = negotiation_of(request)
    for _ in range(2_000):
        if negotiation.work(no_limit):
            break
    assert negotiation.cost == (negotiation.way != PARKED).sum()
    assert max(uses_of_rows(request, negotiation).values()) == 1


def test_more_work_makes_it_cheaper_and_never_dearer() -> None:
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


def test_equal_work_gives_equal_ways() -> None:
    request = formation_request(5, vehicles=12)
    a, b = negotiation_of(request), negotiation_of(request)
    for _ in range(100):
        assert a.work(no_limit) == b.work(no_limit)
    assert a.way.tolist() == b.way.tolist()


def test_targets_that_a_vehicle_may_not_have_are_not_taken_over() -> None:
    """A node that is refuted may leave vehicles at any target."""
    ways, vehicles = arrays_of(formation_request(3, vehicles=6))
    whole = Relaxation(ways, vehicles, 16)
    legal = whole.assignment()
    negotiation = Negotiation(ways, vehicles, whole.prices, legal)
    forbidden = legal[::-1].copy()
    assert (vehicles.pair[vehicles.team, forbidden] < 0).any()
    for target in (forbidden, np.zeros_like(legal)):
        negotiation.suggest(whole.prices, target)
        assert np.array_equal(negotiation._target, legal)
    mates = [i for i in range(6) if vehicles.team[i] == vehicles.team[0]][:2]
    exchanged = legal.copy()
    exchanged[mates] = exchanged[mates[::-1]]
    negotiation.suggest(whole.prices, exchanged)
    assert np.array_equal(negotiation._target, exchanged)


@pytest.mark.parametrize("mode", [1, 2])
def test_vehicles_that_are_planned_anew_end_legally_and_cheaper(mode: Mode) -> None:
    request = formation_request(2, vehicles=24, mode=mode)
    ways, vehicles = arrays_of(request)
    whole = Relaxation(ways, vehicles, 24)
    whole.improve(20)
    target = whole.assignment()
    settled = trial(ways, np.full((24, 48), PARKED), target, np.zeros((48, ways.row_count)))
    for number in range(2_000):
        if negotiate(ways, vehicles, settled, number):
            break
    repair = Repair(ways, vehicles)
    repair.begin(whole.prices)
    costs = [int(settled.cost.sum())]
    for _ in range(120):
        better = repair.attempt(settled, no_limit)
        costs.append(int(settled.cost.sum()))
        assert better == (costs[-1] < costs[-2])
        assert costs[-1] == np.count_nonzero(settled.way != PARKED)
    assert costs[-1] < 0.9 * costs[0]
    uses = settled.use.copy()
    settled.use[:] = 0.0
    put_back(ways, vehicles, settled, np.arange(24))
    assert np.array_equal(uses, settled.use)
    assert uses.max() == 1.0
    held = vehicles.target[settled.target]
    assert len(set(settled.target.tolist())) == 24
    for i, (start, way) in enumerate(zip(vehicles.start, settled.way, strict=True)):
        assert start + ways.step[np.maximum(way, 0)].sum() == held[i]
        assert vehicles.pair[vehicles.team[i], settled.target[i]] >= 0


@pytest.mark.parametrize("mode", [1, 2])
def test_thirty_six_vehicles_get_an_answer_from_few_nodes(mode: Mode) -> None:
    request = formation_request(1, vehicles=36, mode=mode, deadline_s=60.0)
    response = plan(request, max_nodes=24)
    assert response.status == "feasible"
    assert problems_of_response(request, response) == []
