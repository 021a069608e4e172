"""The planner: exact, complete on small spaces, punctual, repeatable."""

import functools
import itertools
import os
import random
import subprocess
import sys
from pathlib import Path

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st

import laneweave.coordinator
import laneweave.protocol
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.paper.assignments import Weights
from laneweave.coordinator.planning.plan_validator import problems_of_response
from laneweave.coordinator.planning.request import MAX_STEPS, PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import block_request, formation_request
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS, SOLVERS
from oracles.milp_oracle import fewest_steps
from oracles.path_rules import Problem
from support.examples import examples
from support.planning_oracles import CountingClock, cheapest_plan, faults, requests
from support.variants import variants


def _corridor(*vehicles: tuple[Cell, int], columns: int = 4) -> PlanRequest:
    """Return vehicles on a single lane, each with the column of its target."""
    return PlanRequest(
        Grid(columns, 1),
        1,
        ("node", "edge", "special-1"),
        tuple(VehicleRequest(f"v{i}", cell, eligible=(i,)) for i, (cell, _) in enumerate(vehicles)),
        tuple((column, 0) for _, column in vehicles),
        deadline_s=60.0,
    )


@pytest.mark.slow
@examples(120)
@given(requests())
def test_cost_is_optimal_or_infeasibility_is_proven(request: PlanRequest) -> None:
    response = plan(request)
    expected = cheapest_plan(request)
    assert response.status == ("infeasible" if expected is None else "optimal")
    assert response.cost == expected
    assert response.lower_bound == expected
    assert problems_of_response(request, response) == []


@pytest.mark.slow
@examples(25)
@given(requests(limited=True), st.sampled_from(SOLVERS))
def test_vehicles_drive_only_their_moves(request: PlanRequest, solver: str) -> None:
    """Both solvers find the optimum, alone, if vehicles cannot drive all moves."""
    assert faults(request.to_dict(), cheapest_plan(request), solver) == []


@pytest.mark.slow
@examples(60)
@given(requests(), st.integers(0, 6), st.sampled_from(SOLVERS))
def test_plans_have_no_more_steps_than_are_permitted(
    request: PlanRequest, steps: int, solver: str
) -> None:
    limited = attrs.evolve(request, max_steps=steps)
    assert faults(limited.to_dict(), cheapest_plan(limited), solver) == []


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_generous_limit_on_steps_costs_nothing(solver: str) -> None:
    """Some vehicles of the constraint trees can never arrive; they are given up at once."""
    corridor = _corridor(((4, 0), 1), ((3, 0), 2), ((0, 0), 3), ((1, 0), 0), columns=5)
    request = attrs.evolve(
        corridor,
        conflicts=("node", "edge", "special-1", "closing"),
        vehicles=tuple(attrs.evolve(one, eligible=None) for one in corridor.vehicles),
    )
    free, limited = (
        plan(attrs.evolve(request, max_steps=steps), solver=solver, fallback=False)
        for steps in (None, MAX_STEPS)
    )
    assert (limited.status, limited.cost) == (free.status, free.cost) == ("optimal", 3)
    assert limited.nodes_expanded == free.nodes_expanded


def crowded(seed: int, max_steps: int) -> PlanRequest:
    """Return a request for six vehicles in nine cells; two lanes become full."""
    cells = [(column, lane) for column in range(3) for lane in range(3)]
    starts = random.Random(seed).sample(cells, 6)
    vehicles = tuple(
        VehicleRequest(f"v{number}", cell, lane=2 * (number % 2))
        for number, cell in enumerate(starts)
    )
    kinds = ("node", "edge", "special-1", "closing")
    return PlanRequest(
        Grid(3, 3), 1, kinds, vehicles, tuple(cells), deadline_s=60.0, max_steps=max_steps
    )


@pytest.mark.parametrize("seeds", variants([range(4), range(4, 12)]), ids=str)
def test_a_crowded_formation_needs_fewer_steps_at_a_higher_cost(seeds: range) -> None:
    """The cheapest plan takes more steps than the fewest, which a breadth-first search finds."""
    fewer = 0
    for seed in seeds:
        cheapest = plan(crowded(seed, 100))
        assert cheapest.cost is not None
        fewest = fewest_steps(Problem.of(crowded(seed, 100).to_dict()))
        assert fewest is not None
        quickest = plan(crowded(seed, fewest))
        assert (quickest.status, quickest.steps) == ("optimal", fewest)
        assert (quickest.cost or 0) >= cheapest.cost
        assert plan(crowded(seed, fewest - 1)).status == "infeasible"
        fewer += (quickest.cost or 0) > cheapest.cost
    assert fewer


def test_a_vehicle_that_only_changes_lanes_stays_in_its_column() -> None:
    lanes_only = ((0, 1), (0, -1))
    request = PlanRequest(
        Grid(4, 2),
        1,
        ("node", "edge", "special-1"),
        (
            VehicleRequest("truck", (1, 0), lane=1, moves=lanes_only),
            VehicleRequest("car", (1, 1), lane=0),
        ),
        ((0, 0), (3, 0), (0, 1), (1, 1), (3, 1)),
    )
    for solver in SOLVERS:
        response = plan(request, solver=solver, fallback=False)
        truck, car = response.paths
        assert {column for column, _ in truck} == {1}
        assert (response.status, truck[-1], car[-1]) == ("optimal", (1, 1), (0, 0))
    blocked = attrs.evolve(request, targets=((0, 0), (3, 0), (0, 1), (3, 1)))
    assert [plan(blocked, solver=solver).status for solver in SOLVERS] == ["infeasible"] * 2


def test_a_vehicle_at_its_target_stays() -> None:
    response = plan(_corridor(((0, 0), 0), ((2, 0), 2)))
    assert (response.status, response.cost, response.steps) == ("optimal", 0, 0)
    assert response.paths == (((0, 0),), ((2, 0),))


def test_no_needless_moves() -> None:
    """Vehicles that must wait stay in their cells."""
    for seed in range(5):
        request = formation_request(seed, deadline_s=60.0)
        response = plan(request)
        for i, path in enumerate(response.paths):
            others = [p for j, p in enumerate(response.paths) if j != i]
            assert _is_lazy(request, path, others)


def _is_lazy(request: PlanRequest, path: tuple[Cell, ...], others: list[tuple[Cell, ...]]) -> bool:
    """Return whether no detour (leave a cell, come straight back) could be replaced by waiting."""
    model = request.conflict_model
    for k in range(len(path) - 2):
        if path[k] == path[k + 2] != path[k + 1]:
            wait = path[k], path[k]
            moves = [(other[s], other[s + 1]) for other in others for s in (k, k + 1)]
            if all(model.kind(wait, move) is None for move in moves):
                return False
    return True


class TestInfeasible:
    def test_an_unreachable_target_is_detected_immediately(
        self,
    ) -> None:
        columns = [(c, lane) for c in range(9) for lane in (0, 2)]
        request = PlanRequest(
            Grid(9, 3, [(c, 1) for c in range(9)]),
            2,
            ("geometric",),
            tuple(VehicleRequest(f"v{i}", cell) for i, cell in enumerate(columns[:16:2])),
            ((8, 2), *((c, 0) for c in range(1, 8))),
            deadline_s=60.0,
        )
        response = plan(request)
        assert response.status == "infeasible"
        assert response.assignments_tried == 0


@functools.cache
def _optimum_of_block(seed: int) -> float:
    optimum = plan(block_request(seed, deadline_s=3600.0), solver="branching").cost
    assert optimum is not None
    return optimum


class TestDeadline:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("solver", "looks"),
        [
            *(("tappa", looks) for looks in (2, 5, 20, 50, 100)),
            *(("branching", looks) for looks in (2, 5, 8, 12)),
        ],
    )
    def test_deadline_is_kept_and_the_bound_holds(self, solver: str, looks: int) -> None:
        whole = block_request(25, deadline_s=3600.0)
        optimum = _optimum_of_block(25)
        clock = CountingClock(0.001)
        response = plan(attrs.evolve(whole, deadline_s=looks * 0.001), solver=solver, clock=clock)
        # Nothing looks at the clock again after the deadline, but to leave every loop.
        assert round(clock.now_s / 0.001) <= looks + 8
        assert response.status in ("feasible", "timeout")
        assert response.lower_bound is not None
        assert response.lower_bound <= optimum
        assert problems_of_response(whole, response) == []
        if response.cost is not None:
            assert response.cost >= optimum

    def test_an_unsolvable_request_that_is_too_large_to_prove_times_out(self) -> None:
        vehicles = tuple(VehicleRequest(f"v{i}", (i, 0), eligible=(i,)) for i in range(12))
        targets = tuple((11 - i, 0) for i in range(12))
        request = PlanRequest(Grid(40, 1), 1, ("node", "edge", "special-1"), vehicles, targets, 0.2)
        clock = CountingClock(0.001)
        response = plan(request, clock=clock)
        assert response.status == "timeout"
        # One look at the clock finds that there is no time for another node, few leave all loops.
        assert 0.15 <= clock.now_s <= 0.2 + 0.008
        assert response.lower_bound is not None
        assert response.lower_bound >= 72

    @pytest.mark.slow
    def test_more_time_never_gives_a_worse_plan(self) -> None:
        request = block_request(29, deadline_s=3600.0)
        costs, bounds = [], []
        for nodes in (0, 1, 10, 100, 400, 10_000):
            response = plan(request, max_nodes=nodes)
            costs.append(float("inf") if response.cost is None else response.cost)
            bounds.append(response.lower_bound)
            assert response.nodes_expanded <= nodes
            assert (response.status == "optimal") == (response.cost == response.lower_bound)
        assert costs == sorted(costs, reverse=True)
        assert bounds == sorted(bounds, key=lambda bound: bound or 0)
        assert costs[-1] == bounds[-1]


def _without_time(response: PlanResponse) -> PlanResponse:
    return attrs.evolve(response, solve_ms=0.0)


SCRIPT = """
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import block_request
for seed in range(6):
    for mode in (1, 2):
        r = plan(block_request(seed, mode=mode, deadline_s=3600.0), max_nodes=60)
        print(r.status, r.cost, r.lower_bound, r.assignment, r.paths, r.nodes_expanded)
"""


class TestRepeatable:
    def test_equal_requests_get_equal_responses(self) -> None:
        request = block_request(25, deadline_s=3600.0)
        first, second = (plan(request, max_nodes=300) for _ in range(2))
        assert _without_time(first) == _without_time(second)

    @pytest.mark.slow
    @pytest.mark.more
    def test_hash_seed_does_not_matter(self) -> None:
        roots = [
            str(Path(package.__file__ or "").parents[2])
            for package in (laneweave.coordinator, laneweave.protocol)
        ]

        def run(hash_seed: str) -> str:
            environment = {
                **os.environ,
                "PYTHONHASHSEED": hash_seed,
                "PYTHONPATH": os.pathsep.join(roots),
            }
            command = [sys.executable, "-c", SCRIPT]
            return subprocess.run(
                command, env=environment, check=True, capture_output=True, text=True
            ).stdout

        first, second = run("1"), run("2")
        assert first.count("\n") == 12
        assert first == second


class TestConflicts:
    def test_more_conflicts_never_make_it_cheaper(self) -> None:
        for seed in range(3):
            costs = [
                plan(
                    formation_request(
                        seed, vehicles=5, mode=2, conflicts=CONFLICT_KINDS[:count], deadline_s=60.0
                    )
                ).cost
                for count in range(1, len(CONFLICT_KINDS) + 1)
            ]
            proven = [cost for cost in costs if cost is not None]
            assert len(proven) == len(costs)
            assert proven == sorted(proven)


class TestWeights:
    def test_smaller_weights_prove_the_same_optimum(self) -> None:
        request = block_request(3, vehicles=4, deadline_s=60.0)
        costs = {
            plan(request, weights=Weights(straight, oblique)).cost
            for straight, oblique in itertools.product((0, 1), (0, 1, 2))
        }
        assert len(costs) == 1

    def test_weights_that_are_no_bound_are_rejected(self) -> None:
        with pytest.raises(BadInputError, match="l_o"):
            plan(block_request(0, mode=2), weights=Weights(1, 2))
