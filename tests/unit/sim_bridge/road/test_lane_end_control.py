"""Vehicles without agents in a lane that ends: they stop, wait and enter the lattice again."""

from __future__ import annotations

from itertools import pairwise

import pytest
from attrs import evolve

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Closure, Demand
from laneweave.protocol.vehicle.lane_ends import dead_ends
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.wire.events import DRIVES_OUT, ENTERED_LATTICE, LEFT_LATTICE
from laneweave.protocol.wire.messages import Name, OffLattice
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel
from laneweave.sim_bridge.road.entry import EntryMeter
from support import road_bugs
from support.bugs import Bug, catches
from support.closed_lanes import LonelyRoad, road_with
from support.variants import variants

DROP = road_with(Closure(0, 400.0), s3_m=450.0)
BLOCKED = road_with(Closure(1, 300.0, 400.0), s3_m=450.0)
KINDS = (LEFT_LATTICE, DRIVES_OUT, ENTERED_LATTICE)
HARDEST_MPS2 = -7.0
MAX_S = 900.0


def lonely_road(scenario: Scenario, volume: float, duration_s: float, seed: int = 1) -> LonelyRoad:
    demand = Demand(volume_veh_per_lane_h=volume, duration_s=duration_s)
    return LonelyRoad(evolve(scenario, demand=demand, seed=seed))


def check(road: LonelyRoad, within_s: float = MAX_S) -> None:
    """Step until all vehicles have left the road; each tick is checked."""
    owners: dict[Cell, Name] = {}
    while not road.roadside.demand.exhausted(road.t_s) or road.vehicles:
        road.step()
        assert road.t_s < within_s, "a vehicle is still on the road"
        assert road.overlaps == []
        for name, vehicle in road.vehicles.items():
            controller = vehicle.controller
            assert controller.level is not FallbackLevel.EMERGENCY
            assert vehicle.state[2] > HARDEST_MPS2
            assert (controller.record.owned == ()) == (controller.off_lattice is not None)
            for cell in controller.record.owned:
                owner = owners.setdefault(cell, name)
                assert owner == name or owner not in road.vehicles, "a cell has two owners"
                owners[cell] = name
    left, out = ([one for _, k, one in road.events if k == kind] for kind in KINDS[:2])
    assert len(left) >= 3
    assert sorted(left) == sorted(out)


@pytest.mark.parametrize(
    ("scenario", "volume", "seed"),
    variants([(DROP, 300.0, 1), (BLOCKED, 1000.0, 1), (DROP, 1800.0, 2)], 2),
    ids=["few", "blocked lane", "many"],
)  # fmt: skip
def test_all_vehicles_leave_the_road_and_none_overlaps_another_body(
    scenario: Scenario, volume: float, seed: int
) -> None:
    check(lonely_road(scenario, volume, 60.0, seed))


def test_a_single_vehicle_waits_for_the_gap_that_comes_from_the_entrance() -> None:
    road = lonely_road(DROP, 40.0, 100.0)
    (end,) = dead_ends(DROP)
    while len(road.events) < 3:
        road.step()
    (off_s, out_s, in_s), kinds, names = zip(*road.events, strict=True)
    assert kinds == KINDS
    (name,) = set(names)
    travel_s = end.line_m / DROP.lattice.speed_mps
    assert off_s + travel_s - 2.0 <= out_s <= off_s + travel_s + 10.0
    assert in_s <= out_s + 15.0
    # It has entered the rearmost of the columns, and owns all of them.
    controller = road.vehicles[name].controller
    columns = re_entry(DROP).columns
    assert controller.hold_cell == controller.record.owned[0]
    assert len(controller.record.owned) == columns
    assert road.vehicles[name].admission.cell == controller.hold_cell


@pytest.mark.more
def test_between_two_gaps_there_is_as_much_room_for_traffic() -> None:
    road = lonely_road(DROP, 900.0, 100.0)
    while road.t_s < 100.0:
        road.step()
    gaps = sorted(
        (gap.columns[0], gap.columns[-1])
        for gaps in road.roadside._lane_ends._gaps.values()
        for gap in gaps
        if gap.vehicle is None
    )
    assert len(gaps) >= 3
    columns = re_entry(DROP).columns
    for (rear, front), (next_rear, _) in pairwise(gaps):
        assert front - rear == columns - 1
        assert next_rear - front > columns


def test_the_census_tells_where_they_stand() -> None:
    road = lonely_road(DROP, 1000.0, 60.0)
    (end,) = dead_ends(DROP)
    while sum(kind == LEFT_LATTICE for _, kind, _ in road.events) < 3 or road.t_s < 90.0:
        road.step()
    census = road.roadside.publisher.census(road.t_s, road.vehicles.values())
    bodies = {
        entry.vehicle: entry.off_lattice
        for entry in census.on_road
        if entry.off_lattice is not None
    }
    assert len(bodies) >= 3
    assert {entry.vehicle for entry in census.on_lattice} == set(road.vehicles) - set(bodies)
    for name, body in bodies.items():
        if road.vehicles[name].state[1] < 0.1:
            assert body.lane == end.lane
            rear_m = road.vehicles[name].state[0] - DROP.vehicle.length_m
            assert body.rear_m == pytest.approx(rear_m, abs=8.0)


def test_plans_may_follow_a_vehicle_that_re_enters() -> None:
    """Its lane does not end for those behind its gap, once its body is in it."""
    road = lonely_road(DROP, 40.0, 100.0)
    told: list[tuple[int, OffLattice]] = []
    while ENTERED_LATTICE not in {kind for _, kind, _ in road.events}:
        road.step()
        census = road.roadside.publisher.census(road.t_s, road.vehicles.values())
        for vehicle in road.vehicles.values():
            if vehicle.re_enters:
                (body,) = census.off_lattice
                rear_m = vehicle.state[0] - vehicle.size[0]
                told.append((vehicle.body_lane, body))
                in_gap = vehicle.body_lane == 1
                expected_m = DROP.road.length_m if in_gap else pytest.approx(rear_m)
                assert (body.lane, body.rear_m) == (vehicle.body_lane, expected_m)
    assert {lane for lane, _ in told} == {0, 1}


def test_plans_do_not_follow_a_vehicle_that_falls_behind_its_gap() -> None:
    road = lonely_road(DROP, 40.0, 100.0)
    vehicles = road.vehicles.values()
    while not any(one.re_enters and one.body_lane == 1 for one in vehicles):
        road.step()
    (vehicle,) = (one for one in vehicles if one.re_enters)
    column, lane = vehicle.controller.hold_cell
    vehicle.controller.hold_cell = (column + 12, lane)
    (body,) = road.roadside.publisher.census(road.t_s, vehicles).off_lattice
    assert body.lane == 1
    assert body.rear_m == pytest.approx(vehicle.state[0] - vehicle.size[0])


@pytest.mark.parametrize(
    "blind",
    [
        pytest.param(False, id=""),
        pytest.param(True, id="planted bug", marks=catches(road_bugs.full_lanes_are_entered)),
    ],
)
@pytest.mark.more
def test_a_queue_that_reaches_the_entrance_keeps_vehicles_from_entering(
    monkeypatch: pytest.MonkeyPatch, *, blind: bool
) -> None:
    if blind:
        road_bugs.full_lanes_are_entered.plant(monkeypatch)
    road = lonely_road(road_with(Closure(0, 300.0), s3_m=350.0), 2200.0, 80.0)
    longest = 0
    while not road.overlaps and (road.vehicles or not road.roadside.demand.exhausted(road.t_s)):
        road.step()
        assert road.t_s < MAX_S
        longest = max(longest, sum(one.state[1] < 1.0 for one in road.vehicles.values()))
    assert (road.overlaps != []) == blind
    assert longest > 15


def test_a_vehicle_may_leave_the_road_while_it_drives_out() -> None:
    road = lonely_road(road_with(Closure(0, 590.0), s3_m=450.0), 20.0, 200.0)
    while road.vehicles or not road.roadside.demand.exhausted(road.t_s):
        road.step()
        assert road.t_s < MAX_S
        # Also in the tick in which it has left.
        road.roadside.publisher.census(road.t_s, road.vehicles.values())
    assert DRIVES_OUT in {kind for _, kind, _ in road.events}


def test_one_gap_for_each_vehicle() -> None:
    road = lonely_road(DROP, 40.0, 100.0)
    asked = []
    keep_free = EntryMeter.keep_free
    road.roadside._lane_ends._meter = meter = road.roadside._meter
    meter.keep_free = lambda lane, *more, **named: (  # type: ignore[method-assign]
        asked.append(lane) or keep_free(meter, lane, *more, **named)  # type: ignore[func-returns-value]
    )
    while road.vehicles or not road.roadside.demand.exhausted(road.t_s):
        road.step()
    out = [one for _, kind, one in road.events if kind == DRIVES_OUT]
    assert len(asked) == len(out) > 0


def test_a_vehicle_that_cannot_drive_out_in_time_waits_at_the_next_end() -> None:
    """When it re-enters, a vehicle stands in the next lane, which ends, too."""
    road = lonely_road(road_with(Closure(0, 400.0), Closure(1, 700.0)), 40.0, 60.0)
    while DRIVES_OUT not in {kind for _, kind, _ in road.events}:
        road.step()
    (name,) = {one for _, kind, one in road.events if kind == DRIVES_OUT}
    controller = road.vehicles[name].controller
    # As if it had been delayed: its cell is far ahead.
    controller.hold_cell = (controller.hold_cell[0] + 12, 1)
    while road.vehicles or not road.roadside.demand.exhausted(road.t_s):
        road.step()
        assert road.overlaps == []
        assert road.t_s < MAX_S
    kinds = [kind for _, kind, one in road.events if one == name]
    assert kinds.count(DRIVES_OUT) == 2


# In denser or longer traffic vehicles without agents also brake hard without a bug.
CROWD: tuple[float, float] = (1500.0, 50.0)
"""Volume [veh/(lane h)] and duration [s] of the traffic that shows the bugs."""
ENOUGH_S = 260.0
"""Without a bug all vehicles have left the road before."""
BUGS: tuple[Bug, ...] = (
    road_bugs.no_stop_line, road_bugs.line_at_the_end, road_bugs.keeps_its_cells,
    road_bugs.starts_without_a_gap, road_bugs.waits_forever, road_bugs.last_first,
    road_bugs.drives_on, road_bugs.line_forgotten_when_driving_out,
    # Only traffic notices these.
    road_bugs.gaps_are_given_away, road_bugs.gap_is_entered, road_bugs.gap_too_short,
)  # fmt: skip


@pytest.mark.more
@pytest.mark.parametrize(
    "bug", [pytest.param(bug, marks=catches(bug), id=bug.name) for bug in BUGS]
)
def test_planted_bugs_are_noticed(bug: Bug, monkeypatch: pytest.MonkeyPatch) -> None:
    bug.plant(monkeypatch)
    with pytest.raises(AssertionError):
        check(lonely_road(DROP, *CROWD), ENOUGH_S)


@pytest.mark.more
def test_without_a_bug_nothing_is_noticed() -> None:
    check(lonely_road(DROP, *CROWD), ENOUGH_S)
