"""Lower bounds never exceed the minimum cost, and fixing keeps all optimal plans."""

import numpy as np
import pytest

from laneweave.coordinator.planning.exact.lagrangian_bound import Relaxation
from laneweave.coordinator.planning.exact.multipliers_kernel import BOUND, PER_MOVE
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import formation_request
from laneweave.protocol.lattice import Mode
from unit.coordinator.planning.exact.test_negotiation import arrays_of

CASES: list[tuple[int, int, Mode]] = [(0, 6, 1), (3, 9, 1), (1, 6, 2), (3, 8, 2)]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "vehicles", "mode"), CASES)
def test_bounds_rise_and_never_exceed_the_minimum_cost(
    seed: int, vehicles: int, mode: Mode
) -> None:
    request = formation_request(seed, vehicles=vehicles, mode=mode, deadline_s=60.0)
    cost = plan(request, solver="branching").cost
    assert cost is not None
    whole = Relaxation(*arrays_of(request), 16)
    bounds = []
    for _ in range(30):
        whole.improve(10)
        bounds.append(float(whole.state[BOUND]))
    assert bounds == sorted(bounds)
    assert bounds[0] < bounds[-1] <= cost * (1.0 + PER_MOVE)
    assert whole.min_cost <= cost
    assert whole.min_cost >= 0.9 * cost


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "vehicles", "mode"), CASES)
def test_moves_of_an_optimal_plan_are_never_fixed(seed: int, vehicles: int, mode: Mode) -> None:
    request = formation_request(seed, vehicles=vehicles, mode=mode, deadline_s=60.0)
    response = plan(request, solver="branching")
    assert response.cost is not None
    arrays, grouped = arrays_of(request)
    whole = Relaxation(arrays, grouped, 16)
    whole.improve(100)
    nodes = whole.stack(1)
    assert whole.put(nodes, response.cost * (1.0 + PER_MOVE) + 1e-9)
    allowed = nodes.allowed[0]
    assert allowed.sum() < 0.5 * whole.allowed.sum()
    for k, path, target in zip(
        grouped.team.tolist(), response.paths, response.assignment, strict=True
    ):
        cells = [column * arrays.lanes + lane for column, lane in path]
        arrival = max([t + 1 for t, cell in enumerate(cells[:-1]) if cell != cells[-1]], default=0)
        for t in range(arrival):
            (d,) = np.flatnonzero(arrays.step == cells[t + 1] - cells[t])
            assert allowed[k, t, d, cells[t]]
        assert nodes.earliest[0, grouped.pair[k, target]] <= arrival
