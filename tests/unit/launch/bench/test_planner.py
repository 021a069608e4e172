"""`laneweave bench planner`."""

import math

import pytest
from attrs import evolve

from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.planner import FAMILIES, bench_planner, gap_percent, planner_table
from laneweave.launch.bench.request_families import formation_request
from laneweave.protocol.errors import BadInputError


def test_every_family_and_size_gets_a_row() -> None:
    rows = list(
        bench_planner([2, 4], list(FAMILIES), instances=3, seed=5, deadline_s=4.0, solver="tappa")
    )
    assert [(row["family"], row["vehicles"]) for row in rows] == [
        (family, size) for family in FAMILIES for size in (2, 4)
    ]
    for row in rows:
        assert row["optimal"] == row["instances"] == row["answered_in_100_ms"] == 3
        assert 0 < row["cpu_ms"]["p50"] <= row["cpu_ms"]["max"]
        assert row["gap_percent"]["max"] == 0.0
    assert planner_table(rows).row_count == len(rows)


def test_too_many_vehicles_for_a_block_are_refused() -> None:
    with pytest.raises(BadInputError, match="13 vehicles do not fit"):
        FAMILIES["block"].request(0, 13, 4.0)


def test_sizes_are_refused_before_anything_is_measured() -> None:
    found = bench_planner(
        [2, 13], ["node-edge", "block"], instances=1, seed=5, deadline_s=4.0, solver="tappa"
    )
    with pytest.raises(BadInputError, match="13 vehicles do not fit"):
        next(found)


def test_formations_of_traffic_have_fewer_vehicles_than_the_most() -> None:
    (row,) = bench_planner(
        [36], ["traffic"], instances=2, seed=5, deadline_s=4.0, solver="branching"
    )
    assert (row["vehicles"], row["mean_vehicles"] < 14.0) == (36, True)


def test_plans_without_a_proof_have_a_gap() -> None:
    response = plan(formation_request(0, vehicles=4))
    assert gap_percent(response) == 0.0
    cost = response.cost
    assert cost is not None
    assert gap_percent(evolve(response, status="feasible", lower_bound=cost - 1)) == 100 / (
        cost - 1
    )
    assert gap_percent(evolve(response, status="timeout", cost=None)) == math.inf
