"""Requested moves: which are granted, and that every plan is valid."""

from __future__ import annotations

from random import Random
from typing import Any

import attrs
import pytest

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.rolling.problem import StreamRoad, StreamVehicle
from laneweave.coordinator.planning.rolling.requested_moves import RequestPlanner, is_possible
from laneweave.coordinator.planning.rolling.rolling_validator import problems_of_plan
from laneweave.protocol.lattice import Cell, displacements
from laneweave.protocol.road_layout import LaneSection, end_exit

ROAD = StreamRoad(3, 15.0, 60.0, (400.0, 1000.0), 1000.0, 5.0)
MODE_2 = attrs.evolve(ROAD, mode=2, model=ConflictModel(("geometric",)))
FORWARD, BACK, LEFT, RIGHT = (1, 0), (-1, 0), (0, 1), (0, -1)


def grant(
    requests: dict[Cell, Cell],
    blocked: tuple[Cell, ...] = (),
    **changes: Any,  # noqa: ANN401 (fields of the vehicles)
) -> set[Cell]:
    """Return the cells whose vehicles get their requests; a request of (0, 0) is none."""
    vehicles = [attrs.evolve(StreamVehicle(f"{cell}", cell, 0), **changes) for cell in requests]
    planner = RequestPlanner(ROAD)
    planner.requests = {f"{cell}": move for cell, move in requests.items() if move != (0, 0)}
    plan = planner.plan(0, vehicles, blocked=blocked)
    assert problems_of_plan(ROAD, plan, vehicles, blocked) == []
    for cell, move in requests.items():
        after = plan.paths[f"{cell}"][:2][-1]
        assert (after != cell) == (f"{cell}" in planner.granted)
        assert after in (cell, (cell[0] + move[0], cell[1] + move[1]))
    return {cell for cell in requests if f"{cell}" in planner.granted}


def test_vehicle_without_request_holds() -> None:
    assert grant({(40, 1): (0, 0)}) == set()


@pytest.mark.parametrize("move", [FORWARD, BACK, LEFT, RIGHT])
def test_free_cell(move: Cell) -> None:
    assert grant({(40, 1): move}) == {(40, 1)}


def test_of_two_requests_for_one_cell_that_of_the_vehicle_ahead_is_granted() -> None:
    assert grant({(40, 1): FORWARD, (42, 1): BACK}) == {(42, 1)}
    assert grant({(40, 0): LEFT, (40, 2): RIGHT}) == {(40, 0)}


def test_a_refused_request_conflicts_with_no_other() -> None:
    """A request that is refused itself keeps no other vehicle from moving."""
    assert grant({(40, 1): FORWARD, (42, 1): BACK, (43, 1): BACK}) == {(42, 1)}


def test_neighbours_do_not_swap() -> None:
    assert grant({(40, 0): LEFT, (40, 1): RIGHT}) == set()
    assert grant({(40, 1): FORWARD, (41, 1): BACK}) == set()


def test_in_a_row_only_the_first_vehicle_advances() -> None:
    # The others would enter cells that are left in the same slot.
    row = {(40, 1): FORWARD, (41, 1): FORWARD, (42, 1): FORWARD}
    assert grant(row) == {(42, 1)}
    assert grant({**row, (43, 1): (0, 0)}) == set()


def test_road_type_and_state_limit_moves() -> None:
    assert grant({(40, 0): RIGHT}) == set()
    assert grant({(40, 2): LEFT}) == set()
    assert grant({(20, 1): LEFT}) == set()  # 300 m from the start; moves begin at 400 m
    assert grant({(66, 1): LEFT}) == set()  # it passes the end of the road in this slot
    assert grant({(70, 1): LEFT}) == set()  # it has passed the end
    assert grant({(40, 1): (1, 1)}) == set()  # not in mode 1
    assert grant({(40, 1): LEFT}, blocked=((40, 2),)) == set()
    assert grant({(40, 1): LEFT}, held=True) == set()
    assert grant({(40, 1): LEFT}, waits=1) == set()
    assert grant({(40, 1): LEFT}, moves=frozenset({RIGHT})) == set()


def test_lane_that_ends() -> None:
    sections = (
        LaneSection(0, to_m=700.0),
        LaneSection(1, to_m=1000.0, exit=end_exit(1)),
        LaneSection(2, to_m=1000.0, exit=end_exit(2)),
    )
    road = attrs.evolve(ROAD, sections=sections)
    assert is_possible(road, 0, StreamVehicle("v", (40, 1), 1), RIGHT)
    assert not is_possible(road, 0, StreamVehicle("v", (45, 1), 1), RIGHT)


@pytest.mark.parametrize("road", [ROAD, MODE_2], ids=["mode 1", "mode 2"])
def test_plans_of_random_requests_are_valid(road: StreamRoad) -> None:
    rng = Random(1)
    granted = refused = 0
    for _ in range(150):
        cells = rng.sample([(c, lane) for c in range(34, 46) for lane in range(3)], 24)
        vehicles = [
            StreamVehicle(f"v{n}", cell, rng.randrange(3), held=rng.random() < 0.1)
            for n, cell in enumerate(cells)
        ]
        free = [(c, lane) for c in range(33, 47) for lane in range(3) if (c, lane) not in cells]
        blocked = rng.sample(free, 2)
        planner = RequestPlanner(road)
        planner.requests = {v.vehicle: rng.choice(displacements(2)) for v in vehicles}
        plan = planner.plan(0, vehicles, None, blocked)
        assert problems_of_plan(road, plan, vehicles, blocked) == []
        granted += len(planner.granted)
        refused += len(planner.requests) - len(planner.granted)
    assert granted > 200
    assert refused > 200
