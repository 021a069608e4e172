"""Stages of the way of a formation: which lanes are open, and which ones vehicles need."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from attrs import evolve
from hypothesis import assume, given
from hypothesis import strategies as st

from laneweave.coordinator.formations.roster import (
    STAGE_LEAD_S,
    moves_end_s,
    settled_s,
    sorting_start_s,
    stage_at,
    stage_begin_s,
    stage_end_s,
)
from laneweave.coordinator.formations.stages import (
    LEFT_M,
    Overtaking,
    Stage,
    stages,
    where_overtaken,
    with_queues,
)
from laneweave.protocol.road_layout import ANY_LANE, ClearedPart, TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import DrivingStructure, FormationSettings
from laneweave.protocol.scenario.road_tables import Closure, Entrance, Exit, Road
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.wire.messages import Census, CensusEntry, Name, OffLattice

ROOM_M = re_entry(Scenario(road=Road(closures=(Closure(0, 800.0),)))).room_m
"""Distance between a line and the end of its lane."""
LENGTHS = Road(s1_m=50.0, s2_m=100.0, s3_m=850.0)


def road(*closures: Closure, lanes: int = 3) -> Scenario:
    return Scenario(road=evolve(LENGTHS, lanes=lanes, closures=closures))


STRAIGHT = road()
DROP = road(Closure(0, 800.0))
BLOCKED = road(Closure(0, 600.0, 760.0))
OFF_RAMP = evolve(
    road(Closure(0, 0.0, 500.0), Closure(0, 800.0), lanes=4), exit=(Exit("off", (0,), 800.0),)
)
WEAVING = evolve(
    road(Closure(0, 0.0, 250.0), Closure(0, 700.0), lanes=4),
    entrance=(Entrance("on", 0, 250.0, 400.0, 600.0),),
    exit=(Exit("off", (0,), 700.0),),
)


def bounds(scenario: Scenario) -> list[tuple[float, float]]:
    return [(stage.from_m, stage.to_m) for stage in stages(scenario)]


def lanes(stage: Stage) -> tuple[list[int], list[int]]:
    return sorted(stage.lanes), sorted(stage.ending_lanes)


def test_lane_sorting_is_the_only_stage_of_a_straight_road() -> None:
    (stage,) = stages(STRAIGHT)
    assert (stage.from_m, stage.to_m, lanes(stage)) == (150.0, 1000.0, ([0, 1, 2], []))
    assert [stage.goal_lanes(lane) for lane in range(3)] == [{0}, {1}, {2}]
    assert stage.goal_lanes(ANY_LANE) == {0, 1, 2}


def test_structures_are_stages_before() -> None:
    structure = DrivingStructure(20.0, "parallel", (0, 1))
    scenario = evolve(STRAIGHT, formation=FormationSettings(structures=(structure,)))
    assert bounds(scenario) == [(20.0, 150.0), (150.0, 1000.0)]
    assert [stage.structure for stage in stages(scenario)] == [structure, None]


def test_a_lane_that_ends_is_left_before_its_line() -> None:
    assert bounds(DROP) == [(150.0, 800.0 - ROOM_M), (800.0 - ROOM_M, 1000.0)]
    before, after = stages(DROP)
    assert lanes(before) == ([0, 1, 2], [0])
    assert lanes(after) == ([1, 2], [])
    for preferred, goals in ((ANY_LANE, {1, 2}), (1, {1}), (2, {2})):
        assert before.goal_lanes(preferred) == after.goal_lanes(preferred) == goals


def test_a_vehicle_passes_a_closed_part_in_the_nearest_lane() -> None:
    before, beside, behind = stages(BLOCKED)
    assert (beside.from_m, beside.to_m) == (600.0 - ROOM_M, 760.0)
    assert lanes(before) == ([0, 1, 2], [0])
    assert lanes(beside) == ([1, 2], [])
    assert lanes(behind) == ([0, 1, 2], [])
    assert [stage.goal_lanes(0) for stage in (before, beside, behind)] == [{1}, {1}, {0}]
    assert [stage.goal_lanes(ANY_LANE) for stage in (before, behind)] == [{1, 2}, {0, 1, 2}]
    assert [stage.is_last_for(0) for stage in (before, beside, behind)] == [False, False, True]


def test_who_leaves_by_an_exit_waits_beside_its_lane_and_the_others_leave_the_lane() -> None:
    before, beside, behind = stages(OFF_RAMP)
    assert (before.to_m, beside.to_m) == (500.0, 800.0 - ROOM_M)
    assert before.goal_lanes(ANY_LANE, "off") == {1}
    assert beside.goal_lanes(ANY_LANE, "off") == {0}
    assert beside.goal_lanes(ANY_LANE) == {1, 2, 3}
    assert beside.goal_lanes(3) == {3}
    # Who has not reached the lane drives on; who is in it still leaves there.
    assert behind.goal_lanes(ANY_LANE, "off") == {0, 1, 2, 3}
    assert [stage.is_last_for(ANY_LANE, "off") for stage in (before, beside)] == [False, True]


def test_beside_a_short_closed_part_nothing_is_planned() -> None:
    assert bounds(road(Closure(0, 600.0, 620.0))) == [(150.0, 600.0 - ROOM_M), (620.0, 1000.0)]


def test_stages_begin_where_formations_are_complete() -> None:
    """Before the ramp has joined the road, nothing can be planned that ends in time."""
    first, second = stages(WEAVING)
    assert (first.from_m, first.to_m) == (400.0, 700.0 - ROOM_M)
    assert lanes(first) == ([0, 1, 2, 3], [0])
    assert lanes(second) == ([1, 2, 3], [])


@pytest.mark.parametrize("scenario", [STRAIGHT, DROP, BLOCKED, OFF_RAMP, WEAVING])
@given(destination=st.sampled_from(["end", "off"]), preferred=st.integers(-1, 3))
def test_goal_lanes_are_open_and_go_on_or_lead_to_the_destination(
    scenario: Scenario, destination: str, preferred: int
) -> None:
    for stage in stages(scenario):
        goals = stage.goal_lanes(preferred, destination)
        assert goals
        leaving = {
            one.lane for one in scenario.geometry.sections if one.serves(preferred, destination)
        }
        assert goals <= stage.through_lanes | leaving
        assert stage.through_lanes <= stage.lanes
        assert stage.through_lanes, "nobody can go on"
        for one in scenario.geometry.sections:
            closed = one.to_m <= stage.from_m or one.from_m >= stage.to_m
            others = [
                two for two in scenario.geometry.sections if two.lane == one.lane and two != one
            ]
            assert not closed or others or one.lane not in stage.lanes


@pytest.mark.parametrize("scenario", [DROP, BLOCKED, OFF_RAMP, WEAVING])
def test_stages_follow_each_other_as_the_formation_passes_them(scenario: Scenario) -> None:
    lattice, numbers = scenario.lattice, (3, 4, 5)
    of_road = stages(scenario)
    found = [stage_at(numbers, 0.1 * tick, of_road, scenario).number for tick in range(1200)]
    assert found == sorted(found)
    assert {*found} == {*range(len(of_road))}
    for number in range(1, len(of_road)):
        first_s = 0.1 * found.index(number)
        # All bodies have passed the stage before; planning takes a part of the time that is left.
        rear_m = lattice.cell_s_m(-5, first_s)
        assert rear_m >= of_road[number - 1].to_m - 1e-6
        begin_s = stage_begin_s(numbers, of_road[number], scenario)
        assert first_s >= begin_s - STAGE_LEAD_S - 0.1


def test_moves_out_of_a_lane_are_complete_before_each_vehicle_passes_its_line() -> None:
    lattice, numbers, line_m = DROP.lattice, (0, 1, 2), 800.0 - ROOM_M
    before, after = stages(DROP)
    for cells, column in (([(0, 1), (-1, 0)], -1), ([(0, 0), (-1, 0)], 0), ([(0, 1), (-1, 2)], -2)):
        assert moves_end_s(cells, numbers, before, DROP) == lattice.passing_time_s(column, line_m)
    # In the last stage nobody may still move at the end of the road.
    assert moves_end_s([(-1, 1)], numbers, after, DROP) == lattice.passing_time_s(-1, 1000.0)
    assert stage_end_s(numbers, before, DROP) == lattice.passing_time_s(-2, line_m)
    assert stage_end_s(numbers, after, DROP) == lattice.passing_time_s(0, 1000.0)


def test_vehicles_from_a_ramp_settle_later() -> None:
    formation, lattice = WEAVING.formation, WEAVING.lattice
    lasts_s = formation.entry_spread_s + formation.settle_s
    main = [(-4, 1), (-6, 3)]
    assert settled_s(main, WEAVING) == lattice.passing_time_s(-6, 0.0) + lasts_s
    assert settled_s([*main, (-5, 0)], WEAVING) == lattice.passing_time_s(-5, 250.0) + lasts_s


def test_formations_sort_when_vehicles_from_ramps_have_settled() -> None:
    main, from_ramp = [(-4, 1), (-6, 3)], (-5, 0)
    from_m, tick_s = 150.0, WEAVING.runtime.tick_s
    rear_m = from_m + WEAVING.types.longest_body_m
    in_stage_s = WEAVING.lattice.passing_time_s(-6, rear_m)
    assert 0.0 <= sorting_start_s(main, 0.0, WEAVING, from_m) - in_stage_s < tick_s
    settled = settled_s([from_ramp], WEAVING)
    assert 0.0 <= sorting_start_s([*main, from_ramp], 0.0, WEAVING, from_m) - settled < tick_s
    assert sorting_start_s([*main, from_ramp], 99.0, WEAVING, from_m) == pytest.approx(99.0)


S3_M = Scenario().road.sorting_start_m
PART = TemporaryClosure(1, 300.0, 320.0)
"""A part before S3 of the default road."""
LATE_PART = TemporaryClosure(1, 780.0, 790.0)
"""A part behind which there is too little road for sorting."""


def test_before_a_closed_part_vehicles_leave_its_lane_and_sort_in_s3() -> None:
    scenario = Scenario()
    around, sorting = stages(scenario, (PART,))
    assert (around.from_m, around.is_last, sorting.is_last) == (0.0, False, True)
    assert PART.from_m - 2.0 * ROOM_M < around.to_m < PART.from_m
    assert lanes(around) == ([0, 1, 2], [1])
    assert [around.goal_lanes(lane) for lane in range(3)] == [{0, 2}] * 3
    # A formation that has passed the part plans as on the open road, and does not plan again.
    assert sorting == stages(scenario)[0]


def test_before_a_late_part_vehicles_sort_from_the_start_of_the_road_on() -> None:
    before, behind = stages(Scenario(), (LATE_PART,))
    assert (before.from_m, behind.from_m) == (0.0, LATE_PART.to_m)
    assert [before.goal_lanes(lane) for lane in range(3)] == [{0}, {0, 2}, {2}]
    assert [behind.goal_lanes(lane) for lane in range(3)] == [{0}, {1}, {2}]


def test_structures_are_formed_only_behind_closed_parts() -> None:
    structures = (DrivingStructure(100.0, "parallel"), DrivingStructure(340.0, "interlaced"))
    scenario = Scenario(formation=FormationSettings(structures=structures))
    around, formed, sorting = stages(scenario, (PART,))
    assert [one.structure for one in (around, formed, sorting)] == [None, structures[1], None]
    assert (formed.from_m, formed.to_m, sorting.from_m) == (340.0, S3_M, S3_M)
    assert [one.sorted_before for one in (around, formed, sorting)] == [False, True, True]


# --- faster vehicles of other systems ---------------------------------------------------------

COLUMNS = range(-20, -14)


@given(
    speed_mps=st.floats(15.5, 50.0),
    rear_m=st.floats(0.0, 600.0),
    length_m=st.floats(50.0, 300.0),
    share=st.floats(0.0, 1.0),
)
def test_a_formation_is_out_of_a_lane_while_a_vehicle_overtakes_it(
    speed_mps: float, rear_m: float, length_m: float, share: float
) -> None:
    scenario = Scenario(road=Road(s3_m=19_000.0))
    lattice, slot_s = scenario.lattice, scenario.timing.cycles_s[0]
    t_s = lattice.passing_time_s(COLUMNS[0], rear_m)
    part = ClearedPart(1, rear_m - 20.0 - length_m, rear_m - 20.0, speed_mps, t_s)
    overtaken = where_overtaken((part,), COLUMNS, scenario)
    assume(overtaken)  # before the end of the road
    (found,) = overtaken
    # What a vehicle needs, without the slot for planning, reaches no body before.
    gained_mps = speed_mps - lattice.speed_mps
    rear_then_m = lattice.cell_s_m(COLUMNS[0], found.until_s) - scenario.types.longest_body_m
    needed_m = part.at(found.until_s)[1] - slot_s * gained_mps
    assert needed_m == pytest.approx(rear_then_m, abs=1e-3)
    # While it overtakes, all cells are where the formation leaves the lane.
    passed_s = found.until_s + (length_m - slot_s * gained_mps) / gained_mps
    during_s = found.until_s + share * max(passed_s - found.until_s, 0.0)
    for column in COLUMNS:
        s_m = lattice.cell_s_m(column, during_s)
        begin_m, end_m = part.at(during_s)
        if begin_m < s_m and s_m - scenario.types.longest_body_m < end_m - slot_s * gained_mps:
            assert lattice.cell_s_m(COLUMNS[-1], during_s) >= found.from_m - 1e-3
            assert lattice.cell_s_m(COLUMNS[0], during_s) <= found.to_m + 1e-3


def test_before_a_vehicle_overtakes_vehicles_leave_its_lane_and_sort_afterwards() -> None:
    scenario, numbers = Scenario(), (0,)
    overtaking = Overtaking(1, 300.0, 500.0, 40.0)
    around, sorting = stages(scenario, (), (overtaking,))
    # Nobody stops: the lane is used up to the beginning.
    assert (around.from_m, around.to_m, around.until_s) == (0.0, 300.0, 40.0)
    assert (lanes(around), around.avoids) == (([0, 1, 2], [1]), True)
    assert (sorting.from_m, sorting.until_s) == (500.0, math.inf)
    assert [sorting.goal_lanes(lane) for lane in range(3)] == [{0}, {1}, {2}]
    # All are out of it at one time, wherever their cells are.
    for cell in ((0, 1), (-10, 1)):
        assert moves_end_s([cell], numbers, around, scenario) <= 40.0
    assert moves_end_s([(0, 1)], numbers, evolve(around, until_s=1.0), scenario) == 1.0


def test_a_slow_overtaking_is_left_to_the_vehicle_behind() -> None:
    """A formation would leave its lane for the rest of the road."""
    scenario = Scenario()
    t_s = scenario.lattice.passing_time_s(COLUMNS[0], 100.0)
    found = [
        where_overtaken((ClearedPart(1, -60.0, 60.0, speed_mps, t_s),), COLUMNS, scenario)
        for speed_mps in (15.5, 17.0, 20.0, 25.0, 40.0)
    ]
    assert [len(one) for one in found] == [0, 0, 0, 1, 1]


def test_a_closed_part_keeps_its_line_where_a_vehicle_overtakes() -> None:
    part = TemporaryClosure(1, 600.0, 620.0)
    for from_m, to_m in ((580.0, 605.0), (580.0, 900.0), (560.0, 590.0), (400.0, 900.0)):
        around = stages(Scenario(), (part,), (Overtaking(1, from_m, to_m, 40.0),))[0]
        assert around.to_m == min(from_m, part.from_m - ROOM_M)


def test_a_vehicle_that_overtakes_at_the_end_of_the_road_leaves_a_lane_to_its_end() -> None:
    scenario = Scenario()
    part = ClearedPart(2, 420.0, 560.0, 25.0, scenario.lattice.passing_time_s(-14, 650.0))
    (found,) = where_overtaken((part,), range(-14, -8), scenario)
    assert found.from_m < scenario.road.length_m - LEFT_M == found.to_m
    around = stages(scenario, (), (found,))[0]
    assert around.goal_lanes(2) == {1}


def waiting(*bodies: tuple[int, float]) -> Census:
    """Return a census of vehicles without cells, each given by its lane and its rear."""
    entries = (
        CensusEntry(Name(f"v{number}"), (0, lane), 0, 0.0, OffLattice(lane, rear_m))
        for number, (lane, rear_m) in enumerate(bodies)
    )
    return Census(0.0, tuple(entries), ())


def test_a_lane_is_closed_from_its_queue_on() -> None:
    scenario = Scenario()
    assert with_queues((PART,), waiting(), scenario) == (PART,)
    line_m = PART.from_m - ROOM_M
    # Vehicles in the part, beyond its stop line or in other lanes are not in the queue.
    passed = waiting((1, 305.0), (1, 283.0), (1, line_m), (2, line_m - 5.0))
    assert with_queues((PART,), passed, scenario) == (PART,)
    for queue_m, length_m in ((5.0, 10.0), (22.0, 30.0)):
        queue = waiting((1, line_m - 5.0), (1, line_m - queue_m))
        before = PART._replace(from_m=PART.from_m - length_m)
        assert with_queues((PART,), queue, scenario) == (before,)
    late = PART._replace(late_m=40.0)
    assert with_queues((late,), waiting((1, line_m - 5.0)), scenario) == (late,)
    longer = with_queues((late,), waiting((1, line_m - 55.0)), scenario)
    assert longer == (PART._replace(from_m=PART.from_m - 60.0),)
    assert with_queues((), waiting((1, 283.0)), scenario) == ()
    # A queue before the end of a lane of the road has nothing to do with a part behind it.
    behind = TemporaryClosure(0, 850.0, 870.0)
    assert with_queues((behind,), waiting((0, 570.0)), BLOCKED) == (behind,)


def test_parts_of_two_lanes_between_which_nobody_can_move_are_one() -> None:
    scenario = Scenario()
    near, far = TemporaryClosure(0, 330.0, 340.0), TemporaryClosure(0, 100.0, 110.0)
    parts = with_queues((near, PART), waiting(), scenario)
    assert {*parts} == {PART, near._replace(from_m=PART.from_m)}
    around = stages(scenario, parts)[0]
    assert around.goal_lanes(1) == {2}
    assert {*with_queues((far, PART), waiting(), scenario)} == {far, PART}


def test_with_all_lanes_closed_formations_still_have_stages() -> None:
    scenario = Scenario()
    parts = with_queues(
        [TemporaryClosure(lane, 300.0, 600.0) for lane in range(3)], waiting(), scenario
    )
    found = stages(scenario, parts)
    assert found
    assert all(stage.lanes and stage.goal_lanes(1) for stage in found)


@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.floats(-50.0, 1050.0), st.floats(1.0, 300.0)), max_size=5
    ),
    st.lists(st.tuples(st.integers(0, 2), st.floats(0.0, 1000.0)), max_size=5),
    st.sampled_from([Scenario(), STRAIGHT, DROP, BLOCKED]),
)
def test_whatever_is_closed_there_are_stages_with_open_lanes(
    drawn: list[tuple[int, float, float]], bodies: list[tuple[int, float]], scenario: Scenario
) -> None:
    closed = [TemporaryClosure(lane, from_m, from_m + m) for lane, from_m, m in drawn]
    found = stages(scenario, with_queues(closed, waiting(*bodies), scenario))
    assert [stage.number for stage in found] == [*range(len(found))]
    for before, behind in pairwise(found):
        assert before.to_m <= behind.from_m + 1e-6
    for stage in found:
        assert stage.from_m < stage.to_m
        assert stage.goal_lanes(ANY_LANE)
        assert stage.goal_lanes(0) <= stage.lanes | {0}
    assert found[-1].is_last
