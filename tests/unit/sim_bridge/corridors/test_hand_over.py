"""Which vehicles SUMO takes back before the queue in their lane, and where plans end."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
from attrs import evolve

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.vehicle.lane_ends import dead_ends
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.protocol.wire.messages import Ballot, Name, PendingTransfer
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.corridors.corridor import DECEL_MPS2
from laneweave.sim_bridge.corridors.exit_room import SPACE_M
from laneweave.sim_bridge.corridors.hand_over import PLANS_END_M, REACTION_S, HandOver
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.road_vehicles import vehicle_in

APPROACH = parse_scenario(
    {
        "road": {"lanes": 3, "s1_m": 100.0, "s2_m": 0.0, "s3_m": 300.0},
        "formation": {"operation": "rolling", "speed_mps": 12.5, "gap_m": 15.0},
    }
)
END_M = APPROACH.road.length_m
SPEED_MPS = APPROACH.lattice.speed_mps
NEEDED_M = SPACE_M + REACTION_S * SPEED_MPS + SPEED_MPS**2 / (2.0 * DECEL_MPS2)
"""Distance in which a vehicle stops comfortably behind one that stands."""
CELL: Cell = (2, 1)


def other(rear_m: float, speed_mps: float = 0.0, lane: int = 1) -> OtherBody:
    return OtherBody("other", lane, END_M, rear_m, 5.0, speed_mps, 0.0)


def vehicle(cell: Cell = CELL, preferred_lane: int | None = None) -> RoadVehicle:
    """Return a vehicle at rest in its cell."""
    found = vehicle_in(cell, scenario=APPROACH)
    found.controller.enter_lattice([cell])
    if preferred_lane is not None:
        arrival = evolve(found.arrival, preferred_lane=preferred_lane)
        found.admission = evolve(found.admission, arrival=arrival)
    return found


def is_given_back(one: RoadVehicle, *others: OtherBody) -> bool:
    return [*HandOver(APPROACH).given_back([one], others)] == [one]


def test_a_vehicle_is_given_back_while_it_can_still_brake_comfortably() -> None:
    one = vehicle()
    s_m = one.state[0]
    assert not is_given_back(one)
    assert is_given_back(one, other(s_m + NEEDED_M - 0.1))
    assert not is_given_back(one, other(s_m + NEEDED_M + 0.1))
    # Neither a queue beside it nor one behind it matters.
    assert not is_given_back(one, other(s_m + 10.0, lane=0), other(s_m - 40.0))


@dataclass
class _Ahead:
    speed_mps: float
    gap_m: float


@pytest.mark.parametrize(
    ("ahead", "due"),
    [
        # As fast as it: the usual gap in the lattice is enough.
        (_Ahead(SPEED_MPS, 10.0), False),
        (_Ahead(SPEED_MPS + 2.0, 4.0), False),
        (_Ahead(SPEED_MPS - 0.5, 10.0), False),
        # It has begun to brake.
        (_Ahead(SPEED_MPS - 2.5, 10.0), True),
        (_Ahead(SPEED_MPS - 2.5, 20.0), False),
    ],
)
def test_one_follows_the_other_when_that_one_brakes(ahead: _Ahead, *, due: bool) -> None:
    one = vehicle()
    assert is_given_back(one, other(one.state[0] + ahead.gap_m, ahead.speed_mps)) == due


def test_the_line_moves_with_the_queue_lane_by_lane() -> None:
    hand_over = HandOver(APPROACH)
    queues = [other(300.0), other(250.0), other(390.0, lane=2)]
    lines_m = {one.lane: line_m for one, line_m in hand_over.lines_m(queues).items()}
    assert lines_m == pytest.approx({1: 250.0 - NEEDED_M, 2: 390.0 - NEEDED_M})
    moving_m = 8.0**2 / (2.0 * DECEL_MPS2)
    ((_, line_m),) = hand_over.lines_m([other(250.0, 8.0)]).items()
    assert line_m == pytest.approx(250.0 + moving_m - NEEDED_M)
    ends = {one.lane: one.rear_m for one in hand_over.plans_end(queues)}
    assert ends == pytest.approx({lane: line_m - PLANS_END_M for lane, line_m in lines_m.items()})
    # A queue far behind the end ends no plans.
    assert not hand_over.plans_end([other(END_M + NEEDED_M + PLANS_END_M + 1.0)])


def test_nobody_enters_a_lane_whose_queue_reaches_the_start() -> None:
    hand_over = HandOver(APPROACH)
    assert hand_over.full_lanes([other(NEEDED_M - 1.0), other(NEEDED_M + 1.0, lane=0)]) == {1}
    ((end),) = hand_over.plans_end([other(10.0)])
    assert end.rear_m == 0.0


def test_one_that_cannot_reach_its_lane_before_the_line_there_is_given_back_at_once() -> None:
    move_m = APPROACH.timing.cycles_s[0] * SPEED_MPS
    for away, preferred_lane in ((1, 2), (2, 2)):
        one = vehicle((2, 2 - away), preferred_lane)
        line_m = one.state[0] + away * move_m
        assert is_given_back(one, other(line_m - 0.1 + NEEDED_M, lane=2))
        assert not is_given_back(one, other(line_m + 0.1 + NEEDED_M, lane=2))
    # Without a queue, the end of the road is the line.
    late = math.ceil((END_M - move_m) / APPROACH.lattice.pitch_m)
    assert is_given_back(vehicle((late, 1), 2))
    assert not is_given_back(vehicle((late - 1, 1), 2))
    # It may also have to brake in its own lane, and a queue in a third lane does not matter.
    one = vehicle(preferred_lane=2)
    assert is_given_back(one, other(one.state[0] + NEEDED_M - 0.1))
    assert not is_given_back(one, other(one.state[0] + NEEDED_M - 0.1, lane=0))


def test_bodies_behind_a_vehicle_or_as_fast_as_it_do_not_close_the_lane_beside_it() -> None:
    one = vehicle((10, 0), 1)
    s_m = one.state[0]
    assert s_m == 150.0
    assert not is_given_back(one, other(30.0, SPEED_MPS))
    assert not is_given_back(one, other(30.0))
    assert not is_given_back(one, other(s_m + 40.0, SPEED_MPS))
    assert is_given_back(one, other(s_m + 40.0))
    hand_over = HandOver(APPROACH)
    assert not hand_over.plans_end([other(30.0, SPEED_MPS)])


def test_one_whose_own_lane_has_ended_for_plans_is_given_back() -> None:
    """No plan uses the lane beyond a slow body, not even to leave it."""
    assert is_given_back(vehicle((10, 0), 1), other(30.0, lane=0))
    assert not is_given_back(vehicle((10, 0), 0), other(30.0, lane=0))


def test_one_that_stands_in_a_queue_is_given_back() -> None:
    one = vehicle()
    rest = cell_state(APPROACH.lattice, CELL, 0.0)
    standing = (rest[0], 0.0, *rest[2:])
    one.controller.plant = Plant(standing, APPROACH.vehicle, APPROACH.runtime.tick_s)
    assert is_given_back(one, other(rest[0] + 7.0))
    assert not is_given_back(one, other(rest[0] + 9.0))


OFF_RAMP = parse_scenario(
    {
        "road": {
            "lanes": 4,
            "s1_m": 100.0,
            "s2_m": 0.0,
            "s3_m": 900.0,
            "closures": [{"lane": 0, "to_m": 300.0}, {"lane": 0, "from_m": 600.0}],
        },
        "exit": [{"name": "off", "lanes": [0], "at_m": 600.0}],
        "formation": {"operation": "rolling"},
    }
)


@pytest.mark.parametrize(
    ("lane", "s_m", "destination", "due"),
    [
        (0, 500.0, "off", True),
        (1, 450.0, "off", False),
        (1, 500.0, "off", True),  # it is too late to change into the lane of its exit
        (0, 450.0, END_OF_ROAD, False),
        (0, 500.0, END_OF_ROAD, True),  # or to leave it
        (1, 500.0, END_OF_ROAD, True),
        (1, 700.0, "off", True),  # it has passed its exit
    ],
)
def test_one_is_given_back_where_it_leaves_the_road(
    lane: int, s_m: float, destination: str, *, due: bool
) -> None:
    cell = round(s_m / OFF_RAMP.lattice.pitch_m), lane
    one = vehicle_in(cell, scenario=OFF_RAMP)
    one.controller.enter_lattice([cell])
    arrival = evolve(one.arrival, destination=destination, preferred_lane=ANY_LANE)
    one.admission = evolve(one.admission, arrival=arrival)
    exit_m = 600.0 if lane == 0 else OFF_RAMP.road.length_m
    queue = OtherBody("other", lane, exit_m, one.state[0] + 20.0, 5.0, 0.0, 0.0)
    assert ([*HandOver(OFF_RAMP).given_back([one], [queue])] == [one]) == due
    # The lane of the exit stays open for plans: others may have to leave it.
    assert bool(HandOver(OFF_RAMP).plans_end([queue])) == (lane > 0)


def test_one_that_leaves_its_cell_by_a_plan_in_force_is_not_given_back() -> None:
    """Another one may be led into its cell."""
    one = vehicle()
    queue = other(one.state[0] + 20.0)
    assert is_given_back(one, queue)
    ballot = Ballot(1, Name("c1"), 1, 1)
    one.controller.store.store_promise(ballot)
    moves = PendingTransfer(ballot, before=(CELL,), after=((2, 2),), roster=(Name("A"),))
    one.controller.store.begin_transfer(moves)
    assert not is_given_back(one, queue)


def test_one_between_two_lanes_is_not_given_back() -> None:
    one = vehicle()
    rest = cell_state(APPROACH.lattice, CELL, 0.0)
    between = (*rest[:3], rest[3] + 1.0, *rest[4:])
    one.controller.plant = Plant(between, APPROACH.vehicle, APPROACH.runtime.tick_s)
    assert not is_given_back(one, other(one.state[0] + 20.0))
    assert math.isclose(one.state[3] - rest[3], 1.0)


SHORT_RAMP: dict[str, Any] = {
    "road": {
        "lanes": 3,
        "lane_width_m": 3.2,
        "s1_m": 100.0,
        "s2_m": 0.0,
        "s3_m": 1400.0,
        "closures": [{"lane": 0, "to_m": 400.0}, {"lane": 0, "from_m": 692.0}],
    },
    "entrance": [
        {"name": "on", "lane": 0, "at_m": 400.0, "merge_m": 600.0, "volume_veh_per_h": 300.0}
    ],
    "vehicle": {"max_speed_mps": 28.0, "max_accel_mps2": 2.6, "min_accel_mps2": -9.0},
    "formation": {
        "operation": "rolling",
        "change_columns": False,
        "sort_in_s2": True,
        "speed_mps": 27.0,
        "gap_m": 27.0,
        "settle_s": 3.0,
        "cycle_s": 3.2,
    },
}
OF_SUMO = {"sumo": {"config": "my.sumocfg", "corridor": "a:b"}}


def test_a_lane_that_is_too_short_for_re_entry_is_for_corridors_only() -> None:
    with pytest.raises(BadInputError, match="for driving on after stopping"):
        parse_scenario(SHORT_RAMP)
    (end,) = dead_ends(parse_scenario(SHORT_RAMP | OF_SUMO))
    assert end.taken_back
    assert end.line_m < end.stop_m < end.end_m == 692.0
    shorter = {"closures": [{"lane": 0, "to_m": 400.0}, {"lane": 0, "from_m": 670.0}]}
    with pytest.raises(BadInputError, match="room to stop while the body is in the lane"):
        parse_scenario(SHORT_RAMP | OF_SUMO | {"road": SHORT_RAMP["road"] | shorter})


@pytest.mark.parametrize(
    ("before_line_m", "lane", "pending", "due"),
    [
        (95.0, 0, False, False),  # there is still time for a lane change
        (70.0, 0, False, True),
        (70.0, 0, True, False),  # it may be about to change lanes
        (70.0, 1, False, False),
    ],
)
def test_one_that_does_not_leave_a_short_lane_in_time_is_given_back(
    before_line_m: float, lane: int, *, pending: bool, due: bool
) -> None:
    scenario = parse_scenario(SHORT_RAMP | OF_SUMO)
    (end,) = dead_ends(scenario)
    one = vehicle_in((0, lane), scenario=scenario)
    one.controller.enter_lattice([(0, lane)])
    rest = cell_state(scenario.lattice, (0, lane), 0.0)
    state = (end.line_m - before_line_m, *rest[1:])
    one.controller.plant = Plant(state, scenario.vehicle, scenario.runtime.tick_s)
    if pending:
        ballot = Ballot(1, Name("c"), 1, 1)
        cells = ((0, 0),), ((0, 1),)
        one.controller.store.store_promise(ballot)
        one.controller.store.begin_transfer(PendingTransfer(ballot, *cells, (Name("A"),)))
    assert ([*HandOver(scenario).given_back([one], [])] == [one]) == due


@pytest.mark.parametrize(("speed_mps", "due"), [(0.0, True), (5.0, False)])
def test_one_that_has_stopped_in_a_lane_change_there_is_given_back(
    speed_mps: float, *, due: bool
) -> None:
    scenario = parse_scenario(SHORT_RAMP | OF_SUMO)
    (end,) = dead_ends(scenario)
    one = vehicle_in((0, 1), scenario=scenario)
    one.controller.enter_lattice([(0, 1)])
    state = (end.stop_m - 1.0, speed_mps, 0.0, scenario.lattice.lane_width_m, 0.0, 0.0)
    one.controller.plant = Plant(state, scenario.vehicle, scenario.runtime.tick_s)
    assert ([*HandOver(scenario).given_back([one], [])] == [one]) == due
