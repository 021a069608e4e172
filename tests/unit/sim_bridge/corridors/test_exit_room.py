"""Which vehicles wait at the start because of queues behind their exits."""

from __future__ import annotations

import math

from attrs import evolve

from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.corridors.exit_room import QUEUE_DECEL_MPS2, SPACE_M, ExitRoom


def body(scenario: Scenario, rear_m: float, speed_mps: float = 0.0, lane: int = 0) -> OtherBody:
    """Return a body behind the end of the exit's edge, 4 m after vehicles are given back."""
    exit_m = scenario.exit[0].at_m
    return OtherBody("other", lane, exit_m, exit_m + 4.0 + rear_m, 5.0, speed_mps, 0.0)


def places(scenario: Scenario, *others: OtherBody, waiting: int = 0) -> int:
    """Return how many vehicles may be on their way to the exit."""
    room = ExitRoom(scenario)
    count = 0
    while count < 1000 and room.has_room("off", count, waiting, others):
        count += 1
    return count


def test_an_exit_without_a_queue_has_room(scenario: Scenario) -> None:
    flowing = [body(scenario, rear_m, 15.0) for rear_m in (10.0, 50.0, 120.0)]
    assert places(scenario) == places(scenario, *flowing) == 1000


def test_all_on_the_way_fit_between_the_queue_and_where_they_brake(scenario: Scenario) -> None:
    # They brake in the deceleration lane, without the distance for a move into it.
    braking_m = scenario.formation.speed_mps**2 / (2.0 * QUEUE_DECEL_MPS2)
    assert braking_m < 246.0 - scenario.types.step_m
    for tail_m in (5.0, 40.0, 150.0):
        fit = (4.0 + tail_m) / (7.1 + SPACE_M)
        first = int(tail_m > 20.0)  # one may always try if there is room behind the exit
        assert places(scenario, body(scenario, tail_m)) == max(first, math.floor(fit) - 1)


def test_a_short_deceleration_lane_leaves_less_room(scenario: Scenario) -> None:
    closed = scenario.road.closures[0]
    later = evolve(closed, to_m=closed.to_m + 90.0)
    road = evolve(scenario.road, closures=(later, *scenario.road.closures[1:]))
    short = evolve(scenario, road=road)
    queue = body(scenario, 150.0)
    assert places(scenario, queue) - 9 <= places(short, queue) < places(scenario, queue)


def test_those_who_drive_to_the_queue_take_places_as_well(scenario: Scenario) -> None:
    queue = body(scenario, 150.0), body(scenario, 158.0)
    before, behind = body(scenario, 60.0, 12.0), body(scenario, 170.0, 12.0)
    assert places(scenario, *queue, before) == places(scenario, *queue) - 1
    assert places(scenario, *queue, behind) == places(scenario, *queue)


def test_a_queue_to_the_exit_is_full(scenario: Scenario) -> None:
    assert places(scenario, body(scenario, -130.0)) == 0


def test_those_who_have_waited_do_not_come_all_at_once(scenario: Scenario) -> None:
    assert places(scenario, body(scenario, 150.0)) < places(scenario, waiting=9) < 60


def test_other_lanes_and_the_end_of_the_road_do_not_matter(scenario: Scenario) -> None:
    assert places(scenario, body(scenario, 5.0, lane=1)) == 1000
    assert ExitRoom(scenario).has_room(END_OF_ROAD, 500, 9, [body(scenario, 5.0)])


def test_a_queue_does_not_keep_the_exit_unused(scenario: Scenario) -> None:
    closed = scenario.road.closures[0]
    later = evolve(closed, to_m=closed.to_m + 140.0)
    road = evolve(scenario.road, closures=(later, *scenario.road.closures[1:]))
    short = evolve(scenario, road=road)
    assert places(short, body(short, 70.0)) == places(short, body(short, 30.0)) == 1
    assert places(short, body(short, 10.0)) == 0


def test_an_empty_lane_of_an_exit_is_not_for_all(scenario: Scenario) -> None:
    lanes = evolve(scenario.exit[0], lanes=(0, 1))
    closure = evolve(scenario.road.closures[0], lane=1, from_m=lanes.at_m, to_m=lanes.at_m + 20.0)
    road = evolve(scenario.road, closures=(*scenario.road.closures, closure))
    wide = evolve(scenario, road=road, exit=(lanes,))
    assert places(wide) == 1000
    assert 0 < places(wide, body(wide, 5.0)) < 30
