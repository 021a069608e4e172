"""Parts of lanes that are closed for a time, on a road that no agent drives."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import pytest
from attrs import evolve

from laneweave.protocol.road_layout import TemporaryClosure, TemporaryParts
from laneweave.protocol.scenario.road_tables import Closure, Demand, RoadEvent
from laneweave.protocol.vehicle.lane_ends import LaneEnds, stop_line_m
from laneweave.protocol.vehicle.re_entry import START_S, re_entry
from laneweave.protocol.vehicle.sudden_stops import room_before_part_m
from laneweave.protocol.wire.events import (
    DRIVES_OUT,
    ENTERED_LATTICE,
    LEFT_LATTICE,
    PART_CLOSED,
    PART_OPENED,
)
from laneweave.protocol.wire.messages import Name, OffLattice
from laneweave.protocol.wire.obstacle_messages import BREAKDOWN, CLOSED, Obstacle
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel, OffLatticePhase
from laneweave.sim_bridge.bodies.stop_lines import STANDING_MPS
from laneweave.sim_bridge.road.entry import EntryMeter
from laneweave.sim_bridge.road.lane_end_control import CROWDED_GAPS, LAST_S, OPEN_GAPS, Gap
from laneweave.sim_bridge.road.obstacles import ActiveObstacle, Breakdown
from support import road_bugs
from support.bugs import Bug, catches
from support.closed_lanes import LonelyRoad, road_with
from support.variants import variants

ROAD = road_with(s3_m=850.0)
AT_S, LANE, AT_M, STANDS_S = 30.0, 1, 300.0, 40.0
BREAKS_DOWN = Breakdown(AT_S, lane=LANE, at_m=AT_M, for_s=STANDS_S)
END_S = 900.0


def lonely_road(
    *breakdowns: Breakdown, volume: float = 600.0, events: tuple[RoadEvent, ...] = (), seed: int = 1
) -> LonelyRoad:
    demand = Demand(volume_veh_per_lane_h=volume, duration_s=60.0)
    road = evolve(ROAD.road, events=events)
    return LonelyRoad(evolve(ROAD, demand=demand, seed=seed, road=road), breakdowns)


def run_to_end(road: LonelyRoad, within_s: float = END_S) -> list[tuple[float, str, Obstacle]]:
    """Step until all vehicles have left; return what has happened to closed parts.

    Each tick is checked: bodies do not touch, none is in a closed part without a vehicle, those
    that have broken down stand in time, and vehicles wait only where a part is closed.
    """
    changes: list[tuple[float, str, Obstacle]] = []
    while not road.roadside.demand.exhausted(road.t_s) or road.vehicles:
        t_s = road.t_s
        road.step()
        assert road.t_s < within_s, f"still on the road: {sorted(road.vehicles)}"
        assert road.overlaps == []
        changes += [(t_s, *change) for change in road.roadside.pop_obstacle_changes()]
        for one in road.roadside.obstacles.active:
            check_obstacle(one, road)
    return changes


def check_obstacle(one: ActiveObstacle, road: LonelyRoad) -> None:
    broken = road.vehicles.get(one.vehicle or Name("none"))
    if one.kind == CLOSED and not one.is_over(road.t_s):
        assert one.part.lane not in {
            lane
            for vehicle in road.vehicles.values()
            if vehicle.state[0] > one.part.from_m + 0.1
            and vehicle.state[0] - vehicle.size[0] < one.part.to_m
            for lane in vehicle.lanes_touched
        }
    elif broken is not None and one.breakdown is not None and not one.is_over(road.t_s):
        stops_s = broken.controller.lattice.speed_mps / one.breakdown.decel_mps2 + 2.0
        assert road.t_s < one.since_s + stops_s or broken.state[1] < STANDING_MPS


def names(road: LonelyRoad, kind: str) -> list[Name]:
    return sorted(name for _, own, name in road.events if own == kind)


@pytest.mark.parametrize(
    ("volume", "seed", "decel_mps2", "at_m"),
    variants(
        [
            (600.0, 1, 3.0, 300.0),
            (1500.0, 2, 3.0, 300.0),
            (1000.0, 3, 8.0, 500.0),
            (1000.0, 4, 1.0, 200.0),
            (1000.0, 5, 3.0, 60.0),
            (1000.0, 6, 3.0, 930.0),
        ],
        3,
    ),
)
def test_a_vehicle_that_breaks_down_is_an_obstacle_until_all_have_passed_it(
    volume: float, seed: int, decel_mps2: float, at_m: float
) -> None:
    broken = Breakdown(AT_S, lane=LANE, at_m=at_m, decel_mps2=decel_mps2, for_s=STANDS_S)
    road = lonely_road(broken, volume=volume, seed=seed)

    changes = run_to_end(road)

    begun, *_, (opened_s, last_kind, last) = changes
    closed_s, kind, obstacle = begun
    assert (kind, last_kind) == (PART_CLOSED, PART_OPENED)
    assert (obstacle.cause, obstacle.lane) == (BREAKDOWN, LANE)
    assert closed_s >= AT_S
    assert opened_s >= closed_s + STANDS_S
    assert last.from_m == obstacle.from_m
    # Whoever stopped has cells again, the vehicle that broke down, too.
    # (Near the end of the road, vehicles leave it before.)
    assert names(road, LEFT_LATTICE) == names(road, DRIVES_OUT)
    assert len(names(road, LEFT_LATTICE)) - len(names(road, ENTERED_LATTICE)) <= (at_m > 900.0)
    assert obstacle.vehicle in names(road, LEFT_LATTICE)


def test_a_gap_passes_a_vehicle_as_soon_as_it_is_repaired() -> None:
    check_that_a_gap_passes_when_it_is_repaired()


def check_that_a_gap_passes_when_it_is_repaired() -> None:
    road = lonely_road(BREAKS_DOWN)
    while not any(one.stands for one in road.roadside.obstacles.active):
        road.step()
        assert LANE not in gaps_of(road)  # nobody knows when it will be repaired
    (obstacle,) = road.roadside.obstacles.active
    vehicle = road.vehicles[obstacle.vehicle or Name("none")]
    repaired_s, passes_s = obstacle.until_s, list[float]()
    while vehicle.controller.off_lattice is OffLatticePhase.WAITING:
        road.step()
        passes_s += [
            ROAD.lattice.passing_time_s(gap.columns[-1], vehicle.state[0])
            for gap in gaps_of(road).get(LANE, [])
        ]
    gap_s = re_entry(ROAD).columns * ROAD.lattice.pitch_m / ROAD.lattice.speed_mps
    assert repaired_s <= min(passes_s) <= repaired_s + gap_s
    assert repaired_s <= road.t_s <= repaired_s + gap_s + START_S


def test_no_gap_is_kept_free_for_a_vehicle_that_is_never_repaired() -> None:
    road = lonely_road(evolve(BREAKS_DOWN, for_s=math.inf))
    while road.t_s < AT_S + 5.0 * STANDS_S:
        road.step()
        assert LANE not in gaps_of(road)
    assert names(road, ENTERED_LATTICE)


@pytest.mark.parametrize(("volume", "seed"), variants([(1500.0, 2), (1800.0, 3)], 1))
def test_nobody_waits_behind_a_vehicle_that_is_never_repaired(volume: float, seed: int) -> None:
    check_that_nobody_waits_for_a_repair(volume, seed)


def check_that_nobody_waits_for_a_repair(volume: float = 1500.0, seed: int = 2) -> None:
    """Those that could not stop at the line drive out, too, slowly."""
    road = lonely_road(evolve(BREAKS_DOWN, for_s=math.inf), volume=volume, seed=seed)
    beyond: dict[Name, float] = {}
    while len(road.vehicles) > 1 or not road.roadside.demand.exhausted(road.t_s):
        road.step()
        assert road.t_s < END_S, f"still on the road: {sorted(road.vehicles)}"
        assert road.overlaps == []
        for one in road.roadside.obstacles.active:
            line_m = stop_line_m(one.part, ROAD)
            for name, vehicle in road.vehicles.items():
                controller = vehicle.controller
                if controller.off_lattice is OffLatticePhase.RE_ENTERING:
                    assert controller.level is not FallbackLevel.EMERGENCY
                elif name != one.vehicle and controller.stays and vehicle.state[0] > line_m + 1.0:
                    beyond[name] = road.t_s
    (broken,) = road.vehicles
    assert len(beyond) >= 2
    out = [name for _, kind, name in road.events if kind == DRIVES_OUT]
    assert sorted(out) == [name for name in names(road, LEFT_LATTICE) if name != broken]
    # They do not wait until nobody is at the line.
    last_s = AT_S + LAST_S + 40.0 * len(beyond)
    assert all(left_s < last_s for left_s in beyond.values())
    assert {*out[-2:]}.isdisjoint(beyond)


@pytest.mark.parametrize(
    "later",
    variants(
        [
            pytest.param((RoadEvent(LANE, 600.0, 650.0, 0.0),), id="yes"),
            pytest.param((), id="no"),
        ]
    ),
)
def test_who_starts_behind_a_body_keeps_its_distance_although_the_lane_ends_later(
    later: tuple[RoadEvent, ...],
) -> None:
    road = lonely_road(evolve(BREAKS_DOWN, for_s=math.inf), volume=1500.0, seed=2, events=later)
    started: set[Name] = set()
    while road.t_s < AT_S + 150.0:
        road.step()
        for name, vehicle in road.vehicles.items():
            if vehicle.controller.stop_lines.keeps_distance:
                started.add(name)
                assert vehicle.controller.level is not FallbackLevel.EMERGENCY
    assert len(started) == 2


def gaps_of(road: LonelyRoad) -> dict[int, list[Gap]]:
    """Return the gaps by lane."""
    found: dict[int, list[Gap]] = {}
    for gaps in road.roadside._lane_ends._gaps.values():
        for gap in gaps:
            found.setdefault(gap.lane, []).append(gap)
    return found


@pytest.mark.parametrize(
    ("volume", "in_lane", "least", "most"),
    [
        (600.0, True, OPEN_GAPS, OPEN_GAPS + 1),
        (600.0, False, 0, OPEN_GAPS),
        (1800.0, False, CROWDED_GAPS - 1, CROWDED_GAPS),
    ],
)
def test_gaps_leave_cells_for_the_vehicles_that_pass(
    volume: float, least: int, most: int, *, in_lane: bool
) -> None:
    """Where there is room, gaps alternate between the lanes on both sides."""
    road = lonely_road(evolve(BREAKS_DOWN, for_s=math.inf), volume=volume)
    seen: dict[int, set[range]] = {}
    while all(len(gaps) < 2 for gaps in seen.values()):
        road.step()
        for lane, gaps in gaps_of(road).items():
            seen.setdefault(lane if in_lane else 0, set()).update(gap.columns for gap in gaps)
    (of_lane,) = (gaps for gaps in seen.values() if len(gaps) == 2)
    ahead, behind = sorted(of_lane, key=lambda kept: -kept.start)
    columns = re_entry(ROAD).columns
    assert least * columns <= ahead.start - behind.stop <= most * columns


@pytest.mark.parametrize(
    "elsewhere", [False, True], ids=["one part", "a part of another lane, too"]
)
def test_own_gaps_count_where_others_pass_another_part(
    monkeypatch: pytest.MonkeyPatch, *, elsewhere: bool
) -> None:
    """A gap in the lane of a closed part counts only if vehicles pass another part in that lane."""
    found: list[tuple[int, bool]] = []
    keep_free = EntryMeter.keep_free

    def noted(
        self: EntryMeter, point: int, count: int, t_s: float, *, passes_parts: bool = True
    ) -> range:
        found.append((point, passes_parts))
        return keep_free(self, point, count, t_s, passes_parts=passes_parts)

    monkeypatch.setattr(EntryMeter, "keep_free", noted)
    event = RoadEvent(0, 750.0, 800.0, AT_S, until_s=END_S, clear_s=0.0)
    road = lonely_road(BREAKS_DOWN, volume=1000.0, events=(event,) if elsewhere else ())
    while road.t_s < AT_S + STANDS_S + 15.0:
        road.step()
    assert {counts for lane, counts in found if lane == LANE} == {elsewhere}


def test_the_census_tells_where_those_stand_that_have_stopped() -> None:
    road = lonely_road(BREAKS_DOWN, volume=1500.0)
    while road.t_s < AT_S + STANDS_S:
        road.step()
    census = road.roadside.publisher.census(road.t_s, road.vehicles.values())
    bodies = {one.vehicle: one.off_lattice for one in census.on_road}
    standing = [
        one
        for one in road.vehicles.values()
        if one.controller.stays and one.state[1] <= STANDING_MPS
    ]
    assert len(standing) >= 3
    for one in standing:
        assert bodies[one.name] == OffLattice(LANE, one.state[0] - one.size[0])


def test_the_vehicle_slows_down_as_given_stands_as_long_as_given_and_is_where_it_was_said() -> None:
    road = lonely_road(BREAKS_DOWN)
    stands_s = moves_s = math.nan
    parts: list[Obstacle] = []
    while math.isnan(moves_s):
        road.step()
        parts += [one for _, one in road.roadside.pop_obstacle_changes()]
        if not parts:
            continue
        assert parts[0].vehicle is not None
        vehicle = road.vehicles[parts[0].vehicle]
        assert vehicle.state[2] >= -BREAKS_DOWN.decel_mps2 - 1e-6
        if math.isnan(stands_s) and vehicle.state[1] < STANDING_MPS:
            stands_s = road.t_s
        elif not math.isnan(stands_s) and vehicle.state[1] > 1.0:
            moves_s = road.t_s
        elif not math.isnan(stands_s):
            front_m = vehicle.state[0]
            assert parts[-1].from_m <= front_m - vehicle.size[0]
            assert front_m <= parts[-1].to_m
    assert moves_s - stands_s >= STANDS_S
    assert parts[-1].until_s == pytest.approx(stands_s + STANDS_S, abs=0.3)


def test_one_whose_move_into_the_lane_has_just_begun_drives_past_in_its_own_lane() -> None:
    check_that_one_whose_move_has_just_begun_drives_past()


def check_that_one_whose_move_has_just_begun_drives_past() -> None:
    road = lonely_road(BREAKS_DOWN, volume=1500.0)
    while not road.roadside.obstacles.active:
        road.step()
    line_m = next(iter(road.roadside.lane_ends)).line_m
    beside = [one for one in road.vehicles.values() if line_m < one.state[0] < AT_M - 5.0]
    moved = next(one for one in beside if one.body_lane != LANE)
    origin = moved.controller.hold_cell
    moved.controller._guard.moving_from = origin
    moved.controller.hold_cell = (origin[0], LANE)
    while moved.name in road.vehicles:
        road.step()
        assert road.overlaps == []
        assert moved.state[1] > 0.5 * ROAD.lattice.speed_mps
        assert moved.state[0] > AT_M + 50.0 or moved.body_lane == origin[1]
    assert moved.body_lane == LANE


def test_others_stop_at_the_line_or_behind_it_and_never_touch_the_vehicle() -> None:
    road = lonely_road(BREAKS_DOWN, volume=1500.0)
    while road.t_s < AT_S + STANDS_S:
        road.step()
    (part,) = road.roadside.obstacles.temporary.closed
    line_m = next(iter(road.roadside.lane_ends)).line_m
    assert line_m == part.from_m - part.late_m - re_entry(ROAD).room_m
    standing = sorted(
        (vehicle.state[0] for vehicle in road.vehicles.values() if vehicle.state[1] < 0.1),
        reverse=True,
    )
    broken, *others = standing
    assert part.from_m < broken < part.to_m
    assert len(others) >= 3
    assert all(front_m < part.from_m for front_m in others)
    assert sum(front_m > line_m + 1.0 for front_m in others) * 6.0 <= part.late_m


@pytest.mark.parametrize("seed", variants([1, 2, 3]))
def test_those_that_wait_start_one_after_the_other_wherever_they_stand(seed: int) -> None:
    """Each gap passes a vehicle once the one ahead has started, or it would have to wait anew."""
    road = lonely_road(BREAKS_DOWN, volume=1450.0, seed=seed)
    starts_s: list[float] = []
    while len(starts_s) < 4:
        known = len(road.events)
        road.step()
        starts_s += [
            t_s
            for t_s, kind, name in road.events[known:]
            if kind == DRIVES_OUT and road.vehicles[name].controller.hold_cell[1] == LANE
        ]
    again_s = road.scenario.lattice.passing_time_s(0, AT_M)
    assert all(later - before < 0.5 * again_s for before, later in pairwise(starts_s))


def test_a_vehicle_may_be_named_and_others_are_drawn() -> None:
    named = run_to_end(lonely_road(Breakdown(20.0, vehicle=Name("v0003"), for_s=5.0)))
    assert {one.vehicle for _, _, one in named} == {"v0003"}
    drawn = [
        run_to_end(lonely_road(Breakdown(40.0, draw=draw, for_s=5.0)))[0][2].vehicle
        for draw in (0.0, 0.5, 0.99)
    ]
    assert len(set(drawn)) == 3


def test_a_vehicle_that_never_comes_does_not_break_down() -> None:
    road = lonely_road(Breakdown(20.0, vehicle=Name("nobody")), Breakdown(0.0, at_m=2000.0))
    assert run_to_end(road) == []
    assert road.roadside.obstacles


def test_a_part_is_closed_for_an_event_and_used_again_afterwards() -> None:
    event = RoadEvent(LANE, 400.0, 450.0, 20.0, 60.0)
    road = lonely_road(events=(event,), volume=1000.0)

    (closed_s, closed, part), (opened_s, opened, _) = run_to_end(road)

    assert (closed, opened, part.cause) == (PART_CLOSED, PART_OPENED, CLOSED)
    assert (part.lane, part.from_m, part.to_m) == (LANE, 400.0, 450.0)
    assert (part.vehicle, part.until_s) == (None, 60.0)
    assert closed_s >= 20.0
    assert opened_s >= 60.0
    assert len(names(road, LEFT_LATTICE)) >= 2


def test_a_part_is_closed_only_once_nobody_is_in_it_or_could_not_stop_before_it() -> None:
    road = lonely_road(volume=1500.0)
    while road.t_s < 40.0:
        road.step()
    part = TemporaryClosure(LANE, 200.0, 350.0)
    found = road.roadside.obstacles.in_the_way(part, road.vehicles)
    fronts_m = [one.state[0] for one in road.vehicles.values() if one.cell[1] == LANE]
    assert len(found.inside) == sum(200.0 <= front_m < 355.0 for front_m in fronts_m) > 0
    assert len(found.near) == sum(200.0 - 30.0 < front_m < 200.0 for front_m in fronts_m)


@pytest.mark.parametrize(
    "second",
    [
        (1, 330.0, 400.0),
        (1, 700.0, 750.0),
        pytest.param((1, 360.0, 400.0), marks=pytest.mark.more),
        pytest.param((0, 310.0, 340.0), marks=pytest.mark.more),
    ],
)
def test_a_second_part_in_the_lane_or_beside_it_is_kept_free_too(
    second: tuple[int, float, float],
) -> None:
    # Closed at once: vehicles that wait before the second part would keep the first one open.
    first = RoadEvent(1, 300.0, 350.0, 20.0, 60.0, clear_s=0.0)
    events = first, RoadEvent(*second, 20.0, 150.0, clear_s=0.0)
    assert len(run_to_end(lonely_road(events=events, volume=1000.0))) == 4


@pytest.mark.parametrize(
    ("from_m", "to_m"), variants([(540.0, 549.0), (500.0, 540.0), (480.0, 500.0)], 1)
)
def test_a_part_before_the_end_of_a_lane(from_m: float, to_m: float) -> None:
    scenario = road_with(Closure(2, 600.0), s3_m=850.0)
    events = (RoadEvent(2, from_m, to_m, 20.0, 80.0),)
    demand = Demand(volume_veh_per_lane_h=800.0, duration_s=60.0)
    road = evolve(scenario.road, events=events)
    run_to_end(LonelyRoad(evolve(scenario, demand=demand, road=road)))


@pytest.mark.parametrize("ahead_m", variants([30.5 + 1.5 * each for each in range(30)], 4))
def test_a_single_vehicle_stops_before_a_part_that_is_closed_ahead_of_it(ahead_m: float) -> None:
    demand = Demand(volume_veh_per_lane_h=40.0, duration_s=100.0)
    road = LonelyRoad(evolve(ROAD, demand=demand))
    while not road.vehicles or next(iter(road.vehicles.values())).state[0] < 200.0:
        road.step()
    vehicle = next(iter(road.vehicles.values()))
    from_m = vehicle.state[0] + ahead_m
    closure = RoadEvent(vehicle.cell[1], from_m, from_m + 30.0, road.t_s, clear_s=0.0)
    road.roadside.obstacles._pending.append(closure)
    for _ in range(100):
        road.step()
        assert vehicle.state[0] <= from_m
    assert vehicle.state[1] < 0.1


@pytest.mark.more
def test_several_vehicles_break_down_at_once() -> None:
    twice = evolve(BREAKS_DOWN, for_s=10.0)
    both_lanes = twice, evolve(twice, lane=0)
    drawn = [Breakdown(AT_S, draw=each / 10.0, for_s=10.0) for each in range(10)]
    for breakdowns in ((twice, twice), both_lanes, drawn):
        changes = run_to_end(lonely_road(*breakdowns, volume=1000.0))
        begun = [one.vehicle for _, kind, one in changes if kind == PART_OPENED]
        assert len(begun) == len(breakdowns)
        # The first vehicle beyond a place may be one that has been repaired there.
        assert breakdowns == (twice, twice) or len(begun) == len(set(begun))


def test_where_vehicles_enter_none_breaks_down_that_others_could_not_see_in_time() -> None:
    road = lonely_road(Breakdown(5.0, lane=LANE, for_s=20.0), volume=1500.0)
    (_, _, obstacle), *_ = run_to_end(road)
    assert obstacle.from_m >= room_before_part_m(ROAD, re_entry(ROAD).room_m)


def test_while_a_lane_is_closed_each_column_has_a_place_beside_it_for_each_vehicle() -> None:
    event = RoadEvent(LANE, 700.0, 750.0, 0.0)
    road = lonely_road(events=(event,), volume=2200.0)
    while road.t_s < 45.0:
        road.step()
    columns = [vehicle.admission.cell[0] for vehicle in road.vehicles.values()]
    assert len(columns) > 40
    assert max(columns.count(column) for column in columns) == ROAD.road.lanes - 1


ROADS: tuple[Callable[[], LonelyRoad], ...] = (
    lambda: lonely_road(BREAKS_DOWN, volume=1500.0),
    lambda: lonely_road(events=(RoadEvent(LANE, 400.0, 450.0, 35.0, 80.0),), volume=1000.0),
    lambda: lonely_road(
        events=tuple(RoadEvent(lane, 150.0, 250.0, 10.0, 60.0) for lane in range(3)), volume=1500.0
    ),
)
ENOUGH_S = 400.0
"""Without a bug all vehicles have left these roads before."""
BUGS: tuple[Bug, ...] = (
    road_bugs.parts_open_while_vehicles_wait, road_bugs.late_vehicles_have_no_room,
    road_bugs.late_vehicles_do_not_stop, road_bugs.broken_vehicles_drive_on,
    road_bugs.parts_are_closed_around_vehicles, road_bugs.gaps_end_at_the_line,
    road_bugs.entrances_stay_open, road_bugs.controllers_do_not_know,
    road_bugs.moves_into_closed_lanes_go_on, road_bugs.gaps_only_after_the_repair,
    road_bugs.late_vehicles_wait_for_the_repair, road_bugs.late_vehicles_start_as_others,
)  # fmt: skip


def check_all() -> None:
    for make in ROADS:
        run_to_end(make(), ENOUGH_S)
    check_that_those_at_the_line_drive_out_meanwhile()
    check_that_a_gap_passes_when_it_is_repaired()
    check_that_nobody_waits_for_a_repair()
    check_that_one_whose_move_has_just_begun_drives_past()
    check_that_nobody_enters_while_all_lanes_are_closed()


def check_that_those_at_the_line_drive_out_meanwhile() -> None:
    road = lonely_road(BREAKS_DOWN, volume=1500.0)
    while road.t_s < AT_S + STANDS_S:
        road.step()
    assert len(names(road, DRIVES_OUT)) >= 2
    (obstacle,) = road.roadside.obstacles.active
    assert obstacle.vehicle not in names(road, DRIVES_OUT)


def check_that_nobody_enters_while_all_lanes_are_closed() -> None:
    events = tuple(RoadEvent(lane, 700.0, 750.0, 5.0, 30.0) for lane in range(3))
    road = lonely_road(events=events, volume=1000.0)
    while road.t_s < 25.0:
        road.step()
        if road.t_s < 6.0:
            entered = len(road.vehicles)
        assert len(road.vehicles) <= entered
    run_to_end(road)


@pytest.mark.more
def test_without_a_bug_nothing_is_noticed() -> None:
    check_all()


@pytest.mark.more
@pytest.mark.parametrize(
    "bug", [pytest.param(bug, marks=catches(bug), id=bug.name) for bug in BUGS]
)
def test_planted_bugs_are_noticed(bug: Bug, monkeypatch: pytest.MonkeyPatch) -> None:
    bug.plant(monkeypatch)
    with pytest.raises(AssertionError):
        check_all()


def test_lane_ends_follow_from_closed_parts() -> None:
    part = TemporaryClosure(LANE, 600.0, 650.0, late_m=12.0)
    (end,) = LaneEnds(ROAD, TemporaryParts((part,)))
    assert (end.lane, end.end_m, end.reopens_m, end.sudden) == (LANE, 600.0, 650.0, True)
    assert end.line_m == end.stop_m == 600.0 - 12.0 - re_entry(ROAD).room_m
    ends = LaneEnds(ROAD, TemporaryParts((part,)))
    far = ends.heeded(LANE, end.line_m - 50.0, 15.0)
    late = ends.heeded(LANE, end.line_m - 5.0, 15.0)
    assert far == end
    assert late is not None
    assert late.stop_m == 599.0
    assert ends.heeded(LANE, 590.0, 15.0) is None
    assert ends.heeded(LANE, 590.0, 0.0) == late
    assert ends.heeded(0, 590.0, 15.0) is None
