"""Moves that begin later in their slot, as soon as both lanes are open."""

from __future__ import annotations

import pytest
from attrs import evolve

from laneweave.coordinator.planning.rolling.path_search import StreamPlanner
from laneweave.coordinator.planning.rolling.problem import StreamRoad, StreamVehicle
from laneweave.coordinator.planning.rolling.rolling_validator import problems_of_plan
from laneweave.protocol.road_layout import LaneSection

OPENS_M, LINE_M = 400.0, 500.0
LATERAL = frozenset({(0, 1), (0, -1)})
SHARED = StreamRoad(
    3,
    15.0,
    60.0,
    (100.0, 1000.0),
    1000.0,
    5.0,
    sections=(
        LaneSection(0, OPENS_M, LINE_M, exit="off"),
        LaneSection(0, 520.0, 800.0, moves_from_m=600.0),
        LaneSection(1, to_m=1000.0, exit="end"),
        LaneSection(2, to_m=1000.0, exit="end"),
    ),
)
"""A ramp behind an exit in lane 0; a move takes 60 m, and the exit's lane is open for 100 m."""
EARLY = evolve(SHARED, early_m=10.0)


def reaches_exit(road: StreamRoad, column: int) -> bool:
    leaving = StreamVehicle("x", (column, 1), 0, moves=LATERAL)
    plan = StreamPlanner(road).plan(0, [leaving])
    assert problems_of_plan(road, plan, [leaving]) == []
    return not plan.missed


def test_every_vehicle_has_a_slot_for_the_exit() -> None:
    # Columns 8 to 11 are at all phases of the slots.
    assert all(reaches_exit(EARLY, column) for column in range(8, 12))
    assert not all(reaches_exit(SHARED, column) for column in range(8, 12))


def test_every_vehicle_has_a_slot_for_the_shortest_possible_exit() -> None:
    """At the beginning of a slot it may still be before the lane in which it moves."""
    shortest = evolve(SHARED.sections[0], to_m=OPENS_M + 5.0 - 10.0 + 60.0)
    road = evolve(EARLY, sections=(shortest, *SHARED.sections[1:]))
    assert all(reaches_exit(road, column) for column in range(8, 12))


def test_a_move_that_waits_for_its_lane_ends_before_the_other_lane_does() -> None:
    """It begins at 395 m and ends at 455 m, 20 m farther than in its own lane alone."""
    for end_m, possible in ((456.0, True), (454.0, False)):
        beside = evolve(SHARED.sections[2], to_m=end_m, exit="")
        road = evolve(EARLY, sections=(*SHARED.sections[:2], beside, SHARED.sections[3]))
        leaving = StreamVehicle("x", (25, 1), 0, moves=LATERAL)
        plan = StreamPlanner(road).plan(0, [leaving])
        assert problems_of_plan(road, plan, [leaving]) == []
        assert (plan.missed == ()) == possible


def test_a_vehicle_on_the_ramp_gets_on_the_road_before_its_lane_ends() -> None:
    for column in range(35, 39):
        on_ramp = StreamVehicle("r", (column, 0), {2, 3}, moves=LATERAL)
        plan = StreamPlanner(EARLY).plan(0, [on_ramp])
        assert problems_of_plan(EARLY, plan, [on_ramp]) == []
        assert not plan.missed


@pytest.mark.parametrize(
    ("front_m", "start_m"),
    [
        (300.0, 300.0),  # far from any opening
        (334.0, 334.0),  # it opens in the next slot
        (336.0, 395.0),  # 5 m of the body are behind 400 m, but 10 m of it need not be
        (395.0, 395.0),
        (440.0, 440.0),
        (536.0, 595.0),  # where moves begin on the ramp
    ],
)
def test_moves_begin_as_soon_as_both_lanes_are_open(front_m: float, start_m: float) -> None:
    assert EARLY.start_m(front_m, {0, 1}) == start_m
    assert EARLY.start_m(front_m, {1, 2}) == front_m
    assert SHARED.start_m(front_m, {0, 1}) == front_m


def test_a_move_that_would_end_behind_the_line_is_an_error() -> None:
    leaving = StreamVehicle("x", (30, 1), 0, moves=LATERAL)  # at 450 m, it would end at 510 m
    plan = StreamPlanner(EARLY).plan(0, [leaving])
    assert plan.missed == ("x",)
    wrong = evolve(plan, paths={"x": ((30, 1), (30, 0))}, missed=())
    assert any("where lane 0 is closed" in one for one in problems_of_plan(EARLY, wrong, [leaving]))
    early = evolve(plan, paths={"x": ((22, 1), (22, 0))}, missed=())  # at 330 m
    before = [evolve(leaving, cell=(22, 1))]
    assert any("where lane 0 is closed" in one for one in problems_of_plan(EARLY, early, before))


def test_others_make_room_for_a_vehicle_that_still_settles() -> None:
    """It can move only in slot 3, in the last before its lane ends."""
    ramp = StreamVehicle("r", (35, 0), {2, 3}, moves=LATERAL, waits=2)
    beside = [StreamVehicle(f"v{lane}", (35, lane), {2, 3}, moves=LATERAL) for lane in (1,)]
    plan = StreamPlanner(EARLY).plan(0, [ramp, *beside])
    assert problems_of_plan(EARLY, plan, [ramp, *beside]) == []
    assert plan.missed == ()
    lanes = [lane for _, lane in plan.paths["r"]]
    assert lanes[:3] == [0, 0, 0]
    assert lanes[-1] == 1
    earlier = StreamPlanner(EARLY).plan(0, [evolve(ramp, waits=0), *beside])
    again = StreamPlanner(EARLY).plan(0, [ramp, *beside], earlier)
    assert problems_of_plan(EARLY, again, [ramp, *beside]) == []
