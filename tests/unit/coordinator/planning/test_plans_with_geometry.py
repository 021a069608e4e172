"""Plans whose conflicts are computed from geometry: exact, and driven with sufficient gaps."""

from collections.abc import Iterator
from functools import cache
from itertools import product
from random import Random
from typing import Any

import attrs
import numpy as np
import pytest

from laneweave.agents.driving.trajectory import move_profile
from laneweave.coordinator.planning import request as request_module
from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.conflict_kinds import ConflictTable
from laneweave.coordinator.planning.exact.reachability import explore
from laneweave.coordinator.planning.geometry.conflict_table import conflict_table
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.plan_validator import problems_of_paths
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import formation_request
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Mode, displacements
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import SOLVERS
from oracles import joint_search
from oracles.instances import random_request, small_request
from oracles.moving_bodies import Bodies, Profile, drive, least_gap_of_plan_m
from oracles.path_rules import check_paths
from oracles.proven import Oracle, by_oracle
from support.planning_oracles import assert_agreement
from support.variants import variants
from unit.coordinator.planning.test_against_milp import chunks

ON_TIME = {"lateness_s": 0.0}
LATE = {"lateness_s": 0.5}
CITY = {
    "length_m": 4.0,
    "width_m": 1.7,
    "lane_width_m": 3.0,
    "pitch_m": 12.0,
    "move_s": 4.4,
    "slot_s": 5.0,
    "speed_mps": 13.0,
    "clearance_along_m": 3.5,
    "clearance_across_m": 0.2,
    "lateness_s": 0.6,
}
GEOMETRIES: tuple[dict[str, float], ...] = ({}, ON_TIME, LATE, CITY)
TIGHT = {
    "clearance_along_m": 1.0,
    "clearance_across_m": 0.0,
    "profile_error_along_m": 0.0,
    "profile_error_across_m": 0.0,
    "lateness_s": 0.0,
}
"""Small enough that vehicles may follow each other around corners."""
KINDS = (["geometric"], ["geometric"], ["node", "geometric"], ["special-1", "geometric"])

INSTANCES = 60


def _request(seed: int) -> dict[str, Any]:
    geometry = GEOMETRIES[seed % len(GEOMETRIES)]
    kinds = KINDS[seed // len(GEOMETRIES) % len(KINDS)]
    return {**random_request(seed), "conflicts": kinds, "geometry": geometry}


def compared() -> Iterator[dict[str, Any]]:
    """Return the requests whose costs may be in `proven`."""
    yield from map(_request, range(INSTANCES))


@pytest.mark.slow
@by_oracle
@chunks(INSTANCES)
def test_planner_agrees_with_the_oracle(seeds: range, oracle: Oracle) -> None:
    """The oracle computes conflicts by simulating bodies."""
    assert_agreement(map(_request, seeds), oracle)


CROWDED = ((3, 2, 2), (4, 1, 2), (3, 2, 3), (2, 2, 3), (2, 2, 4))


@pytest.mark.slow
@pytest.mark.parametrize("geometry", variants([*GEOMETRIES, TIGHT], 2), ids=str)
@pytest.mark.parametrize("mode", variants([2, 1]))
def test_planner_agrees_with_joint_search_on_crowded_grids(
    geometry: dict[str, float], mode: Mode
) -> None:
    assert_agreement(
        (
            small_request(
                seed, columns=columns, lanes=lanes, count=count, mode=mode, conflicts=["geometric"]
            )
            | {"geometry": geometry}
            for seed, (columns, lanes, count) in product(range(5), CROWDED)
        ),
        joint_search.optimal_cost,
    )


# ------------------------------------------------------------------------------------- trains

TRAIN = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 5, "lanes": 1},
    "mode": 1,
    "conflicts": ["geometric"],
    "vehicles": [{"id": f"v{i}", "cell": [i, 0], "eligible": [i]} for i in range(4)],
    "targets": [[i + 1, 0] for i in range(4)],
}
"""Four vehicles without a gap, each to go one cell ahead."""


@pytest.mark.parametrize(
    ("geometry", "cost"), [(None, 10), ({}, 10), ({"lateness_s": 0.8}, 10), (LATE, 4), (ON_TIME, 4)]
)
def test_a_train_starts_together_with_limited_lateness(
    geometry: dict[str, float] | None, cost: int
) -> None:
    more = {} if geometry is None else {"geometry": geometry}
    for solver in SOLVERS:
        response = plan(PlanRequest.from_dict({**TRAIN, **more}), solver=solver)
        assert (response.status, response.cost) == ("optimal", cost)


def test_computing_the_conflict_table_counts_for_the_deadline(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = [0.0]

    def slow_table(geometry: BodyGeometry) -> ConflictTable:
        now_s[0] += 10.0
        return conflict_table(geometry)

    monkeypatch.setattr(request_module, "conflict_table", slow_table)
    request = attrs.evolve(
        formation_request(0, vehicles=4, mode=2), geometry=BodyGeometry(), deadline_s=5.0
    )
    assert plan(request, clock=lambda: now_s[0]).status == "timeout"


def test_paths_that_are_too_close_are_found() -> None:
    """The validator, the rules and driven bodies detect a train in which a vehicle is too late."""
    paths = [[[i, 0], [i + 1, 0]] for i in range(4)]
    response = {"paths": paths, "assignment": [0, 1, 2, 3], "steps": 1, "cost": 4}
    late = {**TRAIN, "geometry": {"lateness_s": 1.2}}
    cells = [[(i, 0), (i + 1, 0)] for i in range(4)]
    assert len(problems_of_paths(PlanRequest.from_dict(late), (0, 1, 2, 3), cells)) == 3
    assert len(check_paths(late, response)) == 3
    assert min(drive(late, response, Random(seed)) for seed in range(20)) < 2.0
    in_time = {**TRAIN, "geometry": LATE}
    assert problems_of_paths(PlanRequest.from_dict(in_time), (0, 1, 2, 3), cells) == []
    assert check_paths(in_time, response) == []
    assert 6.0 < min(drive(in_time, response, Random(seed)) for seed in range(20)) < 7.0


@pytest.mark.parametrize(("geometry", "cost"), [(TIGHT, 6), (ON_TIME, None), ({}, None)], ids=str)
def test_a_ring_can_only_turn_as_a_whole(geometry: dict[str, float], cost: int | None) -> None:
    """There is no free cell, so the joint search must let vehicles follow each other."""
    ring = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1)]
    document = {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": 3, "lanes": 2},
        "mode": 1,
        "conflicts": ["geometric"],
        "vehicles": [
            {"id": f"v{i}", "cell": list(cell), "eligible": [i]} for i, cell in enumerate(ring)
        ],
        "targets": [list(ring[(i + 1) % 6]) for i in range(6)],
        "geometry": geometry,
    }
    assert joint_search.optimal_cost(document) == cost
    request = PlanRequest.from_dict(document)
    verdict = explore(request.problem(), request.choices(), Budget(), 10**6)
    assert verdict.infeasible == (cost is None)
    assert (verdict.solution is None) == (cost is None)
    assert plan(request).cost == cost


# ------------------------------------------------------------------ what agents really drive


@cache
def driven() -> Profile:
    """The trajectories of agents in the default scenario."""
    scenario = Scenario()
    states = {
        step: move_profile(scenario, scenario.vehicle, *step).states for step in displacements(2)
    }
    return Profile(
        scenario.timing.move_s,
        {step: array[:, [0, 3]] for step, array in states.items()},
        {step: array[:, [1, 4]] for step, array in states.items()},
    )


@pytest.mark.slow
@pytest.mark.parametrize("lateness_s", [0.0, 0.2, 0.5])
@pytest.mark.more
def test_formations_keep_the_clearance_when_agents_drive_them(lateness_s: float) -> None:
    """Eight vehicles in mode 2 follow a timetable with delays."""
    least_m = []
    for seed in range(4):
        document = formation_request(seed, vehicles=8, mode=2, deadline_s=60.0).to_dict()
        document["geometry"] = {"lateness_s": lateness_s}
        response = plan(PlanRequest.from_dict(document), max_nodes=300)
        paths = [list(path) for path in response.paths]
        bodies = Bodies(lateness_s=lateness_s)
        for number in range(4):
            rng = Random(10 * seed + number)
            least_m.append(
                least_gap_of_plan_m(bodies, paths, rng, lateness_s, bodies.slot_s, driven())
            )
    assert min(least_m) >= 5.0
    # Vehicles do follow each other: with footprints 9.8 m would remain.
    assert lateness_s == 0.0 or min(least_m) < 9.0
    assert np.isfinite(least_m).all()


@pytest.mark.parametrize(("late_s", "enough"), [(1.59, True), (1.9, False)])
def test_the_limit_of_lateness_keeps_steps_apart(late_s: float, enough: bool) -> None:
    """The table compares moves of one step; here the vehicle ahead arrives during the next step."""
    paths = [[(-1, 0), (0, 0), (1, 1)], [(0, 0), (1, 0), (1, 0)]]
    if enough:
        BodyGeometry(lateness_s=late_s)
    else:
        with pytest.raises(BadInputError, match="when the next step begins"):
            BodyGeometry(lateness_s=late_s)
    bodies = Bodies(lateness_s=late_s)
    gaps_m = [
        least_gap_of_plan_m(
            bodies,
            paths,
            Random(seed),
            late_s,
            bodies.slot_s,
            window_s=(bodies.slot_s, bodies.move_s + late_s),
        )
        for seed in range(200)
    ]
    assert (min(gaps_m) >= bodies.clearance_along_m) == enough
    assert abs(min(gaps_m) - bodies.clearance_along_m) < 1.5
