"""The validator of a stream detects each kind of error, and none in valid plans."""

from __future__ import annotations

import math
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
from laneweave.protocol.road_layout import LaneSection

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
        ((*to_the_end((50, 0)), (50, 0)), "off the road"),
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


def test_vehicles_that_settle_move_later() -> None:
    vehicle = Vehicle("v", (50, 0), 1, waits=2)
    way = to_the_end((50, 0), (50, 0), (50, 1))
    assert "moves in slot 1, before 2" in only_problem([vehicle], {"v": way})
    later = StreamPlan(0, {"v": to_the_end((50, 0), (50, 0), (50, 0), (50, 1))}, ())
    assert problems_of_plan(ROAD, later, [vehicle]) == []


def test_vehicles_make_only_moves_that_they_can_drive() -> None:
    vehicle = Vehicle("v", (50, 0), 1, moves=frozenset({(0, 1), (0, -1)}))
    way = to_the_end((50, 0), (50, 1), (51, 1))
    assert "cannot drive from (50, 1) to (51, 1)" in only_problem([vehicle], {"v": way})
    lateral = StreamPlan(0, {"v": to_the_end((50, 0), (50, 1))}, ())
    assert problems_of_plan(ROAD, lateral, [vehicle]) == []


def test_moves_begin_in_s3() -> None:
    vehicle = Vehicle("v", (26, 0), 0)
    way = to_the_end((26, 0), (27, 0))
    assert "moves between 385.0 m" in only_problem([vehicle], {"v": way})


DROP = attrs.evolve(
    ROAD,
    sections=(
        LaneSection(0, to_m=1000.0, exit="end"),
        LaneSection(1, to_m=1000.0, exit="end"),
        LaneSection(2, to_m=800.0),
    ),
)
"""The left lane ends at 800 m."""


def test_moves_leave_a_lane_before_its_end_and_do_not_enter_it_later() -> None:
    out = (50, 2), (50, 1)  # from 750 m to 810 m
    assert "where lane 2 is closed" in only_problem(
        [Vehicle("v", out[0], {0, 1})], {"v": to_the_end(*out)}, road=DROP
    )
    in_time = to_the_end((49, 2), (49, 1))  # to 795 m
    plan = StreamPlan(0, {"v": in_time}, ())
    assert problems_of_plan(DROP, plan, [Vehicle("v", (49, 2), {0, 1})]) == []
    back = to_the_end((54, 1), (54, 2))
    assert "where lane 2 is closed" in only_problem(
        [Vehicle("v", (54, 1), {0, 1})], {"v": back[:2]}, missed=("v",), road=DROP
    )


def test_paths_end_where_their_lanes_do() -> None:
    vehicle = Vehicle("v", (53, 2), {0, 1})
    way = ((53, 2), (53, 2))  # at 795 m, then at 855 m
    assert problems_of_plan(DROP, StreamPlan(0, {"v": way}, ("v",)), [vehicle]) == []
    assert "off their targets" in only_problem([vehicle], {"v": way}, road=DROP)
    longer = (*way, (53, 2))
    assert "continues from" in only_problem([vehicle], {"v": longer}, missed=("v",), road=DROP)
    elsewhere = StreamPlan(0, {"v": way}, ())
    assert problems_of_plan(DROP, elsewhere, [Vehicle("v", (53, 2), 2)]) == []


def test_a_lane_that_opens_again_soon_ends_earlier() -> None:
    """In a slot a vehicle can gain 75 m: it must not pass a closed part of 20 m unnoticed."""
    again = LaneSection(2, 820.0, 1000.0, exit="end")
    road = attrs.evolve(DROP, sections=(*DROP.sections, again))
    assert road.lane_sections[2] == ((-math.inf, 745.0, 2), (820.0, 1000.0, 3))
    vehicle = Vehicle("v", (49, 2), 3)
    way = ((49, 2), (49, 2))  # at 735 m, then at 795 m
    assert problems_of_plan(road, StreamPlan(0, {"v": way}, ("v",)), [vehicle]) == []


def test_vehicles_that_miss_their_lanes_are_listed() -> None:
    vehicle = Vehicle("v", (50, 0), 1)
    way = to_the_end((50, 0))
    assert problems_of_plan(ROAD, StreamPlan(0, {"v": way}, ("v",)), [vehicle]) == []
    assert "off their targets" in only_problem([vehicle], {"v": way})
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
