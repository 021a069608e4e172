"""Vehicles without agents on ramps and in the lanes of exits; cells of ramps and of departures."""

from __future__ import annotations

import pytest
from attrs import evolve

from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import Exits
from laneweave.protocol.vehicle.lane_ends import dead_ends
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.events import DRIVES_OUT, LEFT_LATTICE, MISSED_EXIT
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    CurrentMotion,
    Name,
    PendingTransfer,
    VehicleRecord,
)
from laneweave.sim_bridge.bodies.motion_controller import (
    FallbackLevel,
    MotionController,
    OffLatticePhase,
)
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.demand import arrivals
from laneweave.sim_bridge.road.roadside import Roadside
from support.closed_lanes import LonelyRoad, ramp_road
from support.road_vehicles import vehicle_in
from support.states import set_record

ON_RAMP = ramp_road()
WEAVING = ramp_road(exit_name="off")
MAX_S = 900.0
BALLOT = Ballot(1, Name("c"), 1, 1)


def run(road: LonelyRoad, *, owners_checked: bool = True) -> None:
    """Step until all vehicles have left; no body touches another, no cell has two owners."""
    owners: dict[Cell, Name] = {}
    while road.vehicles or not road.roadside.demand.exhausted(road.t_s):
        road.step()
        assert road.t_s < MAX_S, "a vehicle is still on the road"
        assert road.overlaps == []
        for name, vehicle in road.vehicles.items():
            assert vehicle.controller.level is not FallbackLevel.EMERGENCY
            for cell in vehicle.controller.record.owned if owners_checked else ():
                owner = owners.setdefault(cell, name)
                assert owner == name or owner not in road.vehicles, "a cell has two owners"
                owners[cell] = name


@pytest.mark.more
def test_ramp_vehicles_without_agents_stop_at_the_line_and_get_on() -> None:
    road = LonelyRoad(ON_RAMP)
    from_ramp = {Name(one.vehicle) for one in arrivals(ON_RAMP) if one.lane == 0}
    assert len(from_ramp) >= 5
    (end,) = dead_ends(ON_RAMP)
    farthest_m = 0.0
    while len(road.left) < len(arrivals(ON_RAMP)):
        road.step()
        assert road.t_s < MAX_S
        assert road.overlaps == []
        for vehicle in road.vehicles.values():
            if vehicle.controller.off_lattice is OffLatticePhase.WAITING:
                farthest_m = max(farthest_m, vehicle.state[0])
    assert farthest_m <= end.line_m
    for kind in (LEFT_LATTICE, DRIVES_OUT):
        assert {name for _, each, name in road.events if each == kind} == from_ramp


def test_vehicles_enter_the_ramp_at_its_beginning_in_cells_of_its_lane() -> None:
    road = LonelyRoad(ON_RAMP)
    seen = set[Name]()
    while road.t_s < 60.0:
        road.step()
        for name, vehicle in road.vehicles.items():
            if name not in seen and vehicle.arrival.lane == 0:
                assert vehicle.state[0] == pytest.approx(50.0, abs=3.0)
                assert vehicle.state[1] == pytest.approx(ON_RAMP.formation.speed_mps, abs=0.1)
                column, lane = vehicle.admission.cell
                passed_s = ON_RAMP.lattice.passing_time_s(column, 50.0)
                assert abs(passed_s - vehicle.entered_s) <= ON_RAMP.formation.entry_spread_s + 1e-9
                assert lane == 0
            seen.add(name)


def test_the_cells_of_a_ramp_get_owners_where_it_begins_and_no_two() -> None:
    road = LonelyRoad(ON_RAMP)
    lattice = ON_RAMP.lattice
    for _ in range(300):
        road.step()
        owned = [cell for one in road.vehicles.values() for cell in one.controller.record.owned]
        assert len(owned) == len(set(owned))
        reach_m = lattice.speed_mps * ON_RAMP.formation.entry_spread_s + lattice.pitch_m
        assert all(
            lattice.cell_s_m(column, road.t_s) > 50.0 - reach_m
            for column, lane in owned
            if not lane
        )
    on_ramp = {column for column, lane in owned if lane == 0}
    first, last = min(on_ramp), max(on_ramp)
    assert len(on_ramp) > 0.9 * (last - first + 1)


@pytest.mark.more
def test_vehicles_in_the_lane_of_an_exit_leave_there_whatever_their_destination() -> None:
    road = LonelyRoad(WEAVING)
    run(road)
    by_exit = {name for name, exit_name in road.exits.items() if exit_name == "off"}
    assert by_exit == {Name(one.vehicle) for one in arrivals(WEAVING) if one.lane == 0}
    assert not road.events


@pytest.mark.more
def test_a_queue_on_a_ramp_keeps_vehicles_from_entering_until_there_is_room_to_merge() -> None:
    full = ramp_road(demand={"volume_veh_per_lane_h": 1800.0, "duration_s": 120.0})
    full = evolve(full, entrance=(evolve(full.entrance[0], volume_veh_per_h=1200.0),))
    road = LonelyRoad(full)
    (end,) = dead_ends(full)
    room_m = full.entrance[0].merge_m + full.formation.speed_mps * full.timing.cycles_s[0]
    waiting: list[float] = []
    while road.t_s < 240.0:
        entered = len(road.vehicles)
        before = [
            vehicle.state[0]
            for vehicle in road.vehicles.values()
            if vehicle.controller.off_lattice is OffLatticePhase.WAITING
        ]
        road.step()
        assert road.overlaps == []
        if any(s_m < room_m for s_m in before):
            new = list(road.vehicles.values())[entered:]
            assert all(vehicle.arrival.lane != 0 for vehicle in new)
            waiting += before
    assert waiting
    assert min(waiting) > full.entrance[0].merge_m
    assert max(waiting) <= end.line_m


# --- cells of vehicles that have left ---------------------------------------------------------


def departed(
    transfer: PendingTransfer | None, still_in: int | None = None
) -> tuple[MotionController, MotionController]:
    """Let a vehicle with two cells leave; return its controller and that of the one behind it."""
    roadside = Roadside(WEAVING, ())
    gone, behind = (
        vehicle_in(cell, name, WEAVING) for cell, name in (((0, 1), "A"), ((-3, 1), "B"))
    )
    far = vehicle_in((-30, 1), "C", WEAVING)
    gone.controller.store.assign_cell((-1, 0))
    if transfer is not None:
        gone.controller.store.store_promise(transfer.ballot)
        gone.controller.store.begin_transfer(transfer)
    others = {vehicle.name: vehicle for vehicle in (behind, far)}
    roadside.on_left(gone, others, 20.0, still_in)
    assert far.controller.record.owned == ((-30, 1),)
    return gone.controller, behind.controller


def test_the_cells_of_a_vehicle_that_has_left_go_to_the_nearest_one() -> None:
    _, behind = departed(None)
    assert set(behind.record.owned) == {(-3, 1), (0, 1), (-1, 0)}


def test_cells_in_the_lane_in_which_sumo_drives_a_vehicle_on_go_to_nobody() -> None:
    _, behind = departed(None, still_in=1)
    assert set(behind.record.owned) == {(-3, 1), (-1, 0)}


def test_cells_that_a_pending_transfer_may_have_given_away_stay_without_owner() -> None:
    before, after = ((-1, 0), (0, 1)), ((0, 1),)
    transfer = PendingTransfer(BALLOT, before, after, (Name("A"), Name("D")))
    _, behind = departed(transfer)
    assert set(behind.record.owned) == {(-3, 1), (0, 1)}


def test_cells_that_a_pending_transfer_may_bring_stay_without_owner() -> None:
    before, after = ((-1, 0), (0, 1)), ((-1, 0), (0, 1), (1, 1))
    transfer = PendingTransfer(BALLOT, before, after, (Name("A"), Name("D")))
    _, behind = departed(transfer)
    assert set(behind.record.owned) == {(-3, 1), (0, 1), (-1, 0)}


def place(controller: MotionController, state: State) -> None:
    """Put the body of a controller into a state."""
    controller.plant = Plant(state, WEAVING.vehicle, WEAVING.runtime.tick_s)


# --- exits that are missed --------------------------------------------------------------------


def changing(*, late: bool) -> tuple[MotionController, float]:
    """Return the controller of a body in lane 1 that is to enter lane 0, and the road time.

    The command comes in time for the exit; a late body has not begun to move much later.
    """
    controller = vehicle_in((0, 1), "A", WEAVING).controller
    controller.store.put_in_charge(1)
    controller.store.assign_cell((0, 0))
    assert controller.accept_command(change_at(1.1))
    return controller, time_before_line(0.3 if late else 1.1)


def time_before_line(moves: float) -> float:
    """Return the time at which column 0 is some moves before the line of the exit."""
    move_m = WEAVING.lattice.speed_mps * WEAVING.timing.move_s
    return WEAVING.lattice.passing_time_s(0, 450.0 - moves * move_m)


def change_at(moves: float) -> Command:
    """Return the command to change from lane 1 into lane 0, some moves before the line."""
    tick = round(time_before_line(moves) / WEAVING.runtime.tick_s)
    return Command(
        vehicle=Name("A"), record=VehicleRecord(incarnation=1), tick=tick, hold_cell=(0, 0),
        motion=CurrentMotion((0, 1), tick + 58, 58), jerks=b"",
    )  # fmt: skip


def test_a_lane_change_that_begins_too_late_for_the_exit_is_taken_back() -> None:
    controller, t_s = changing(late=True)
    assert controller.has_missed_exit(t_s)
    assert controller.return_to_origin()
    assert controller.hold_cell == (0, 1)
    assert not controller.has_missed_exit(t_s)


def test_a_command_that_comes_too_late_for_the_exit_is_refused() -> None:
    controller = vehicle_in((0, 1), "A", WEAVING).controller
    controller.store.put_in_charge(1)
    controller.store.assign_cell((0, 0))
    assert not controller.accept_command(change_at(0.3))
    assert controller.hold_cell == (0, 1)


def test_one_that_begins_in_time_is_not() -> None:
    controller, t_s = changing(late=False)
    assert not controller.has_missed_exit(t_s)


def test_a_vehicle_does_not_return_to_a_cell_that_it_does_not_own() -> None:
    controller, _ = changing(late=True)
    set_record(controller.store, owned=((0, 0),))
    assert not controller.return_to_origin()
    assert controller.hold_cell == (0, 0)


def test_the_roadside_takes_it_back_and_the_vehicle_drives_past_the_exit() -> None:
    road = LonelyRoad(ramp_road(exit_name="off", demand={"duration_s": 30.0}))
    while not any(one.arrival.lane == 1 for one in road.vehicles.values()):
        road.step()
        assert road.t_s < MAX_S
    vehicle = next(one for one in road.vehicles.values() if one.arrival.lane == 1)
    column = vehicle.admission.cell[0]
    controller = vehicle.controller
    line_s = WEAVING.lattice.passing_time_s(column, 450.0)
    while road.t_s < line_s - 0.3 * WEAVING.timing.move_s:
        road.step()
    controller.store.assign_cell((column, 0))
    controller.motion = CurrentMotion(controller.hold_cell)
    controller.hold_cell = (column, 0)
    road.step()
    assert (MISSED_EXIT, vehicle.name) in [(kind, name) for _, kind, name in road.events]
    run(road, owners_checked=False)
    assert road.exits[vehicle.name] == "lane-1"


def test_a_body_between_two_lanes_stops_before_they_part() -> None:
    vehicle = vehicle_in((0, 1), "A", WEAVING)
    controller = vehicle.controller
    half_m = WEAVING.road.lane_width_m
    place(controller, (460.0, 12.0, 0.0, half_m, 0.0, 0.0))
    controller.hold_cell = (0, 0)
    tick = round(WEAVING.lattice.passing_time_s(0, 460.0) / WEAVING.runtime.tick_s)
    for step in range(100):
        s_m, speed_mps, accel_mps2, *_ = controller.plant.state
        place(controller, (s_m, speed_mps, accel_mps2, half_m, 0.0, 0.0))
        controller.step(tick + step)
    assert controller.plant.state[1] < 0.1
    assert controller.plant.state[0] < 500.0


def test_exits_tell_who_has_left() -> None:
    exits = Exits(WEAVING.geometry.sections, WEAVING.road.length_m)
    assert exits.left_by(0, 499.9) is None
    section = exits.left_by(0, 500.0)
    assert section is not None
    assert (section.exit, section.to_m) == ("off", 500.0)
    assert exits.left_by(1, 999.9) is None
    last = exits.left_by(1, 1000.0)
    assert last is not None
    assert last.exit == "lane-1"
