"""Several ramps into one lane, and ramps into a lane that is open at the start of the road."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from attrs import evolve

from laneweave.launch.faults.fault_file import FaultSpec
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.runtime.message_faults import MessageRule
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.demand import Arrival, arrivals
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.closed_lanes import LonelyRoad
from support.road_vehicles import vehicle_in

RAMPS_M = 520.0, 1320.0
EXITS_M = 500.0, 1300.0


def tables(*, open_at_start: bool = False) -> dict[str, Any]:
    """Return a road of four lanes; lane 0 has two exits, each with an on-ramp behind it."""
    first = [] if open_at_start else [{"lane": 0, "to_m": 250.0}]
    ramps = [
        {
            "name": f"on{number}",
            "lane": 0,
            "at_m": at_m,
            "merge_m": at_m + 170.0,
            "volume_veh_per_h": 500.0,
            "destinations": [{"exit": "off1", "share": 0.3}] if number == 0 else [],
        }
        for number, at_m in enumerate(RAMPS_M)
    ]
    return {
        "road": {
            "lanes": 4,
            "s1_m": 50.0,
            "s2_m": 50.0,
            "s3_m": 2000.0,
            "closures": [
                *first,
                {"lane": 0, "from_m": EXITS_M[0], "to_m": RAMPS_M[0]},
                {"lane": 0, "from_m": 900.0, "to_m": 1050.0},
                {"lane": 0, "from_m": EXITS_M[1], "to_m": RAMPS_M[1]},
                {"lane": 0, "from_m": 1700.0},
            ],
        },
        "entrance": ramps[::-1],
        "exit": [
            {"name": f"off{number}", "lanes": [0], "at_m": at_m}
            for number, at_m in enumerate(EXITS_M)
        ],
        "demand": {
            "volume_veh_per_lane_h": 900.0,
            "duration_s": 60.0,
            "destinations": [{"exit": "off0", "share": 0.15}, {"exit": "off1", "share": 0.15}],
        },
        "formation": {"operation": "rolling", "change_columns": False},
    }


INTERCHANGES = parse_scenario(tables())
OPEN = parse_scenario(tables(open_at_start=True))


def test_the_first_entry_points_have_the_numbers_of_their_lanes() -> None:
    found = [(one.lane, one.entrance) for one in INTERCHANGES.geometry.entry_points]
    main = [(lane, "main") for lane in (1, 2, 3)]
    assert found == [(0, "on0"), *main, (0, "on1")]
    found = [(one.lane, one.entrance) for one in OPEN.geometry.entry_points]
    assert found == [(0, "main"), *main, (0, "on0"), (0, "on1")]


def test_drawn_vehicles_arrive_at_each_entry_point() -> None:
    stream = arrivals(INTERCHANGES)
    assert {one.entry_point for one in stream} == {0, 1, 2, 3, 4}
    assert {one.lane for one in stream if one.entry_point == 4} == {0}
    assert {one.destination for one in stream if one.entry_point == 4} == {END_OF_ROAD}
    assert {one.destination for one in stream if one.entry_point == 0} == {"off1", END_OF_ROAD}


@pytest.mark.parametrize(
    ("number", "at_m", "message"),
    [
        (0, RAMPS_M[0], r"entrance\[1\].at_m: got 520.0; allowed: a position without another"),
        (1, 400.0, r"entrance\[1\].at_m: got 400.0; allowed: 250 or 520 or 1050 or 1320, where"),
    ],
)
def test_each_ramp_has_a_place_of_its_own(number: int, at_m: float, message: str) -> None:
    data = tables()
    data["entrance"][number] |= {"at_m": at_m, "merge_m": at_m + 170.0}
    with pytest.raises(BadInputError, match=message):
        parse_scenario(data)


def assert_single_owners(road: LonelyRoad) -> None:
    owned = [cell for vehicle in road.vehicles.values() for cell in vehicle.controller.record.owned]
    assert len(owned) == len({*owned}), road.t_s


@pytest.mark.parametrize("scenario", [INTERCHANGES, OPEN], ids=["closed", "open"])
def test_no_cell_has_two_owners(scenario: Scenario) -> None:
    road = LonelyRoad(scenario)
    while road.t_s < 145.0:
        road.step()
        assert_single_owners(road)
    assert road.left


def wide_tables(
    closures: list[tuple[int, float, float]], ramps: list[tuple[int, float]], exits: list[int]
) -> dict[str, Any]:
    """Return a road of five lanes with one exit, at the first end of the lanes in `exits`."""
    exit_m = min(from_m for lane, from_m, _ in closures if lane in exits and from_m)
    leaving = [{"exit": "off", "share": 0.3}]
    return {
        "road": {
            "lanes": 5,
            "s1_m": 50.0,
            "s2_m": 50.0,
            "s3_m": 2000.0,
            "closures": [{"lane": a, "from_m": b, "to_m": c} for a, b, c in closures],
        },
        "entrance": [
            {
                "name": f"on{number}",
                "lane": lane,
                "at_m": at_m,
                "merge_m": at_m + 170.0,
                "volume_veh_per_h": 1300.0,
                "destinations": leaving if at_m < exit_m else [],
            }
            for number, (lane, at_m) in enumerate(ramps)
        ],
        "exit": [{"name": "off", "lanes": exits, "at_m": exit_m}],
        "demand": {
            "volume_veh_per_lane_h": 500.0,
            "duration_s": 80.0,
            "destinations": leaving,
        },
        "formation": {"operation": "rolling", "change_columns": False},
    }


END_M = 60_000.0
WIDE = {
    "two-lane exit, then two-lane ramp": wide_tables(
        [(0, 500.0, 520.0), (1, 500.0, 520.0)], [(0, 520.0), (1, 520.0)], [0, 1]
    ),
    "ramps on both sides": wide_tables(
        [(0, 500.0, 520.0), (4, 0.0, 700.0)], [(0, 520.0), (4, 700.0)], [0]
    ),
    "two-lane ramp before a two-lane exit": wide_tables(
        [
            *((lane, 0.0, 250.0) for lane in (0, 1)),
            *((lane, 900.0, 920.0) for lane in (0, 1)),
        ],
        [(lane, at_m) for at_m in (250.0, 920.0) for lane in (0, 1)],
        [0, 1],
    ),
    "a lane that ends beside a shared one": wide_tables(
        [(0, 500.0, 520.0), (1, 500.0, 520.0), (0, 900.0, END_M)], [(0, 520.0), (1, 520.0)], [0, 1]
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.more if number else ())
        for number, name in enumerate(WIDE)
    ],
)
def test_no_cell_has_two_owners_on_wide_ramps_and_exits(name: str) -> None:
    road = LonelyRoad(parse_scenario(WIDE[name]))
    while road.t_s < 100.0:
        road.step()
        assert_single_owners(road)
        owned = [
            cell for one in road.vehicles.values() for cell in one.controller.store.possible_cells
        ]
        assert not any(map(road.roadside.is_kept_free, owned))
    assert len(road.vehicles) + len(road.left) > 50


def enter(
    scenario: Scenario, arrival: Arrival, *vehicles: RoadVehicle, left: bool = False
) -> Admission:
    """Return the entry of a vehicle, while others are on the road or have left it."""
    roadside = Roadside(scenario, stream=(arrival,))
    on_road = {one.name: one for one in vehicles}
    if left:
        for one in vehicles:
            del on_road[one.name]
            roadside.on_left(one, on_road, arrival.t_s - 1.0)
    tick = round(10.0 * arrival.t_s) - 10
    while not (found := roadside.admit(0.1 * tick, on_road)):
        tick += 1
        assert tick < 3000
    return found[0]


def test_a_cell_of_a_vehicle_from_the_first_ramp_is_not_entered_at_the_second() -> None:
    second = Arrival("r", 0, ANY_LANE, 60.0, entry_point=4)
    column, lane = enter(INTERCHANGES, second).cell
    assert lane == 0
    first = vehicle_in((column, 0), "A", INTERCHANGES)
    assert enter(INTERCHANGES, second, first).cell == (column - 1, 0)
    assert enter(INTERCHANGES, second, first, left=True).cell == (column, 0)


def test_a_cell_passes_from_one_leaving_vehicle_to_the_next_of_its_column() -> None:
    """Both leave by lane 0, one after the other."""
    road = LonelyRoad(INTERCHANGES)
    stream = [
        Arrival("a", 1, ANY_LANE, 10.0, "off0"),
        Arrival("b", 2, ANY_LANE, 10.0, "off1"),
    ]
    road.roadside = Roadside(INTERCHANGES, stream, bridge=1)
    while road.t_s < 12.0:
        road.step()
    first, second = (road.vehicles[Name(name)] for name in "ab")
    column = first.admission.cell[0]
    assert second.admission.cell == (column, 2)
    assert (column, 0) in first.controller.record.owned
    assert (column, 0) not in second.controller.record.owned
    road.roadside.on_left(first, {second.name: second}, 40.0)
    assert (column, 0) in second.controller.record.owned


@pytest.mark.parametrize(("right", "left"), [("off0", "off1"), ("off1", "off0")])
def test_who_leaves_first_enters_on_the_right_of_its_column(right: str, left: str) -> None:
    stream = [Arrival("a", 1, ANY_LANE, 10.0, right), Arrival("b", 2, ANY_LANE, 10.0, left)]
    roadside = Roadside(INTERCHANGES, stream)
    found = [one.cell for tick in range(90, 150) for one in roadside.admit(0.1 * tick)]
    assert len(found) == 2
    assert (len({column for column, _ in found}) == 1) == (right == "off0")


def test_empty_cells_of_a_lane_before_its_ramps_belong_to_those_who_leave_there() -> None:
    stream = [
        Arrival("x", 1, ANY_LANE, 10.0, "off0"),
        *(Arrival(f"m{number}", 1, ANY_LANE, 11.0 + number) for number in range(6)),
    ]
    road = LonelyRoad(OPEN)
    road.roadside = Roadside(OPEN, stream, bridge=1)
    while road.t_s < 22.0:
        road.step()
    owned = {
        (one.name, cell[0] - one.admission.cell[0])
        for one in road.vehicles.values()
        for cell in one.controller.record.owned
        if cell[1] == 0
    }
    assert owned == {("x", 0)}


@pytest.mark.more
@pytest.mark.parametrize(
    ("scenario", "loss"), [(INTERCHANGES, 0.3), (OPEN, 0.0)], ids=["loss", "open"]
)
def test_all_leave_at_their_destinations(tmp_path: Path, scenario: Scenario, loss: float) -> None:
    scenario = evolve(scenario, demand=evolve(scenario.demand, duration_s=25.0))
    faults = FaultSpec(messages=(MessageRule(loss=loss),)) if loss else FaultSpec()
    outcome = SimulatedRun(scenario, tmp_path / "run", faults, show_progress=False).run()
    assert outcome.summary is not None
    vehicles, safety = outcome.summary.vehicles, outcome.summary.safety
    assert (vehicles.left, safety.overlaps) == (vehicles.entered, 0)
    assert vehicles.missed_exits is not None
    assert vehicles.missed_exits <= (0.02 * vehicles.entered if loss else 0)
