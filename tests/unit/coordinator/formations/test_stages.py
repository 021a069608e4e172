"""Stages of the way of a formation: which lanes are open, and which ones vehicles need."""

from __future__ import annotations

import pytest
from attrs import evolve
from hypothesis import given
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
from laneweave.coordinator.formations.stages import Stage, stages
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import DrivingStructure, FormationSettings
from laneweave.protocol.scenario.road_tables import Closure, Entrance, Exit, Road
from laneweave.protocol.vehicle.lane_ends import re_entry

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
    found = [stage_at(numbers, 0.1 * tick, scenario) for tick in range(1200)]
    assert found == sorted(found)
    assert {*found} == {*range(len(stages(scenario)))}
    for number in range(1, len(stages(scenario))):
        first_s = 0.1 * found.index(number)
        # All bodies have passed the stage before; planning takes a part of the time that is left.
        rear_m = lattice.cell_s_m(-5, first_s)
        assert rear_m >= stages(scenario)[number - 1].to_m - 1e-6
        begin_s = stage_begin_s(numbers, number, scenario)
        assert first_s >= begin_s - STAGE_LEAD_S - 0.1


def test_moves_out_of_a_lane_are_complete_before_each_vehicle_passes_its_line() -> None:
    lattice, numbers, line_m = DROP.lattice, (0, 1, 2), 800.0 - ROOM_M
    for cells, column in (([(0, 1), (-1, 0)], -1), ([(0, 0), (-1, 0)], 0), ([(0, 1), (-1, 2)], -2)):
        assert moves_end_s(cells, numbers, 0, DROP) == lattice.passing_time_s(column, line_m)
    # In the last stage nobody may still move at the end of the road.
    assert moves_end_s([(-1, 1)], numbers, 1, DROP) == lattice.passing_time_s(-1, 1000.0)
    assert stage_end_s(numbers, 0, DROP) == lattice.passing_time_s(-2, line_m)
    assert stage_end_s(numbers, 1, DROP) == lattice.passing_time_s(0, 1000.0)


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
