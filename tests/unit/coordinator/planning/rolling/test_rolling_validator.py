"""The validator of a stream detects each kind of error, and none in valid plans."""

from __future__ import annotations

import time
from random import Random

import attrs
import pytest

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.rolling.path_search import StreamPlanner
from laneweave.coordinator.planning.rolling.problem import CellPath, StreamPlan, StreamRoad
from laneweave.coordinator.planning.rolling.problem import StreamVehicle as Vehicle
from laneweave.coordinator.planning.rolling.rolling_validator import problems_of_plan
from laneweave.protocol.lattice import Cell

ROAD = StreamRoad(3, 15.0, 60.0, (400.0, 1000.0), 1000.0, 5.0)
MODE_2 = attrs.evolve(ROAD, mode=2, model=ConflictModel(("geometric",)))


def to_the_end(*way: Cell) -> CellPath:
    """Return a path from slot 0 on that stays in its last cell to the end of the road."""
    column = way[-1][0]
    slots = len(way) - 1
    while 15 * column + 60 * slots <= 1000:
        slots += 1
    return way + way[-1:] * (slots + 1 - len(way))


def only_problem(
    vehicles: list[Vehicle],
    ways: dict[str, CellPath],
    *,
    missed: tuple[str, ...] = (),
    road: StreamRoad = ROAD,
    blocked: tuple[Cell, ...] = (),
) -> str:
    (problem,) = problems_of_plan(road, StreamPlan(0, ways, missed), vehicles, blocked)
    return problem


@pytest.mark.parametrize(
    ("way", "problem"),
    [
        (to_the_end((50, 1), (50, 0)), "starts at"),
        (to_the_end((50, 0), (52, 0)), "jumps"),
        (to_the_end((50, 0), (51, 1), (51, 0)), "jumps"),
        (to_the_end((50, 0), (50, -1), (50, 0)), "leaves the road"),
        (to_the_end((50, 0))[:-1], "on the road"),
        (((50, 0),), "on the road"),
        ((*to_the_end((50, 0)), (50, 0)), "beyond the road"),
        (to_the_end((50, 0), (50, 0), (50, 0), (50, 0), (51, 0)), "moves between"),
    ],
)
def test_paths_of_one_vehicle(way: CellPath, problem: str) -> None:
    assert problem in only_problem([Vehicle("v", (50, 0), 0)], {"v": way})


def test_a_path_to_the_end_of_the_road_is_valid() -> None:
    vehicle = Vehicle("v", (50, 0), 1)
    way = to_the_end((50, 0), (51, 0), (51, 1))
    assert problems_of_plan(ROAD, StreamPlan(0, {"v": way}, ()), [vehicle]) == []


def test_held_vehicles_do_not_move() -> None:
    vehicle = Vehicle("v", (50, 0), 1, held=True)
    way = to_the_end((50, 0), (50, 1))
    assert "is held" in only_problem([vehicle], {"v": way})
    standing_still = StreamPlan(0, {"v": to_the_end((50, 0))}, ("v",))
    assert problems_of_plan(ROAD, standing_still, [vehicle]) == []


def test_moves_begin_in_s3() -> None:
    vehicle = Vehicle("v", (26, 0), 0)
    way = to_the_end((26, 0), (27, 0))
    assert "moves between 385.0 m" in only_problem([vehicle], {"v": way})


def test_vehicles_that_miss_their_lanes_are_listed() -> None:
    vehicle = Vehicle("v", (50, 0), 1)
    way = to_the_end((50, 0))
    assert problems_of_plan(ROAD, StreamPlan(0, {"v": way}, ("v",)), [vehicle]) == []
    assert "off their lanes" in only_problem([vehicle], {"v": way})
    assert "starts at" in problems_of_plan(ROAD, StreamPlan(0, {"v": ()}, ()), [vehicle])[0]
    assert "for vehicles" in only_problem([vehicle, Vehicle("w", (51, 0), 0)], {"v": way})


@pytest.mark.parametrize("mode", [1, 2])
def test_blocked_cells_are_left_but_not_entered(mode: int) -> None:
    road = ROAD if mode == 1 else MODE_2
    vehicle = Vehicle("v", (50, 0), 1)
    straight = to_the_end((50, 0), (50, 1))
    ways: dict[str, CellPath] = {"v": straight}
    assert problems_of_plan(road, StreamPlan(0, ways, ()), [vehicle], [(50, 0)]) == []
    assert "enters" in only_problem([vehicle], ways, road=road, blocked=((50, 1),))
    if mode == 2:
        oblique = to_the_end((50, 0), (51, 1))
        problem = only_problem([vehicle], {"v": oblique}, road=road, blocked=((51, 0),))
        assert "enters [(51, 0)]" in problem


@pytest.mark.parametrize(
    ("a", "b", "kind"),
    [
        (((50, 0), (51, 0)), ((51, 0), (51, 0)), "node"),
        (((50, 0), (51, 0)), ((52, 0), (51, 0)), "node"),
        (((50, 0), (51, 0)), ((51, 0), (50, 0)), "edge"),
        (((50, 0), (51, 0)), ((51, 0), (51, 1)), "special-1"),
        (((50, 0), (51, 0)), ((53, 0), (52, 0)), "closing"),
    ],
)
def test_conflicts_are_found_in_either_order(a: CellPath, b: CellPath, kind: str) -> None:
    vehicles = [Vehicle("a", a[0], a[1][1]), Vehicle("b", b[0], b[1][1])]
    ways = {"a": to_the_end(*a), "b": to_the_end(*b)}
    for names in (("a", "b"), ("b", "a")):
        problems = problems_of_plan(
            ROAD, StreamPlan(0, {name: ways[name] for name in names}, ()), vehicles
        )
        assert any(problem.startswith(f"{kind} conflict of") for problem in problems)


def test_validation_is_fast_enough_for_every_plan() -> None:
    random = Random(1)
    cells = [(column, lane) for column in range(65) for lane in range(3)]
    vehicles = [
        Vehicle(f"v{i}", cell, random.randrange(3))
        for i, cell in enumerate(random.sample(cells, 130))
    ]
    plan = StreamPlanner(attrs.evolve(ROAD, max_paths=2000)).plan(0, vehicles)
    took = []
    for _ in range(5):
        began = time.thread_time()
        assert problems_of_plan(ROAD, plan, vehicles) == []
        took.append(time.thread_time() - began)
    # A millisecond and a half where nobody else is at work.
    assert min(took) < 0.01
