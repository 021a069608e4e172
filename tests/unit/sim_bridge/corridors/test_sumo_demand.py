"""Which vehicles of a SUMO simulation drive through a corridor, and when."""

from __future__ import annotations

from pathlib import Path

import pytest
from attrs import evolve

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import MAIN_ENTRANCE
from laneweave.sim_bridge.corridors.corridor_arrivals import (
    FIRST_ENTRY_S,
    corridor_arrivals,
    main_stream,
)
from laneweave.sim_bridge.corridors.corridor_setup import SumoCorridor, read_corridor
from laneweave.sim_bridge.corridors.scenario_tables import scenario_tables
from laneweave.sim_bridge.corridors.sumo_config import read_config
from laneweave.sim_bridge.corridors.sumo_demand import (
    STEP_S,
    SumoDemand,
    SumoVehicle,
    demand_on,
)
from laneweave.sim_bridge.sumo.simulation import SumoFailedError
from support.interchange import CORRIDOR, TRUCKS, stream, vehicle, write_interchange


def corridor(folder: Path, *vehicles: str) -> SumoCorridor:
    return read_corridor(write_interchange(folder, vehicles, types=TRUCKS), CORRIDOR, folder)


def test_vehicles_have_their_entrance_destination_and_departure(tmp_path: Path) -> None:
    found = corridor(
        tmp_path,
        vehicle("a#1", 0.0, "main"),
        vehicle("b:2", 2.5, "exit", "truck"),
        vehicle("c.3", 250.25, "ramp"),
    )
    passes = [
        (one.vehicle.name, one.vehicle.depart_s, one.entrance, one.destination)
        for one in found.demand.passes
    ]
    assert passes == [
        ("a#1", 0.0, MAIN_ENTRANCE, END_OF_ROAD),
        ("b:2", 2.5, MAIN_ENTRANCE, "off"),
        ("c.3", 250.25, "on", END_OF_ROAD),
    ]
    assert found.demand.passes[1].vehicle.type_name == "truck"


def test_vehicles_that_start_inside_are_left_out_and_listed(tmp_path: Path) -> None:
    found = corridor(tmp_path, vehicle("a", 0.0, "main"), vehicle("b", 1.0, "inside"))
    assert [one.vehicle.name for one in found.demand.passes] == ["a"]
    assert found.demand.missing == {"start on main3": 1}
    setup = found.setup(parse_scenario(scenario_tables(found.corridor, found.demand)))
    assert setup.is_left_out("b", ["main3", "main4"])
    assert not setup.is_left_out("a", ["main1"])
    assert not setup.is_left_out("elsewhere", ["before", "off"])


def test_vehicles_come_from_upstream_but_not_twice(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, [vehicle("a", 0.0, "main"), vehicle("r", 1.0, "ramp")])
    found = read_corridor(config, "main3:main5", tmp_path)
    assert {one.vehicle.name: one.upstream for one in found.demand.passes} == {
        "a": "main2",
        "r": "",
    }
    kind = found.demand.passes[0].vehicle.vehicle_type
    twice = ("main1", "main2", "off", "before", "on", "main4", "main5")
    again = SumoVehicle("x", 0.0, twice, kind, "passenger")
    demand = SumoDemand((again,), 0.0, 10.0)
    assert demand_on(corridor(tmp_path).corridor, demand).missing == {"drive through it twice": 1}


def test_vehicles_that_depart_after_the_end_are_left_out(tmp_path: Path) -> None:
    found = corridor(tmp_path, vehicle("a", 299.0, "main"), vehicle("b", 300.5, "main"))
    assert [one.vehicle.name for one in found.demand.passes] == ["a"]


def test_flows_are_vehicles_as_sumo_makes_them(tmp_path: Path) -> None:
    flow = (
        '<flow id="f" type="car" begin="10" period="20" number="4" departSpeed="max">'
        '<route edges="main1 main2 main3 main4 main5"/></flow>'
    )
    found = corridor(tmp_path, flow)
    departures = {one.vehicle.name: one.vehicle.depart_s for one in found.demand.passes}
    expected = {f"f.{number}": 10.0 + 20.0 * number for number in range(4)}
    assert departures == pytest.approx(expected, abs=STEP_S + 1e-6)


def test_arrivals_have_names_of_laneweave_and_lanes_that_suit_them(tmp_path: Path) -> None:
    found = corridor(tmp_path, *stream(60))
    scenario = parse_scenario(scenario_tables(found.corridor, found.demand))
    arrivals = corridor_arrivals(scenario, found.demand)
    assert [one.arrival.vehicle for one in arrivals[:2]] == ["v0001", "v0002"]
    assert {one.arrival.lane for one in arrivals if one.origin.entrance == "on"} == {0}
    # The lane next to the exit for those that leave, and all lanes for the others.
    main = [*main_stream(arrivals)]
    assert {one.lane for one in main if one.destination == "off"} == {1}
    assert {one.lane for one in main if one.destination == END_OF_ROAD} == {2, 3}
    assert {one.vehicle_type for one in main} == {"car", "truck"}
    assert [one.t_s for one in main] == sorted(one.t_s for one in main)
    assert main[0].t_s == FIRST_ENTRY_S
    names = {one.sumo_id for one in main}
    assert names == {f"m#{second}" for second in range(60)}


def test_vehicles_that_depart_together_arrive_in_different_lanes(tmp_path: Path) -> None:
    found = corridor(tmp_path, *(vehicle(f"m{n}", 10.0, "main") for n in range(4)))
    scenario = parse_scenario(scenario_tables(found.corridor, found.demand))
    lanes = [one.arrival.lane for one in corridor_arrivals(scenario, found.demand)]
    assert lanes == [3, 2, 1, 3]


def test_short_names_of_options_and_times_are_read(tmp_path: Path) -> None:
    write_interchange(tmp_path)
    config = tmp_path / "short.sumocfg"
    config.write_text(
        '<sumoConfiguration><input><n v="small.net.xml"/></input><time><b v="0:01:30"/>'
        '<e v="-1"/></time><processing><time-to-teleport value="60"/></processing>'
        '<report><verbose value="true"/></report></sumoConfiguration>',
        encoding="utf-8",
    )
    found = read_config(config)
    assert (found.begin_s, found.end_s, found.step_s) == (90.0, float("inf"), 1.0)
    assert found.options == {"time-to-teleport": "60"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<configuration/>", "net-file"),
        ('<configuration><input><net-file value="no.xml"/></input></configuration>', "no.xml"),
        ("not XML", "SUMOCFG"),
    ],
)
def test_a_configuration_without_a_network_is_refused(
    tmp_path: Path, text: str, expected: str
) -> None:
    config = tmp_path / "bad.sumocfg"
    config.write_text(text, encoding="utf-8")
    with pytest.raises(BadInputError, match=expected):
        read_config(config)


def test_what_sumo_refuses_is_one_line(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, ['<vehicle id="x" type="none" depart="0"/>'])
    with pytest.raises(SumoFailedError) as caught:
        read_corridor(config, CORRIDOR, tmp_path)
    assert "\n" not in str(caught.value)


def test_a_shorter_demand_is_the_beginning_of_the_whole(tmp_path: Path) -> None:
    found = corridor(tmp_path, *(vehicle(f"m{n}", 2.0 * n, "main") for n in range(10)))
    own = parse_scenario(scenario_tables(found.corridor, found.demand))
    whole = found.setup(own)
    part = found.setup(evolve(own, demand=evolve(own.demand, duration_s=7.0)))
    assert part.arrivals == whole.arrivals[:4]
    assert part.end_s == whole.end_s - whole.duration_s + 7.0
    assert part.is_left_out("m4", ["main1"])


def test_trips_get_the_routes_that_sumo_chooses(tmp_path: Path) -> None:
    trips = [
        '<trip id="a" type="car" depart="0" from="main1" to="main5"/>',
        '<trip id="b" type="car" depart="1" from="before" to="main5"/>',
        '<trip id="c" type="car" depart="2" from="start" to="off" via="main1"/>',
        '<trip id="nowhere" type="car" depart="3" from="off" to="main1"/>',
    ]
    passes = corridor(tmp_path, *trips).demand.passes
    assert {one.vehicle.name: (one.upstream, one.entrance, one.destination) for one in passes} == {
        "a": ("", MAIN_ENTRANCE, END_OF_ROAD),
        "b": ("", "on", END_OF_ROAD),
        "c": ("start", MAIN_ENTRANCE, "off"),
    }
