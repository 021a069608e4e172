"""A ramp that follows an exit in the same lane: its cells have one owner at a time."""

from __future__ import annotations

from typing import Any

import pytest

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.vehicle.lane_ends import dead_ends
from laneweave.protocol.vehicle.motion import State, cell_state
from laneweave.protocol.wire.messages import Ballot, Name, PendingTransfer
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody, Pose, pose_of
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.bodies.sensors import Sensors
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from laneweave.sim_bridge.world_interface import show_bodies
from support.closed_lanes import LonelyRoad
from support.road_vehicles import vehicle_in

EXIT_M, RAMP_M = 500.0, 520.0
BALLOT = Ballot(1, Name("c"), 1, 1)


def tables(**formation: object) -> dict[str, Any]:
    """Return four lanes; lane 0 opens at 300 m for an exit, and at 520 m for a ramp."""
    return {
        "road": {
            "lanes": 4,
            "s1_m": 50.0,
            "s2_m": 100.0,
            "s3_m": 850.0,
            "closures": [
                {"lane": 0, "to_m": 300.0},
                {"lane": 0, "from_m": EXIT_M, "to_m": RAMP_M},
                {"lane": 0, "from_m": 900.0},
            ],
        },
        "entrance": [
            {"name": "on", "lane": 0, "at_m": RAMP_M, "merge_m": 690.0, "volume_veh_per_h": 600.0}
        ],
        "exit": [{"name": "off", "lanes": [0], "at_m": EXIT_M}],
        "demand": {
            "volume_veh_per_lane_h": 900.0,
            "duration_s": 60.0,
            "destinations": [{"exit": "off", "share": 0.3}],
        },
        "formation": {"operation": "rolling", "change_columns": False, **formation},
    }


INTERCHANGE = parse_scenario(tables())
LATTICE = INTERCHANGE.lattice


def test_such_a_road_needs_vehicles_that_keep_their_columns() -> None:
    assert INTERCHANGE.geometry.shared_lanes == {0}
    with pytest.raises(BadInputError, match=r"entrance\[0\].at_m: got 520.0; allowed: 300"):
        parse_scenario(tables(change_columns=True))


def test_the_bodies_of_leaving_and_entering_vehicles_are_apart_on_the_road() -> None:
    data = tables()
    data["road"]["closures"][1]["to_m"] = data["entrance"][0]["at_m"] = 506.0
    with pytest.raises(BadInputError, match=r"opens again, and 507\.5 or more"):
        parse_scenario(data)


def owners_of(road: LonelyRoad) -> dict[Cell, list[Name]]:
    owners: dict[Cell, list[Name]] = {}
    for name, vehicle in road.vehicles.items():
        for cell in vehicle.controller.record.owned:
            owners.setdefault(cell, []).append(name)
    return owners


def drive(road: LonelyRoad) -> None:
    """Drive until nobody is left; no cell ever has two owners."""
    while road.vehicles or not road.roadside.demand.exhausted(road.t_s):
        road.step()
        assert road.t_s < 900.0
        assert all(len(names) == 1 for names in owners_of(road).values())


@pytest.mark.more
def test_no_cell_has_two_owners_and_leaving_vehicles_have_that_of_their_exit() -> None:
    road = LonelyRoad(INTERCHANGE)
    seen = set[Name]()
    while road.t_s < 60.0:
        road.step()
        for name, vehicle in road.vehicles.items():
            column, lane = vehicle.admission.cell
            leaves = vehicle.arrival.destination == "off"
            if name not in seen and lane != 0:
                assert ((column, 0) in vehicle.controller.record.owned) == leaves
            seen.add(name)
        assert all(len(names) == 1 for names in owners_of(road).values())
    drive(road)
    # Nobody changes lanes without an agent, so all exits were missed and those cells never freed.
    assert set(road.exits.values()) == {"lane-1", "lane-2", "lane-3"}


def test_empty_cells_belong_to_vehicles_of_their_column() -> None:
    """If there is one: nobody else needs them."""
    stream = tuple(
        Arrival(f"v{number}", 1 + number % 3, ANY_LANE, 5.0 + 1.2 * number) for number in range(20)
    )
    road = LonelyRoad(INTERCHANGE)
    road.roadside = Roadside(INTERCHANGE, bridge=1, stream=stream)
    while road.t_s < 26.0:
        road.step()
    columns = {name: vehicle.admission.cell[0] for name, vehicle in road.vehicles.items()}
    owned = [(cell, name) for cell, names in owners_of(road).items() for name in names]
    shared = [(cell, name) for cell, name in owned if cell[0] in columns.values()]
    assert len(shared) > len(columns)
    assert all(columns[name] == cell[0] for cell, name in shared)
    assert {cell[0] for cell, _ in owned} > {*columns.values()}


def admitted_columns(vehicle: RoadVehicle | None, *, left: bool = False) -> list[int]:
    """Return the columns of three vehicles from the ramp, one after another."""
    stream = tuple(Arrival(f"r{number}", 0, ANY_LANE, 20.0 + number) for number in range(3))
    roadside = Roadside(INTERCHANGE, stream=stream)
    vehicles = {} if vehicle is None else {vehicle.name: vehicle}
    if vehicle is not None and left:
        roadside.on_left(vehicle, {}, 15.0)
        vehicles = {}
    columns = []
    for tick in range(180, 300):
        columns += [one.cell[0] for one in roadside.admit(0.1 * tick, vehicles)]
    return columns


def test_a_cell_that_a_vehicle_may_own_is_not_entered_from_the_ramp() -> None:
    first, *_ = free = admitted_columns(None)
    assert free == [first, first - 1, first - 2]
    owner = vehicle_in((first, 1), "A", INTERCHANGE)
    assert admitted_columns(owner) == free
    owner.controller.store.assign_cell((first, 0))
    assert admitted_columns(owner) == [first - 1, first - 2, first - 3]
    # The owner has left by the exit: the cell is free again.
    assert admitted_columns(owner, left=True) == free


@pytest.mark.parametrize("before", [True, False])
def test_a_cell_of_an_undecided_transfer_is_not_entered(*, before: bool) -> None:
    first, *_ = admitted_columns(None)
    vehicle = vehicle_in((first + 3, 1), "A", INTERCHANGE)
    cell, own = (first, 0), (first + 3, 1)
    both, one = (cell, own), (own,)
    transfer = PendingTransfer(
        BALLOT, both if before else one, one if before else both, (Name("A"), Name("B"))
    )
    vehicle.controller.store.store_promise(BALLOT)
    vehicle.controller.store.begin_transfer(transfer)
    later = [first - 1, first - 2, first - 3]
    assert admitted_columns(vehicle) == later
    # Nobody knows the outcome when it has left: another vehicle may get the cell.
    assert admitted_columns(vehicle, left=True) == later


def test_cells_given_up_at_the_end_of_a_lane_may_still_be_transferred() -> None:
    first, *_ = admitted_columns(None)
    vehicle = vehicle_in((first, 1), "A", INTERCHANGE)
    vehicle.controller.store.assign_cell((first, 0))
    vehicle.controller.leave_lattice()
    assert vehicle.controller.record.owned == ()
    assert admitted_columns(vehicle) == [first - 1, first - 2, first - 3]


def test_vehicles_from_a_ramp_get_cells_that_never_had_an_owner() -> None:
    """Nobody is near the first columns at the start of the road."""
    stream = (Arrival("r", 0, ANY_LANE, 2.0),)
    roadside = Roadside(INTERCHANGE, stream=stream)
    admissions = [one for tick in range(60) for one in roadside.admit(0.1 * tick)]
    (admission,) = admissions
    column = admission.cell[0]
    assert set(admission.more_cells) == {(column, lane) for lane in (1, 2, 3)}


def test_a_vehicle_enters_after_those_of_its_column_that_leave_before() -> None:
    """The order of lanes in which vehicles of a column leave counts only those still there."""
    main = [Arrival(f"m{lane}", lane, ANY_LANE, 10.0) for lane in (2, 3)]
    leaving = Arrival("x", 1, ANY_LANE, 10.0, "off")
    roadside = Roadside(INTERCHANGE, stream=(*main, leaving))
    admissions = [one for tick in range(95, 130) for one in roadside.admit(0.1 * tick)]
    assert len({one.cell[0] for one in admissions}) == 1
    column = admissions[0].cell[0]
    meter = roadside._meter
    on_ramp = Arrival("r", 0, ANY_LANE, 40.0)
    assert meter.is_possible(on_ramp, column)
    # With another one in lane 1 there would be no lane left.
    later = min(meter.next_open(lane, 13.0) for lane in (1, 2, 3))
    for lane in (1, 2, 3):
        assert meter.is_possible(on_ramp, later)
        assert meter.take(Arrival(f"z{lane}", lane, ANY_LANE, 13.0), later)
        assert not meter.take(Arrival(f"late{lane}", lane, ANY_LANE, 13.0), later)
    assert not meter.is_possible(on_ramp, later)


def test_a_vehicle_that_stands_before_the_exit_does_not_wait_at_the_end_of_the_ramp() -> None:
    (end,) = dead_ends(INTERCHANGE)
    vehicle = vehicle_in((0, 0), "A", INTERCHANGE)
    passed_s = LATTICE.passing_time_s(0, end.line_m) + 1.0
    for s_m, lost in ((EXIT_M - 5.0, False), (RAMP_M + 50.0, True)):
        state = (s_m, 0.0, 0.0, LATTICE.cell_y_m(0), 0.0, 0.0)
        vehicle.controller.plant = Plant(state, INTERCHANGE.vehicle, INTERCHANGE.runtime.tick_s)
        assert vehicle.controller.has_lost_cell(passed_s) == lost


class Standing:
    """A world that shows bodies where they are, and one behind the exit."""

    def __init__(self, rear_m: float) -> None:
        """Let a body stand with its rear there."""
        self.at: dict[str, Pose] = {}
        self.body = OtherBody("other", 0, EXIT_M, rear_m, 5.0, 0.0, 0.0)

    def place(self, vehicle: str, state: State) -> None:
        self.at[vehicle] = pose_of(state)

    def step(self) -> None:
        """Do nothing."""

    def positions(self) -> dict[str, Pose]:
        return self.at

    def others(self) -> list[OtherBody]:
        return [self.body]

    def collisions(self) -> list[tuple[str, str]]:
        return []


class Overlaps:
    """A record that keeps the overlaps."""

    def on_positions(self, t_s: float, vehicles: object, **measured: Any) -> None:  # noqa: ANN401
        del t_s, vehicles
        self.pairs = measured["overlaps"]


@pytest.mark.parametrize(("rear_m", "touches"), [(EXIT_M + 3.0, False), (EXIT_M - 11.0, True)])
def test_a_vehicle_before_the_exit_sees_what_is_behind_it_and_no_vehicle_on_the_ramp(
    rear_m: float, *, touches: bool
) -> None:
    leaving, other, entering = (
        vehicle_in((column, lane), name, INTERCHANGE)
        for column, lane, name in ((0, 0, "A"), (0, 1, "B"), (3, 0, "C"))
    )
    t_s = LATTICE.passing_time_s(0, EXIT_M - 10.0)
    for each in (leaving, other, entering):
        rest = cell_state(LATTICE, each.cell, t_s)
        each.controller.plant = Plant(rest, INTERCHANGE.vehicle, INTERCHANGE.runtime.tick_s)
        each.sensors = Sensors(INTERCHANGE, each.name)
    vehicles = {each.name: each for each in (leaving, other, entering)}
    record = Overlaps()
    show_bodies(Standing(rear_m), vehicles, INTERCHANGE, record, t_s)  # type: ignore[arg-type]
    ahead = {one.lane: one for one in leaving.controller.neighbours.ahead}
    # C is 45 m ahead in the same lane, but on the ramp; the body that stands is much nearer.
    assert ahead[0].gap_m == pytest.approx(rear_m - (EXIT_M - 10.0), abs=0.5)
    assert ahead[0].speed_mps == pytest.approx(0.0, abs=0.3)
    assert 0 in {one.lane for one in other.controller.neighbours.ahead}
    assert record.pairs == ([("A", "other")] if touches else [])


@pytest.mark.parametrize(
    ("rear_m", "ahead_m", "behind_m", "touches"),
    [
        (-4.0, -4.0, None, True),  # beside it, its front ahead
        (-8.0, None, -2.0, True),  # beside it, its front behind
        (-40.0, None, 30.0, False),
    ],
)
def test_bodies_that_sumo_drives_beside_and_behind_are_neighbours(
    rear_m: float, ahead_m: float | None, behind_m: float | None, *, touches: bool
) -> None:
    """Distances are from the front of the vehicle, which is 5 m long, as the body is."""
    own = vehicle_in((0, 0), "A", INTERCHANGE)
    t_s = LATTICE.passing_time_s(0, EXIT_M - 100.0)
    rest = cell_state(LATTICE, own.cell, t_s)
    own.controller.plant = Plant(rest, INTERCHANGE.vehicle, INTERCHANGE.runtime.tick_s)
    own.sensors = Sensors(INTERCHANGE, own.name)
    record = Overlaps()
    world = Standing(rest[0] + rear_m)
    show_bodies(world, {own.name: own}, INTERCHANGE, record, t_s)  # type: ignore[arg-type]
    for side, gap_m in zip(own.controller.neighbours, (ahead_m, behind_m), strict=True):
        found = [one.gap_m for one in side if one.lane == 0]
        assert found == ([] if gap_m is None else [pytest.approx(gap_m, abs=0.5)])
    assert record.pairs == ([("A", "other")] if touches else [])
