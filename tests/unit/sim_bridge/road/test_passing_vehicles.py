"""Vehicles of other systems on a road that no agent drives."""

from __future__ import annotations

import math
from random import Random

import pytest
from attrs import evolve

from laneweave.protocol.scenario.road_tables import Demand, RoadEvent
from laneweave.protocol.wire.events import PART_CLOSED, PART_OPENED
from laneweave.protocol.wire.messages import Command, CurrentMotion, Name, VehicleRecord
from laneweave.protocol.wire.obstacle_messages import PASSING, Obstacle
from laneweave.sim_bridge.bodies.stop_lines import StopLinesAhead
from laneweave.sim_bridge.recording.obstacle_log import ObstacleLog
from laneweave.sim_bridge.road.passing_vehicles import (
    CLEARED_BEHIND_M,
    PassingVehicle,
    PassingVehicles,
    gap_needed_m,
)
from support import road_bugs
from support.bugs import Bug, catches
from support.closed_lanes import LonelyRoad, road_with
from support.variants import variants

ROAD = road_with(s3_m=850.0)
TICK_S = ROAD.runtime.tick_s
SLOW = RoadEvent(1, 300.0, 307.0, 20.0, speed_mps=5.0)
FAST = RoadEvent(1, 0.0, 8.0, 20.0, speed_mps=25.0)


def passing(event: RoadEvent, speed_mps: float) -> PassingVehicle:
    return PassingVehicle(Name("other-1"), event, 0.0, event.to_m, 5.25, 1.8, speed_mps)


def lonely_road(*events: RoadEvent, volume: float = 800.0, seed: int = 1) -> LonelyRoad:
    demand = Demand(volume_veh_per_lane_h=volume, duration_s=60.0)
    road = evolve(ROAD.road, events=events)
    return LonelyRoad(evolve(ROAD, demand=demand, seed=seed, road=road))


def run_to_end(road: LonelyRoad, within_s: float = 600.0) -> list[tuple[float, str, Obstacle]]:
    changes = []
    while road.vehicles or road.roadside.obstacles or not road.roadside.demand.exhausted(road.t_s):
        t_s = road.t_s
        road.step()
        assert road.t_s < within_s, f"still on the road: {sorted(road.vehicles)}"
        assert road.overlaps == []
        check_parts(road)
        changes += [(t_s, *change) for change in road.roadside.pop_obstacle_changes()]
    return changes


def check_parts(road: LonelyRoad) -> None:
    """Check that what is published fits the vehicles on the road."""
    obstacles = road.roadside.obstacles
    lattice_mps = road.scenario.lattice.speed_mps
    for one in obstacles.passing.on_road:
        slow = [each.part for each in obstacles.active if each.vehicle == one.name]
        fast = [each for each in obstacles.cleared if each.vehicle == one.name]
        if one.passage.speed_mps < lattice_mps:
            # The vehicle is within the newest of the parts that are closed for it.
            assert not fast
            ahead_m = one.speed_mps * TICK_S
            assert any(part.from_m <= one.s_m <= part.to_m + ahead_m for part in slow)
        elif fast:
            # While it waits behind others, it is slow, too; parts at which vehicles wait stay.
            assert not slow or one.lowest_mps < lattice_mps
            (cleared,) = fast
            moved_m = cleared.speed_mps * (road.t_s - cleared.at_s)
            assert abs(cleared.front_m + moved_m - one.s_m) < 10.0
            assert cleared.from_m <= cleared.front_m - cleared.length_m - CLEARED_BEHIND_M
            assert cleared.to_m >= cleared.front_m + gap_needed_m(
                one.passage.speed_mps, lattice_mps
            )


@pytest.mark.parametrize(
    ("speed_mps", "volume", "seed"),
    variants([(5.0, 800.0, 1), (10.0, 1200.0, 2), (0.5, 500.0, 3), (14.9, 1000.0, 4)], 2),
)
def test_a_slow_vehicle_is_an_obstacle_that_moves(
    speed_mps: float, volume: float, seed: int
) -> None:
    # It turns off before the end of the road, so that a very slow one does not take all day.
    event = evolve(SLOW, speed_mps=speed_mps, for_s=60.0)
    road = lonely_road(event, volume=volume, seed=seed)
    changes = run_to_end(road)
    (entered_s, first, entered), (left_s, second, left) = changes
    assert (first, second) == (PART_CLOSED, PART_OPENED)
    assert (entered.cause, entered.lane, entered.vehicle) == (PASSING, 1, "other-1")
    assert entered_s >= 20.0
    # It is not slower than those that wait ahead of it.
    travels_s = min(60.0, (road.scenario.road.length_m - event.to_m) / speed_mps)
    assert travels_s - 1.0 < left_s - entered_s <= 60.1
    assert 0.7 * speed_mps < left.speed_mps <= speed_mps


@pytest.mark.parametrize(("speed_mps", "seed"), variants([(25.0, 1), (16.0, 2), (40.0, 3)], 2))
def test_a_fast_vehicle_brakes_for_those_that_do_not_leave_its_lane(
    speed_mps: float, seed: int
) -> None:
    road = lonely_road(evolve(FAST, speed_mps=speed_mps), seed=seed)
    changes = run_to_end(road)
    (entered_s, _, _), (left_s, _, left) = changes
    # Nobody plans here, so that it drives behind the others, at v_F.
    assert left.speed_mps <= 15.1
    assert left_s - entered_s < (road.scenario.road.length_m / 15.0) * 1.5
    assert max(road.events, default=None) is None


def test_several_vehicles_pass_one_after_the_other_in_one_lane() -> None:
    first, second = evolve(SLOW, for_s=50.0), evolve(SLOW, for_s=50.0, speed_mps=8.0)
    road, log = lonely_road(first, second, FAST), ObstacleLog()
    for t_s, kind, obstacle in run_to_end(road):
        log.on_obstacle(t_s, kind, obstacle)
    assert log.figures is not None
    assert len(log.figures) == 3
    assert len({one.vehicle for one in log.figures}) == 3
    assert all(one.opened_s is not None and one.opened_s > one.since_s for one in log.figures)


@pytest.mark.parametrize(
    "events",
    [
        (evolve(SLOW, from_m=120.0, to_m=127.0, speed_mps=3.0, for_s=40.0),
         evolve(FAST, from_m=100.0, to_m=108.0)),
        (evolve(SLOW, from_m=85.0, to_m=92.0, speed_mps=1.0, for_s=40.0),
         evolve(FAST, speed_mps=40.0)),
        (RoadEvent(1, 400.0, 450.0, 20.0, for_s=30.0, clear_s=0.0), FAST),
    ],
)  # fmt: skip
def test_vehicles_brake_for_each_other_and_for_closed_parts(events: tuple[RoadEvent, ...]) -> None:
    changes = run_to_end(lonely_road(*events, volume=400.0))
    assert len([kind for _, kind, _ in changes if kind == PART_OPENED]) == 2


def test_a_vehicle_that_finds_no_room_until_its_time_is_over_does_not_enter() -> None:
    blocked = evolve(FAST, until_s=21.0)
    road = lonely_road(blocked, volume=1500.0)
    assert run_to_end(road) == []
    assert road.roadside.obstacles.cleared == ()


def test_no_vehicle_enters_a_lane_that_is_cleared() -> None:
    road = lonely_road(FAST, volume=1500.0)
    entered: dict[Name, float] = {}
    while road.t_s < 60.0:
        road.step()
        for name, vehicle in road.vehicles.items():
            if vehicle.cell[1] == 1:
                entered.setdefault(name, road.t_s)
    on_road = road.roadside.obstacles.passing.on_road
    assert len(on_road) == 1
    since_s = on_road[0].since_s
    # Between the announcement and the passage; before and after, vehicles enter all the time.
    during = [t_s for t_s in entered.values() if 20.2 < t_s < since_s + 0.5]
    assert during == []
    assert since_s > 22.0
    assert any(t_s < 20.0 for t_s in entered.values())
    assert any(t_s > since_s + 0.5 for t_s in entered.values())


def test_a_vehicle_alone_keeps_its_speed() -> None:
    vehicle = passing(FAST, 25.0)
    for _ in range(100):
        vehicle.step(math.inf, 0.0, TICK_S)
    assert vehicle.speed_mps == vehicle.lowest_mps == 25.0
    assert vehicle.s_m == pytest.approx(8.0 + 100 * TICK_S * 25.0)


@pytest.mark.parametrize("seed", range(20))
def test_a_vehicle_never_touches_one_ahead_that_brakes(seed: int) -> None:
    rng = Random(seed)
    speed_mps, lead_mps = rng.uniform(0.0, 40.0), rng.uniform(0.0, 40.0)
    vehicle = passing(evolve(FAST, speed_mps=40.0), speed_mps)
    lead_m = vehicle.s_m + gap_needed_m(speed_mps, lead_mps)
    for _ in range(1000):
        decel_mps2 = rng.choice([0.0, 0.0, 4.0])
        slower_mps = max(lead_mps - decel_mps2 * TICK_S, 0.0)
        lead_m += 0.5 * (lead_mps + slower_mps) * TICK_S
        lead_mps = slower_mps
        vehicle.step(lead_m - vehicle.s_m, lead_mps, TICK_S)
        assert vehicle.s_m <= lead_m
        assert vehicle.accel_mps2 >= -9.0 - 1e-9


def test_the_gap_from_which_a_vehicle_does_not_brake() -> None:
    for gap_m, brakes in ((gap_needed_m(25.0, 15.0) + 1.0, False), (70.0, True)):
        vehicle = passing(FAST, 25.0)
        vehicle.step(gap_m, 15.0, TICK_S)
        assert (vehicle.speed_mps < 25.0) is brakes


@pytest.mark.parametrize(("slots", "enters"), [(2.9, False), (3.1, True)])
def test_a_fast_vehicle_enters_with_room_for_three_slots(slots: float, enters: bool) -> None:
    lattice_mps, slot_s = ROAD.lattice.speed_mps, ROAD.timing.cycles_s[0]
    gap_m = gap_needed_m(FAST.speed_mps, lattice_mps)
    gap_m += slots * slot_s * (FAST.speed_mps - lattice_mps)
    ahead = passing(FAST, lattice_mps)
    ahead.s_m = FAST.to_m + gap_m + ahead.length_m
    vehicles = PassingVehicles(ROAD, [FAST])
    vehicles.update({Name("v0001"): ahead}, (), FAST.at_s)
    assert bool(vehicles.on_road) == enters


def test_motion_controllers_begin_no_lane_change_in_front_of_a_fast_vehicle() -> None:
    road = lonely_road(FAST)
    while not road.roadside.obstacles.passing.on_road:
        road.step()
    (other,) = road.roadside.obstacles.passing.on_road
    road.step()
    lines = StopLinesAhead(road.scenario, road.scenario.vehicle, road.roadside.lane_ends)
    lattice, tick = road.scenario.lattice, road.tick
    slot_ticks = round(road.scenario.timing.cycles_s[0] / TICK_S)
    for ahead_m, allowed in ((20.0, False), (gap_needed_m(25.0, 15.0), False), (400.0, True)):
        column = math.ceil((other.s_m + ahead_m - lattice.cell_s_m(0, road.t_s)) / lattice.pitch_m)
        command = Command(
            vehicle=Name("v0001"),
            record=VehicleRecord(),
            tick=tick,
            hold_cell=(column, 1),
            motion=CurrentMotion((column, 0), tick + slot_ticks),
            jerks=b"",
        )
        assert lines.allow(command, road.t_s) is allowed


BUGS: tuple[Bug, ...] = (
    road_bugs.cleared_parts_are_entered,
    road_bugs.closed_parts_do_not_move, road_bugs.others_brake_for_nobody,
    road_bugs.others_enter_without_room, road_bugs.cleared_lanes_are_entered,
)  # fmt: skip


def check_all() -> None:
    run_to_end(lonely_road(evolve(SLOW, for_s=60.0)))
    run_to_end(lonely_road(FAST))
    test_no_vehicle_enters_a_lane_that_is_cleared()
    test_motion_controllers_begin_no_lane_change_in_front_of_a_fast_vehicle()


@pytest.mark.parametrize(
    "bug", [pytest.param(bug, marks=catches(bug), id=bug.name) for bug in BUGS]
)
def test_planted_bugs_are_noticed(bug: Bug, monkeypatch: pytest.MonkeyPatch) -> None:
    bug.plant(monkeypatch)
    with pytest.raises(AssertionError):
        check_all()
