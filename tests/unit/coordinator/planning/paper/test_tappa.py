"""The sequence of assignments in Algorithm 1."""

from __future__ import annotations

import attrs
import pytest

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.paper.assignments import Weights
from laneweave.coordinator.planning.paper.cbs import Improvements
from laneweave.coordinator.planning.paper.tappa import Tappa
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import plan
from oracles.instances import random_request


@pytest.mark.parametrize("seed", [83, 103, 129])
def test_an_assignment_without_a_better_path_set_does_not_end_the_search(seed: int) -> None:
    request = PlanRequest.from_dict(random_request(seed))
    weights, budget = Weights.for_mode(request.mode), Budget(max_nodes=4000)
    without = attrs.evolve(Improvements(), joint=False)
    search = Tappa(request, request.problem(), weights, budget, without, record=True)

    search.run()

    assert search.finished
    assert search.attempts is not None
    costs = [attempt.best_cost for attempt in search.attempts]
    # An assignment without a better path set, and a later assignment with one.
    assert None in costs[: costs.index(int(search.best_cost))]
    assert search.best_cost == plan(attrs.evolve(request, solver="branching")).cost
