"""The planner must return legal paths with the cost that the oracle proves."""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any

import pytest

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import (
    TRAFFIC_KINDS,
    block_request,
    formation_request,
    traffic_request,
)
from laneweave.protocol.lattice import Mode
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
from support.planning_oracles import assert_agreement
from support.variants import variants

INSTANCES = 200
QUICK_INSTANCES = 10
CI_INSTANCES = 120
"""Number of instances that `make test` solves; `make test-full` solves all."""
LONG_INSTANCES = (27,)
"""Instances that TAPPA solves in 8 s; it solves most others in less than 0.1 s."""
MORE_INSTANCES = 1_600
MORE_LIMIT_S = 500.0
"""The oracle takes 130 s for instance 424, on an idle machine."""
FORMATION_INSTANCES = 100
LARGE_INSTANCES = 100
CLOSING_INSTANCES = 60
LARGE_DEADLINE_S = 4.0
CHUNK = 10


def chunks(instances: int, first: int = 0) -> pytest.MarkDecorator:
    """Run a test with `CHUNK` seeds at a time."""
    every = range(first, first + instances, CHUNK)
    chosen = [pytest.param(range(k, k + CHUNK), marks=_marks_from(k)) for k in every]
    return pytest.mark.parametrize("seeds", chosen, ids=str)


def _marks_from(seed: int) -> list[pytest.MarkDecorator]:
    if seed < QUICK_INSTANCES:
        return []
    return [pytest.mark.more if seed < CI_INSTANCES else pytest.mark.full]


@pytest.mark.slow
@by_oracle
@chunks(INSTANCES)
def test_planner_agrees_with_the_oracle(seeds: range, oracle: Oracle) -> None:
    quick = (seed for seed in seeds if seed not in LONG_INSTANCES)
    assert_agreement(map(random_request, quick), oracle)


@pytest.mark.full
@by_oracle
def test_planner_agrees_with_the_oracle_on_long_instances(oracle: Oracle) -> None:
    assert_agreement(map(random_request, LONG_INSTANCES), oracle)


@pytest.mark.full
@pytest.mark.timeout(3600)
@chunks(MORE_INSTANCES, first=INSTANCES)
def test_planner_agrees_with_the_oracle_on_many_more(seeds: range) -> None:
    oracle = partial(milp_oracle.optimal_cost, limit_s=MORE_LIMIT_S)
    assert_agreement(map(random_request, seeds), oracle)


FORMATIONS: tuple[tuple[Mode, tuple[str, ...]], ...] = (
    (1, ("node", "edge")),
    (1, ("node", "edge", "special-1")),
    (2, ("geometric",)),
)


def _formation(seed: int) -> dict[str, Any]:
    mode, conflicts = FORMATIONS[seed % len(FORMATIONS)]
    size = 7 + seed % 6 if mode == 1 else 7
    return formation_request(seed, vehicles=size, mode=mode, conflicts=conflicts).to_dict()


@pytest.mark.slow
@by_oracle
@chunks(FORMATION_INSTANCES)
def test_planner_agrees_with_the_oracle_on_formations_beyond_six(
    seeds: range, oracle: Oracle
) -> None:
    assert_agreement(map(_formation, seeds), oracle, ["branching"])


def _interlaced(seed: int) -> PlanRequest:
    return block_request(seed, vehicles=2 + seed % 5, conflicts=TRAFFIC_KINDS)


@pytest.mark.full
@chunks(INSTANCES)
@pytest.mark.parametrize("family", [_interlaced, traffic_request])
def test_planner_agrees_with_the_oracle_on_formations_of_six(
    family: Callable[[int], PlanRequest], seeds: range
) -> None:
    """Formations of at most six vehicles, as on the road."""
    assert_agreement((family(seed).to_dict() for seed in seeds), milp_oracle.optimal_cost)


def _closing(seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a request in which vehicles may not close up, and the same in which they may."""
    mode, conflicts = CLOSING[seed // 2 % len(CLOSING)]
    make = meeting_request if seed % 2 else random_request
    request = make(seed, (mode, conflicts))
    return request, {**request, "conflicts": [kind for kind in conflicts if kind != "closing"]}


@pytest.mark.slow
@by_oracle
@chunks(CLOSING_INSTANCES)
def test_planner_agrees_with_the_oracle_with_closing(seeds: range, oracle: Oracle) -> None:
    pairs = [_closing(seed) for seed in seeds]
    assert_agreement([request for request, _ in pairs], oracle)
    assert any(oracle(request) != oracle(free) for request, free in pairs), "closing costs nothing"


def compared() -> Iterator[dict[str, Any]]:
    """Return the requests whose costs may be in `proven`."""
    yield from map(random_request, range(INSTANCES))
    yield from map(_formation, range(FORMATION_INSTANCES))
    for seed in range(CLOSING_INSTANCES):
        yield from _closing(seed)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(LARGE_INSTANCES))
def test_proofs_on_large_requests_agree_with_the_oracle(seed: int) -> None:
    """Three to five lanes, all conflicts, blocked cells, lists of targets, more than are needed."""
    request = {**large_request(seed), "deadline_s": LARGE_DEADLINE_S}
    response = plan(PlanRequest.from_dict(request), solver="branching", fallback=False).to_dict()
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
    drawn = Counter(str(variant(seed)) for seed in range(INSTANCES))
    sizes = Counter(len(request["vehicles"]) for request in requests)
    assert set(drawn) == {str(one) for one in VARIANTS}
    assert min(drawn.values()) >= 8
    assert set(sizes) == {2, 3, 4, 5, 6}
    assert min(sizes.values()) >= 20
    assert sum(bool(request["grid"]["blocked"]) for request in requests) >= 50
    assert sum(len(request["targets"]) > len(request["vehicles"]) for request in requests) >= 50
    for key in ("lane", "eligible"):
        assert sum(any(key in v for v in request["vehicles"]) for request in requests) >= 50


EVERY_CODE = sorted(range(len(EVERY_VARIANT)), key=lambda code: code % 3)
CROWDED = list(product(range(8), ((3, 2, 2), (4, 1, 2), (3, 2, 3))))


@pytest.mark.slow
@pytest.mark.parametrize("code", variants(EVERY_CODE, count=len(EVERY_CODE) // 9))
def test_planner_agrees_with_joint_search_on_crowded_grids(code: int) -> None:
    """Many of these have no solution, which the planner must prove."""
    mode, conflicts = EVERY_VARIANT[code]
    assert_agreement(
        (
            small_request(
                1000 * code + seed,
                columns=columns,
                lanes=lanes,
                count=count,
                mode=mode,
                conflicts=conflicts,
            )
            for seed, (columns, lanes, count) in CROWDED
        ),
        joint_search.optimal_cost,
    )
