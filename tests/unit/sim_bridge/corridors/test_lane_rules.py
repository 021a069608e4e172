"""Permissions and change restrictions of SUMO's lanes, and traffic on the left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.sim_bridge.corridors.corridor_setup import setup_of
from laneweave.sim_bridge.corridors.corridor_shape import CorridorShape
from laneweave.sim_bridge.corridors.scenario_tables import remarks, scenario_tables
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor, read_corridor
from support.interchange import CORRIDOR, LANE_M, TRUCKS, stream, vehicle, write_interchange

KINDS = ("car", "truck")


def corridor_with(
    folder: Path, new: Mapping[str, str], vehicles: Sequence[str] = (), types: str = TRUCKS
) -> SumoCorridor:
    """Return the corridor of the interchange with parts of its network file replaced."""
    config = write_interchange(folder, vehicles or stream(60), types=types)
    file = folder / "small.net.xml"
    text = file.read_text(encoding="utf-8")
    for old, part in new.items():
        assert old in text
        text = text.replace(old, part)
    file.write_text(text, encoding="utf-8")
    return read_corridor(config, CORRIDOR)


def remarks_on(found: SumoCorridor) -> list[str]:
    return remarks(found, scenario_tables(found))


def test_trucks_keep_out_of_lanes_that_ban_them(tmp_path: Path) -> None:
    banned = {'<lane id="main3_2"': '<lane id="main3_2" disallow="truck"'}
    found = corridor_with(tmp_path, banned)
    tables = scenario_tables(found)
    (rule,) = tables["road"]["restrictions"]
    assert rule == {"lane": 3, "from_m": 950.0, "to_m": 1110.0, "vehicle_types": ["truck"]}
    scenario = parse_scenario(tables)
    assert scenario.road.is_restricted(3, 1000.0, "truck")
    assert not scenario.road.is_restricted(3, 1000.0, "car")


def test_vehicles_enter_in_lanes_that_allow_them(tmp_path: Path) -> None:
    banned = {'<lane id="main1_2"': '<lane id="main1_2" disallow="truck"'}
    trucks = [vehicle(f"t{n}", 3.0 * n, "main", "truck") for n in range(9)]
    cars = [vehicle(f"c{n}", 3.0 * n + 1.0, "main") for n in range(20)]
    found = corridor_with(tmp_path, banned, [*trucks, *cars])
    scenario = parse_scenario(scenario_tables(found))
    arrivals = [one.arrival for one in setup_of(found, scenario).arrivals]
    lanes = {kind: {one.lane for one in arrivals if one.vehicle_type == kind} for kind in KINDS}
    assert lanes["truck"] == {2}  # the left lane would be the first one that is free
    assert 3 in lanes["car"]


def test_types_of_two_classes_with_equal_limits_are_two(tmp_path: Path) -> None:
    types = '<vType id="truck" vClass="taxi" sigma="0"/>'
    banned = {'<lane id="main3_2"': '<lane id="main3_2" disallow="taxi"'}
    found = corridor_with(tmp_path, banned, types=types)
    tables = scenario_tables(found)
    assert tables["road"]["restrictions"][0]["vehicle_types"] == ["taxi"]
    setup = setup_of(found, parse_scenario(tables))
    kinds = {one.origin.vehicle.type_name: one.arrival.vehicle_type for one in setup.arrivals}
    assert kinds == {"car": "car", "truck": "taxi"}


def test_lines_that_may_not_be_crossed(tmp_path: Path) -> None:
    old = '<lane id="main3_{}"'
    found = corridor_with(
        tmp_path,
        {
            old.format(0): '<lane id="main3_0" changeLeft="all"',
            old.format(1): '<lane id="main3_1" changeLeft="emergency" changeRight="truck"',
        },
    )
    tables = scenario_tables(found)
    part = {"lane": 2, "from_m": 950.0, "to_m": 1110.0}
    assert tables["road"]["solid_lines"] == [
        {**part, "to": "left"},
        {**part, "to": "right", "vehicle_types": ["car"]},
    ]
    assert parse_scenario(tables)


def test_traffic_on_the_left_is_mirrored(tmp_path: Path) -> None:
    found = corridor_with(tmp_path, {"<net": '<net lefthand="true"'})
    assert found.simulation.network.left_hand
    shape = CorridorShape(found.corridor)
    (_, y_m, _), piece = shape.at(300.0, 1.5 * LANE_M + 0.4)
    # A body left of the middle of its lane on the mirrored road is right of it in the world.
    assert (piece.edge, piece.index) == ("main1", 0)
    assert y_m == pytest.approx(1.5 * LANE_M - 0.4)


def test_a_slow_type_that_lowers_the_speed_of_all_is_named(
    interchange: SumoCorridor, tmp_path: Path
) -> None:
    types = '<vType id="truck" vClass="moped" maxSpeed="12.5" sigma="0"/>'
    found = corridor_with(tmp_path, {}, types=types)
    (remark,) = remarks_on(found)
    assert "12.5 m/s, the maximum speed of class moped (9 of 70" in remark
    assert not remarks_on(interchange)


def test_it_is_said_that_vehicles_wait_where_lanes_carry_fewer(interchange: SumoCorridor) -> None:
    shorter = evolve(interchange.simulation, end_s=20.0)
    (remark,) = remarks_on(evolve(interchange, simulation=shorter))
    assert "vehicles wait at the entrances: demand.volume_veh_per_lane_h is 3600, with" in remark
