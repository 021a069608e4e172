"""The planner must answer with exactly the cost that the oracle proves, and with legal paths."""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import pytest

from laneweave.coordinator.planning.facade import plan
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.launch.bench.request_families import (
    TRAFFIC_KINDS,
    block_request,
    formation_request,
    traffic_request,
)
from laneweave.protocol.lattice import Mode
from laneweave.protocol.scenario.tables import SOLVERS
from oracles import joint_search, milp_oracle
from oracles.instances import (
    CLOSING,
    EVERY_VARIANT,
    VARIANTS,
    large_request,
    meeting_request,
    random_request,
    small_request,
    variant,
)
from oracles.path_rules import check_paths
from oracles.proven import Oracle, by_oracle

INSTANCES = 200
MORE_INSTANCES = 1_600
FORMATION_INSTANCES = 100
LARGE_INSTANCES = 100
CLOSING_INSTANCES = 60
LARGE_DEADLINE_S = 4.0
DEADLINE_S = 60.0
"""Of the others: this is about costs, not about times."""
CHUNK = 10


def _plan(request: dict[str, Any], solver: str = "tappa") -> dict[str, Any]:
    """Return the answer of one solver, without the other one to fall back on."""
    asked = PlanRequest.from_dict({"deadline_s": DEADLINE_S, **request})
    response: dict[str, Any] = plan(asked, solver=solver, fallback=False).to_dict()
    return response


def _faults(request: dict[str, Any], cost: int | None, solver: str) -> list[str]:
    """Return what is wrong with the answer, if the least cost is this; None: there is no plan."""
    response = _plan(request, solver)
    if cost is None:
        found = response["status"]
        return [] if found == "infeasible" else [f"{found}, but there is no solution"]
    claims = {key: response[key] for key in ("status", "cost", "lower_bound")}
    expected = {"status": "optimal", "cost": cost, "lower_bound": cost}
    if claims != expected:
        return [f"answers {claims}, the oracle {expected}"]
    return check_paths(request, response)


@by_oracle
@pytest.mark.parametrize("first", range(0, INSTANCES, CHUNK))
def test_planner_agrees_with_the_oracle(first: int, oracle: Oracle) -> None:
    _agree_on_random(first, oracle)


@pytest.mark.full
@pytest.mark.parametrize("first", range(INSTANCES, INSTANCES + MORE_INSTANCES, CHUNK))
def test_planner_agrees_with_the_oracle_on_many_more(first: int) -> None:
    _agree_on_random(first, milp_oracle.optimal_cost)


def _agree_on_random(first: int, oracle: Oracle) -> None:
    wrong = []
    for seed in range(first, first + CHUNK):
        request = random_request(seed)
        cost = oracle(request)
        wrong += [
            f"seed {seed}, {solver}: {fault}: {json.dumps(request)}"
            for solver in SOLVERS
            for fault in _faults(request, cost, solver)
        ]
    assert not wrong, "\n".join(wrong)


FORMATIONS: tuple[tuple[Mode, tuple[str, ...]], ...] = (
    (1, ("node", "edge")),
    (1, ("node", "edge", "special-1")),
    (2, ("geometric",)),
)


def _formation(seed: int) -> dict[str, Any]:
    mode, conflicts = FORMATIONS[seed % len(FORMATIONS)]
    size = 7 + seed % 6 if mode == 1 else 7
    return formation_request(seed, vehicles=size, mode=mode, conflicts=conflicts).to_dict()


@by_oracle
@pytest.mark.parametrize("first", range(0, FORMATION_INSTANCES, CHUNK))
def test_planner_agrees_with_the_oracle_on_formations_beyond_six(
    first: int, oracle: Oracle
) -> None:
    wrong = []
    for seed in range(first, first + CHUNK):
        request = _formation(seed)
        cost = oracle(request)
        assert cost is not None
        wrong += [f"seed {seed}: {fault}" for fault in _faults(request, cost, "branching")]
    assert not wrong, "\n".join(wrong)


def _interlaced(seed: int) -> PlanRequest:
    return block_request(seed, vehicles=2 + seed % 5, conflicts=TRAFFIC_KINDS)


SIX: dict[str, Callable[[int], PlanRequest]] = {"interlaced": _interlaced, "free": traffic_request}
"""Formations of at most six vehicles, as roads have them."""


@pytest.mark.full
@pytest.mark.parametrize("first", range(0, INSTANCES, CHUNK))
@pytest.mark.parametrize("family", SIX)
def test_planner_agrees_with_the_oracle_on_formations_of_six(family: str, first: int) -> None:
    wrong = []
    for seed in range(first, first + CHUNK):
        request = SIX[family](seed).to_dict()
        cost = milp_oracle.optimal_cost(request)
        wrong += [
            f"seed {seed}, {solver}: {fault}"
            for solver in SOLVERS
            for fault in _faults({**request, "deadline_s": DEADLINE_S}, cost, solver)
        ]
    assert not wrong, "\n".join(wrong)


def _closing(seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a request in which nobody may close up, and the same in which everybody may."""
    mode, conflicts = CLOSING[seed // 2 % len(CLOSING)]
    make = meeting_request if seed % 2 else random_request
    request = make(seed, (mode, conflicts))
    return request, {**request, "conflicts": [kind for kind in conflicts if kind != "closing"]}


@by_oracle
@pytest.mark.parametrize("first", range(0, CLOSING_INSTANCES, CHUNK))
def test_planner_agrees_with_the_oracle_with_closing(first: int, oracle: Oracle) -> None:
    wrong, dearer = [], 0
    for seed in range(first, first + CHUNK):
        request, free = _closing(seed)
        cost = oracle(request)
        dearer += cost != oracle(free)
        wrong += [
            f"seed {seed}, {solver}: {fault}: {json.dumps(request)}"
            for solver in SOLVERS
            for fault in _faults(request, cost, solver)
        ]
    assert not wrong, "\n".join(wrong)
    assert dearer, "than where two may close up"


def compared() -> Iterator[dict[str, Any]]:
    """Return the requests whose costs `proven` may know."""
    yield from map(random_request, range(INSTANCES))
    yield from map(_formation, range(FORMATION_INSTANCES))
    for seed in range(CLOSING_INSTANCES):
        yield from _closing(seed)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(LARGE_INSTANCES))
def test_proofs_on_large_requests_agree_with_the_oracle(seed: int) -> None:
    """Three to five lanes, all conflicts, blocked cells, lists of targets, more than are needed."""
    request = {**large_request(seed), "deadline_s": LARGE_DEADLINE_S}
    response = _plan(request, "branching")
    assert not check_paths(request, response)
    try:
        cost = milp_oracle.optimal_cost(request)
    except milp_oracle.UndecidedError as error:
        pytest.skip(f"the oracle cannot decide this one in a minute: {error}")
    assert cost is not None
    assert response["lower_bound"] <= cost <= response["cost"]
    assert (response["status"] == "optimal") == (response["lower_bound"] == response["cost"])


def test_all_sets_of_conflicts_and_all_sizes_occur() -> None:
    requests = [random_request(seed) for seed in range(INSTANCES)]
    variants = Counter(str(variant(seed)) for seed in range(INSTANCES))
    sizes = Counter(len(request["vehicles"]) for request in requests)
    assert set(variants) == {str(one) for one in VARIANTS}
    assert min(variants.values()) >= 8
    assert set(sizes) == {2, 3, 4, 5, 6}
    assert min(sizes.values()) >= 20
    assert sum(bool(request["grid"]["blocked"]) for request in requests) >= 50
    assert sum(len(request["targets"]) > len(request["vehicles"]) for request in requests) >= 50
    for key in ("lane", "eligible"):
        assert sum(any(key in v for v in request["vehicles"]) for request in requests) >= 50


CROWDED = list(product(range(8), ((3, 2, 2), (4, 1, 2), (3, 2, 3))))


@pytest.mark.parametrize("code", range(len(EVERY_VARIANT)))
def test_planner_agrees_with_joint_search_on_crowded_grids(code: int) -> None:
    """Many of these have no solution, which the planner must prove."""
    mode, conflicts = EVERY_VARIANT[code]
    wrong = []
    for seed, (columns, lanes, count) in CROWDED:
        request = small_request(
            1000 * code + seed,
            columns=columns,
            lanes=lanes,
            count=count,
            mode=mode,
            conflicts=conflicts,
        )
        cost = joint_search.optimal_cost(request)
        for solver in SOLVERS:
            wrong += [
                f"seed {seed}, {solver}: {fault}: {json.dumps(request)}"
                for fault in _faults(request, cost, solver)
            ]
    assert not wrong, "\n".join(wrong)
