"""Which vehicles of a SUMO simulation drive through a corridor, and when."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from attrs import evolve

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.sim_bridge.corridors.corridor_setup import FIRST_ENTRY_S, CorridorArrival, setup_of
from laneweave.sim_bridge.corridors.scenario_tables import scenario_tables
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor, corridor_in, read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import SumoVehicle, TimeWindow
from laneweave.sim_bridge.sumo.simulation import SumoFailedError
from support.interchange import CORRIDOR, TRUCKS, stream, vehicle, write_interchange


def corridor(folder: Path, *vehicles: str) -> SumoCorridor:
    return read_corridor(write_interchange(folder, vehicles, types=TRUCKS), CORRIDOR)


def arrivals_of(found: SumoCorridor, scenario: Scenario) -> tuple[CorridorArrival, ...]:
    return setup_of(found, scenario).arrivals


def written(folder: Path) -> set[str]:
    """Return the names of the vehicles in the file of routes of a run."""
    root = ET.parse(folder / "vehicles.rou.xml").getroot()  # noqa: S314 (its own file)
    return {one.attrib["id"] for one in root.iter("vehicle")}


def test_vehicles_have_their_entrance_destination_and_departure(tmp_path: Path) -> None:
    found = corridor(
        tmp_path,
        vehicle("a#1", 0.0, "main"),
        vehicle("b:2", 2.5, "exit", "truck"),
        vehicle("c.3", 250.25, "ramp"),
    )
    passes = [
        (one.vehicle.name, one.vehicle.depart_s, one.entrance, one.destination)
        for one in found.passes
    ]
    assert passes == [
        ("a#1", 0.0, MAIN_ENTRANCE, END_OF_ROAD),
        ("b:2", 2.5, MAIN_ENTRANCE, "off"),
        ("c.3", 250.25, "on", END_OF_ROAD),
    ]
    assert found.passes[1].vehicle.type_name == "truck"


def test_vehicles_that_start_inside_are_left_out_and_listed(tmp_path: Path) -> None:
    after_the_end = vehicle("c", 300.5, "main")
    inside = vehicle("b", 1.0, "inside")
    found = corridor(tmp_path, inside, vehicle("a", 299.0, "main"), after_the_end)
    assert [one.vehicle.name for one in found.passes] == ["a"]
    assert found.missing == {"start on main3": 1}
    setup = setup_of(found, parse_scenario(scenario_tables(found)))
    setup.drive_alone(tmp_path, tmp_path)
    assert written(tmp_path) == {"a"}


def test_vehicles_come_from_upstream_but_not_twice(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, [vehicle("a", 0.0, "main"), vehicle("r", 1.0, "ramp")])
    found = read_corridor(config, "main3:main5")
    assert {one.vehicle.name: one.upstream for one in found.passes} == {
        "a": "main2",
        "r": "",
    }
    kind = found.passes[0].vehicle.vehicle_type
    twice = ("main1", "main2", "off", "before", "on", "main4", "main5")
    again = SumoVehicle("x", 0.0, twice, kind, "passenger")
    own = corridor(tmp_path, vehicle("a", 0.0, "main")).simulation
    missing = corridor_in(evolve(own, vehicles=(again,)), "main1", "main5").missing
    assert missing == {"drive through it twice": 1}


def test_flows_are_vehicles_as_sumo_makes_them(tmp_path: Path) -> None:
    flow = (
        '<flow id="f" type="car" begin="10" period="20" number="4" departSpeed="max">'
        '<route edges="main1 main2 main3 main4 main5"/></flow>'
    )
    found = corridor(tmp_path, flow)
    departures = {one.vehicle.name: one.vehicle.depart_s for one in found.passes}
    assert departures == {f"f.{number}": 10.0 + 20.0 * number for number in range(4)}


def test_drivers_keep_the_speed_factors_that_sumo_has_drawn(tmp_path: Path) -> None:
    """Those of a type without deviation, and drawn ones, which differ."""
    slow = '<vType id="slow" speedFactor="0.8" speedDev="0"/>'
    vehicles = [vehicle("a", 0.0, "main", "slow"), vehicle("b", 1.0, "main", "slow")]
    vehicles += [vehicle(f"c{number}", 2.0 + number, "main") for number in range(4)]
    config = write_interchange(tmp_path, vehicles, types=slow)
    found = read_corridor(config, CORRIDOR)
    factors = {one.vehicle.name: one.vehicle.speed_factor for one in found.passes}
    assert (factors["a"], factors["b"]) == (0.8, 0.8)
    assert len({factors[f"c{number}"] for number in range(4)}) == 4
    setup_of(found, parse_scenario(scenario_tables(found))).drive_alone(tmp_path, tmp_path)
    root = ET.parse(tmp_path / "vehicles.rou.xml").getroot()  # noqa: S314 (its own file)
    alone = {one.attrib["id"]: float(one.attrib["speedFactor"]) for one in root.iter("vehicle")}
    assert alone == factors


def test_a_begin_with_many_digits_is_not_rounded(tmp_path: Path) -> None:
    begin_s = 1_234_565.0
    vehicles = [vehicle(f"v{number}", begin_s - 5.0 + number, "main") for number in range(10)]
    config = write_interchange(tmp_path, vehicles)
    config.write_text(config.read_text(encoding="utf-8").replace('value="300"', 'value="2e6"'))
    found = read_corridor(config, CORRIDOR, TimeWindow(begin_s=begin_s, duration_s=20.0))
    assert found.simulation.begin_s == begin_s
    assert min(one.vehicle.depart_s for one in found.passes) >= begin_s


def test_arrivals_have_names_of_laneweave_and_lanes_that_suit_them(
    interchange: SumoCorridor, scenario: Scenario
) -> None:
    arrivals = arrivals_of(interchange, scenario)
    assert [one.arrival.vehicle for one in arrivals[:2]] == ["v0001", "v0002"]
    assert {one.arrival.lane for one in arrivals if one.origin.entrance == "on"} == {0}
    # The lane next to the exit for those that leave, and all lanes for the others.
    main = [one.arrival for one in arrivals if one.origin.departs_at_start]
    assert {one.lane for one in main if one.destination == "off"} == {1}
    assert {one.lane for one in main if one.destination == END_OF_ROAD} == {2, 3}
    assert {one.vehicle_type for one in main} == {"car", "truck"}
    assert [one.t_s for one in main] == sorted(one.t_s for one in main)
    assert main[0].t_s == FIRST_ENTRY_S
    names = {one.sumo_id for one in main}
    assert names == {f"m#{second}" for second in range(60)}


def test_vehicles_that_depart_together_arrive_in_different_lanes(tmp_path: Path) -> None:
    found = corridor(tmp_path, *(vehicle(f"m{n}", 10.0, "main") for n in range(4)))
    scenario = parse_scenario(scenario_tables(found))
    lanes = [one.arrival.lane for one in arrivals_of(found, scenario)]
    assert lanes == [3, 2, 1, 3]


def test_what_sumo_refuses_is_one_line(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, ['<vehicle id="x" type="none" depart="0"/>'])
    with pytest.raises(SumoFailedError) as caught:
        read_corridor(config, CORRIDOR)
    assert "\n" not in str(caught.value)


def test_a_shorter_demand_is_the_beginning_of_the_whole(tmp_path: Path) -> None:
    vehicles = [vehicle(f"m{n}", 2.0 * n, "main") for n in range(10)]
    config = write_interchange(tmp_path, vehicles)
    whole = read_corridor(config, CORRIDOR)
    part = read_corridor(config, CORRIDOR, TimeWindow(duration_s=7.0))
    assert part.passes == whole.passes[:4]
    assert part.simulation.end_s == 7.0


def test_the_time_window_and_the_scale_are_those_of_sumo(tmp_path: Path) -> None:
    flow = (
        '<flow id="f" type="car" begin="0" end="120" vehsPerHour="1200" departLane="free">'
        '<route edges="main1 main2 main3 main4 main5"/></flow>'
    )
    config = write_interchange(tmp_path, [flow])
    later = read_corridor(config, CORRIDOR, TimeWindow(begin_s=60.0, end_s=90.0)).passes
    assert all(60.0 <= one.vehicle.depart_s < 90.0 for one in later)
    assert len(later) == 10
    twice = read_corridor(config, CORRIDOR, TimeWindow(scale=2.0)).passes
    assert len(twice) == 2 * len(read_corridor(config, CORRIDOR).passes) == 80


def test_a_window_without_departures_names_the_first_one(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, [vehicle("a", 250.0, "main")])
    with pytest.raises(BadInputError, match="the first one departs at 250 s: --begin 250"):
        read_corridor(config, CORRIDOR, TimeWindow(duration_s=60.0))
    assert read_corridor(config, CORRIDOR, TimeWindow(begin_s=250.0)).passes
    config = write_interchange(tmp_path)
    with pytest.raises(BadInputError, match="0 s to 300 s; allowed: a time in which vehicles"):
        read_corridor(config, CORRIDOR)


def test_trips_get_the_routes_that_sumo_chooses(tmp_path: Path) -> None:
    trips = [
        '<trip id="a" type="car" depart="0" from="main1" to="main5"/>',
        '<trip id="b" type="car" depart="1" from="before" to="main5"/>',
        '<trip id="c" type="car" depart="2" from="start" to="off" via="main1"/>',
    ]
    passes = corridor(tmp_path, *trips).passes
    assert {one.vehicle.name: (one.upstream, one.entrance, one.destination) for one in passes} == {
        "a": ("", MAIN_ENTRANCE, END_OF_ROAD),
        "b": ("", "on", END_OF_ROAD),
        "c": ("start", MAIN_ENTRANCE, "off"),
    }


def test_vehicles_that_cannot_depart_in_time_are_not_forgotten(tmp_path: Path) -> None:
    """SUMO reports routes of those that have departed; others wait behind them."""
    trips = (
        f'<trip id="t{n}" type="car" depart="{n / 10}" from="main1" to="main5" departLane="0"/>'
        for n in range(50)
    )
    passes = corridor(tmp_path, *trips, vehicle("end", 6.0, "main")).passes
    assert [one.vehicle.name for one in passes] == [*(f"t{n}" for n in range(50)), "end"]
    short = read_corridor(tmp_path / "small.sumocfg", CORRIDOR, TimeWindow(duration_s=5.5)).passes
    assert short == passes[:50]


WAITING = """
    <vehicle id="{depart}" type="car" depart="{depart}">
    <route edges="main1 main2 main3 main4 main5"/></vehicle>"""


@pytest.mark.parametrize("depart", ["triggered", "containerTriggered"])
def test_vehicles_that_wait_for_passengers_are_left_out(tmp_path: Path, depart: str) -> None:
    never, later = WAITING.format(depart=depart), '<person id="p" depart="5">'
    ride = f'{later}<ride from="main1" to="main5" lines="triggered"/></person>'
    found = corridor(tmp_path, never, vehicle("a", 0.0, "main"), ride)
    assert [one.vehicle.name for one in found.passes] == ["a"]
    assert found.missing == {"wait for passengers": 1}


def test_a_departure_at_the_begin_is_one(tmp_path: Path) -> None:
    begin = WAITING.format(depart="begin")
    found = corridor(tmp_path, begin, vehicle("a", 3.0, "main"))
    assert {one.vehicle.name: one.vehicle.depart_s for one in found.passes} == {
        "begin": 0.0,
        "a": 3.0,
    }


def test_a_stop_in_which_the_demand_ends_is_one_stop(tmp_path: Path) -> None:
    stops = "".join(f'<stop lane="off_0" endPos="{at_m}" duration="60"/>' for at_m in (100, 200))
    bus = f'<vehicle id="bus" type="car" depart="0"><route edges="off"/>{stops}</vehicle>'
    config = write_interchange(tmp_path, [bus, vehicle("a", 1.0, "main")])
    simulation = read_corridor(config, CORRIDOR, TimeWindow(end_s=40.0)).simulation
    found = next(one for one in simulation.vehicles if one.name == "bus")
    assert [float(stop["endPos"]) for stop in found.stops] == [100.0, 200.0]


def test_vehicles_with_stops_are_left_out_of_the_corridor_only(tmp_path: Path) -> None:
    bus = (
        '<vehicle id="bus" type="car" depart="0"><route edges="main1 main2 main3 main4 main5"/>'
        '<stop lane="main2_1" endPos="100" duration="5"/></vehicle>'
    )
    elsewhere = (
        '<vehicle id="waits" type="car" depart="0"><route edges="before"/>'
        '<stop lane="before_0" endPos="100" triggered="true"/></vehicle>'
    )
    found = corridor(tmp_path, bus, elsewhere, vehicle("a", 0.0, "main"))
    assert found.missing == {"stop on their way": 1}
    setup = setup_of(found, parse_scenario(scenario_tables(found)))
    setup.drive_alone(tmp_path, tmp_path)
    assert written(tmp_path) == {"waits", "a"}
    setup.command(tmp_path, None, {})
    assert written(tmp_path) == {"waits"}


def test_names_in_scenarios_are_unique(tmp_path: Path) -> None:
    """Also where names of edges differ in characters that scenarios do not allow."""
    config = write_interchange(tmp_path, stream(30), types=TRUCKS)
    for file in tmp_path.glob("small.*"):
        text = file.read_text(encoding="utf-8")
        text = re.sub(r"(?<=[\" ])on(?=[\" _])", "main", text)
        file.write_text(re.sub(r"(?<=[\" ])off(?=[\" _])", "-main", text), encoding="utf-8")
    found = read_corridor(config, CORRIDOR)
    (ramp,), (exit_,) = found.corridor.ramps, found.corridor.ways_out
    assert (ramp.edge, exit_.edge) == ("main", "-main")
    assert len({ramp.name, exit_.name, MAIN_ENTRANCE, END_OF_ROAD}) == 4
    assert parse_scenario(scenario_tables(found))


def test_types_are_found_by_their_limits(tmp_path: Path) -> None:
    """The most frequent type is the car; which one it is depends on the time window."""
    vehicles = [vehicle(f"t{n}", n, "main", "truck") for n in range(4)]
    vehicles += [vehicle(f"c{n}", 10.0 + n, "main") for n in range(9)]
    config = write_interchange(tmp_path, vehicles, types=TRUCKS)
    whole = read_corridor(config, CORRIDOR)
    scenario = parse_scenario(scenario_tables(whole))
    part = read_corridor(config, CORRIDOR, TimeWindow(duration_s=11.0))
    kinds = {
        one.arrival.sumo_id: one.arrival.vehicle_type for one in setup_of(part, scenario).arrivals
    }
    assert kinds == {"t0": "truck", "t1": "truck", "t2": "truck", "t3": "truck", "c0": "car"}
