"""The road on which SUMO drives: its network, and what SUMO makes of it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from laneweave.launch.run_methods import LC2013, METHODS
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.lc2013 import check_lc2013
from laneweave.sim_bridge.sumo.network import write_network
from laneweave.sim_bridge.sumo.traffic import SumoTraffic
from support.bridge_bench import arrival
from support.closed_lanes import ramp_road
from support.tables import for_each


def files_of(scenario: Scenario, folder: Path) -> tuple[tuple[str, ...], ET.Element, ET.Element]:
    """Return SUMO's options, the network and the routes."""
    options = write_network(scenario, folder, sumo_drives=True)
    network, routes = (
        ET.parse(folder / name).getroot()  # noqa: S314 (our own)
        for name in ("road.net.xml", "road.rou.xml")
    )
    return options, network, routes


# --- the files --------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", [1, 3, 8])
def test_each_lane_leads_to_an_exit_of_its_own(tmp_path: Path, lanes: int) -> None:
    tables = {"road": {"lanes": lanes}, "formation": {"speed_mps": 12.0}}
    _, network, routes = files_of(parse_scenario(tables), tmp_path)
    connections = {(one.attrib["fromLane"], one.attrib["to"]) for one in network.iter("connection")}
    assert connections == {(str(lane), f"exit{lane}") for lane in range(lanes)}
    edges = {one.attrib["id"]: one.attrib["edges"] for one in routes.iter("route")}
    assert edges == {f"main/lane-{lane}": f"road exit{lane}" for lane in range(lanes)}
    shapes = {one.attrib["id"]: one.attrib["shape"] for one in network.iter("lane")}
    for lane in range(lanes):
        end = f"1000.000000,{(lane + 0.5) * 3.5:.6f}"
        assert shapes[f"road_{lane}"].endswith(end)
        assert shapes[f"exit{lane}_0"].startswith(end)
    assert {float(one.attrib["speed"]) for one in network.iter("lane")} == {12.0}


def test_drivers_are_as_the_scenario_says(tmp_path: Path) -> None:
    table: dict[str, Any] = {"headway_s": 0.8, "min_gap_m": 0.5, "lane_change_s": 4.0}
    options, _, routes = files_of(parse_scenario({"lc2013": table}), tmp_path)
    kind = next(routes.iter("vType")).attrib
    assert (kind["carFollowModel"], kind["laneChangeModel"]) == ("Krauss", "LC2013")
    assert [float(kind[name]) for name in ("tau", "minGap", "accel", "decel")] == [0.8, 0.5, 5, 10]
    assert options[-2:] == ("--lanechange.duration", "4.000000")
    assert "--lateral-resolution" not in options
    table = {
        "model": "SL2015",
        "imperfection": 0.5,
        "speed_factor": 1.1,
        "accel_mps2": 2.6,
        "decel_mps2": 4.5,
        "strategic": 10.0,
        "cooperative": 0.5,
        "assertive": 2.0,
    }
    options, _, routes = files_of(parse_scenario({"lc2013": table}), tmp_path)
    kind = next(routes.iter("vType")).attrib
    assert kind["laneChangeModel"] == "SL2015"
    names = [
        "sigma",
        "speedFactor",
        "accel",
        "decel",
        "emergencyDecel",
        "lcStrategic",
        "lcCooperative",
        "lcAssertive",
    ]
    assert [float(kind[name]) for name in names] == [0.5, 1.1, 2.6, 4.5, 10.0, 10.0, 0.5, 2.0]
    assert "--lateral-resolution" in options
    assert "--lanechange.duration" not in options


@pytest.mark.parametrize("label", [name for name, one in METHODS.items() if one.method == LC2013])
def test_sumo_drives_every_named_set_of_parameters(tmp_path: Path, label: str) -> None:
    scenario = METHODS[label].settings(Scenario())
    with SumoTraffic(scenario, tmp_path / "sumo") as traffic:
        traffic.offer(arrival("v1", 0.0, 2, 0), 0.0)
        for _ in range(800):
            traffic.advance()
            ((s_m, y_m, _, _),) = traffic.positions().values()
            if s_m > scenario.road.length_m - 5.0:
                break
    assert s_m > scenario.road.length_m - 5.0
    assert y_m < scenario.road.lane_width_m


# --- closed parts of lanes --------------------------------------------------------------------

SHORT = {"s1_m": 50.0, "s2_m": 100.0, "s3_m": 850.0}
OPEN, CLOSED = True, False


def closed_road(
    folder: Path,
    *closures: dict[str, float],
    shares: tuple[float, ...] = (),
    lc2013: dict[str, Any] | None = None,
) -> tuple[ET.Element, ET.Element]:
    """Return the network and the routes of a road with closed parts of lanes."""
    tables = {
        "road": {**SHORT, "closures": list(closures)},
        "demand": {"lane_shares": list(shares)},
        "formation": {"operation": "rolling"},
        "lc2013": lc2013 or {},
    }
    return files_of(parse_scenario(tables), folder)[1:]


def lanes_by_edge(network: ET.Element) -> dict[str, tuple[float, float, dict[float, bool]]]:
    """Return (from, to, {centre line: open}) of each edge."""
    found = {}
    for edge in network.iter("edge"):
        shapes = {}
        for index, lane in enumerate(edge.iter("lane")):
            assert lane.attrib["id"] == f"{edge.attrib['id']}_{index}"
            start, end = (
                [float(one) for one in each.split(",")] for each in lane.attrib["shape"].split()
            )
            assert start[1] == end[1]
            assert float(lane.attrib["length"]) == pytest.approx(end[0] - start[0])
            shapes[start[1]] = "disallow" not in lane.attrib
        found[edge.attrib["id"]] = (start[0], end[0], shapes)
    return found


def connected_positions(network: ET.Element) -> set[tuple[str, str, float]]:
    """Return (edge, next edge, centre line); no connection leads to another lane."""
    edges = lanes_by_edge(network)
    found = set()
    for one in network.iter("connection"):
        (edge, y_m), (following, next_y_m) = (
            (one.attrib[side], [*edges[one.attrib[side]][2]][int(one.attrib[number])])
            for side, number in (("from", "fromLane"), ("to", "toLane"))
        )
        assert y_m == next_y_m
        found.add((edge, following, y_m))
    return found


def routes_by_name(routes: ET.Element) -> dict[str, str]:
    return {one.attrib["id"]: one.attrib["edges"] for one in routes.iter("route")}


def test_a_lane_that_ends_has_no_connection(tmp_path: Path) -> None:
    network, routes = closed_road(tmp_path, {"lane": 0, "from_m": 800.0})
    assert lanes_by_edge(network) == {
        "road": (-30.0, 800.0, {1.75: OPEN, 5.25: OPEN, 8.75: OPEN}),
        "road1": (800.0, 1030.0, {5.25: OPEN, 8.75: OPEN}),
    }
    assert connected_positions(network) == {("road", "road1", 5.25), ("road", "road1", 8.75)}
    assert routes_by_name(routes) == {"main/end": "road road1"}


def test_a_lane_opens_again_behind_its_closed_part_and_a_body(tmp_path: Path) -> None:
    network, routes = closed_road(tmp_path, {"lane": 0, "from_m": 600.0, "to_m": 700.0})
    assert lanes_by_edge(network) == {
        "road": (-30.0, 600.0, {1.75: OPEN, 5.25: OPEN, 8.75: OPEN}),
        "road1": (600.0, 700.0, {5.25: OPEN, 8.75: OPEN}),
        "road2": (700.0, 705.0, {1.75: CLOSED, 5.25: OPEN, 8.75: OPEN}),
        "road3": (705.0, 1030.0, {1.75: OPEN, 5.25: OPEN, 8.75: OPEN}),
    }
    at_ends = [one for one in connected_positions(network) if one[2] == 1.75]
    assert at_ends == [("road2", "road3", 1.75)]
    assert routes_by_name(routes) == {"main/end": "road road1 road2 road3"}


def test_a_closed_lane_between_open_ones_keeps_them_apart(tmp_path: Path) -> None:
    network, _ = closed_road(tmp_path, {"lane": 1, "from_m": 600.0})
    edges = lanes_by_edge(network)
    assert edges["road1"] == (600.0, 1030.0, {1.75: OPEN, 5.25: CLOSED, 8.75: OPEN})
    assert ("road", "road1", 5.25) not in connected_positions(network)


def test_lanes_that_reach_the_end_lead_to_exits_if_vehicles_prefer_lanes(tmp_path: Path) -> None:
    closure = {"lane": 2, "from_m": 800.0}
    network, routes = closed_road(tmp_path, closure, shares=(0.5, 0.5, 0.0))
    edges = lanes_by_edge(network)
    assert edges["road1"] == (800.0, 1000.0, {1.75: OPEN, 5.25: OPEN})
    assert edges["exit1"] == (1000.0, 1030.0, {5.25: OPEN})
    assert routes_by_name(routes) == {
        f"main/lane-{lane}": f"road road1 exit{lane}" for lane in range(2)
    }


@pytest.mark.parametrize(
    ("lc2013", "end_m"),
    [({"lane_change_s": 4.0}, 800.0 - 2.0 * 15.0), ({"model": "SL2015"}, 800.0 - 1.75 * 15.0)],
)
def test_lane_changes_that_take_time_end_before_the_closed_part(
    tmp_path: Path, lc2013: dict[str, Any], end_m: float
) -> None:
    network, _ = closed_road(tmp_path, {"lane": 0, "from_m": 800.0}, lc2013=lc2013)
    assert lanes_by_edge(network)["road"][1] == pytest.approx(end_m)


def closed(**closure: float) -> dict[str, Any]:
    return {
        "road": {**SHORT, "closures": [{"lane": 0, **closure}]},
        "formation": {"operation": "rolling"},
        "lc2013": {"lane_change_s": 20.0},
    }


@for_each(
    "tables, expected",
    [
        ({"lc2013": {"headway_s": 0.05}}, r"lc2013\.headway_s"),
        ({"lc2013": {"accel_mps2": 5.1}}, r"lc2013\.accel_mps2.*at most"),
        ({"lc2013": {"decel_mps2": 10.1}}, r"lc2013\.decel_mps2.*at most"),
        (closed(from_m=300.0), r"road\.closures\[0\]\.from_m"),
        (closed(from_m=800.0, to_m=997.0), r"road\.closures\[0\]\.to_m"),
    ],
)
def test_what_sumo_cannot_drive_is_refused(tables: dict[str, Any], expected: str) -> None:
    with pytest.raises(BadInputError, match=expected):
        check_lc2013(parse_scenario(tables))


# --- ramps and exits --------------------------------------------------------------------------


def test_a_ramp_is_an_edge_beside_the_road_until_it_joins(tmp_path: Path) -> None:
    _, network, routes = files_of(ramp_road(), tmp_path)
    assert lanes_by_edge(network) == {
        "road": (-30.0, 200.0, {5.25: OPEN, 8.75: OPEN, 12.25: OPEN}),
        "road1": (200.0, 205.0, {1.75: OPEN, 5.25: OPEN, 8.75: OPEN, 12.25: OPEN}),
        "road2": (205.0, 500.0, {1.75: OPEN, 5.25: OPEN, 8.75: OPEN, 12.25: OPEN}),
        "road3": (500.0, 1030.0, {5.25: OPEN, 8.75: OPEN, 12.25: OPEN}),
        "ramp-on": (20.0, 200.0, {1.75: OPEN}),
    }
    rightmost = {one for one in connected_positions(network) if one[2] == 1.75}
    assert rightmost == {("ramp-on", "road1", 1.75), ("road1", "road2", 1.75)}
    assert routes_by_name(routes) == {
        "main/end": "road road1 road2 road3",
        "on/end": "ramp-on road1 road2 road3",
    }
    # SUMO would turn a body that changes lanes with its rear on another edge.
    forbidden = {
        (lane.attrib["id"], side)
        for lane in network.iter("lane")
        for side in ("changeLeft", "changeRight")
        if side in lane.attrib
    }
    assert {one for one in forbidden if one != ("road1_0", "changeRight")} == {
        ("road1_0", "changeLeft"),
        ("road1_1", "changeRight"),
    }


def test_an_exit_is_an_edge_behind_the_lane_that_it_ends(tmp_path: Path) -> None:
    # A lane change that takes time does not shorten the lane of an exit.
    scenario = ramp_road(ends_m=700.0, exit_name="off", lc2013={"lane_change_s": 4.0})
    _, network, routes = files_of(scenario, tmp_path)
    edges = lanes_by_edge(network)
    assert edges["road2"][:2] == (205.0, 700.0)
    assert edges["exit-off"] == (700.0, 730.0, {1.75: OPEN})
    behind = {one for one in connected_positions(network) if one[0] == "road2"}
    assert behind == {
        ("road2", "exit-off", 1.75),
        *(("road2", "road3", y_m) for y_m in (5.25, 8.75, 12.25)),
    }
    assert routes_by_name(routes) == {
        "main/end": "road road1 road2 road3",
        "main/off": "road road1 road2 exit-off",
        "on/end": "ramp-on road1 road2 road3",
        "on/off": "ramp-on road1 road2 exit-off",
    }


def test_each_junction_knows_all_lanes_that_lead_to_it(tmp_path: Path) -> None:
    _, network, _ = files_of(ramp_road(ends_m=700.0, exit_name="off"), tmp_path)
    names = [one.attrib["id"] for one in network.iter("junction")]
    assert len(names) == len(set(names))
    for junction in network.iter("junction"):
        before = [
            edge for edge in network.iter("edge") if edge.attrib["to"] == junction.attrib["id"]
        ]
        incoming = [lane.attrib["id"] for edge in before for lane in edge.iter("lane")]
        assert junction.attrib["incLanes"].split() == incoming
        ids = {edge.attrib["id"] for edge in before}
        count = sum(one.attrib["from"] in ids for one in network.iter("connection"))
        assert len(list(junction.iter("request"))) == count


def test_a_lane_between_two_lanes_of_an_exit_does_not_lead_there(tmp_path: Path) -> None:
    closures = [{"lane": lane, "from_m": 800.0} for lane in (0, 2)]
    scenario = parse_scenario(
        {
            "road": {**SHORT, "closures": closures},
            "exit": [{"name": "off", "lanes": [0, 2], "at_m": 800.0}],
            "demand": {"volume_veh_per_lane_h": 300.0},
            "formation": {"operation": "rolling"},
        }
    )
    _, network, _ = files_of(scenario, tmp_path)
    leading = {one for one in connected_positions(network) if one[1] == "exit-off"}
    assert leading == {("road", "exit-off", 1.75), ("road", "exit-off", 8.75)}


# --- SUMO -------------------------------------------------------------------------------------


@pytest.fixture
def traffic(tmp_path: Path) -> Iterator[SumoTraffic]:
    with SumoTraffic(Scenario(), tmp_path / "sumo") as traffic:
        yield traffic


def test_an_offered_vehicle_enters_where_it_was_offered(traffic: SumoTraffic) -> None:
    traffic.offer(arrival("v1", 0.0, 2, 0), 0.6)
    assert traffic.advance() == ("v1",)
    assert traffic.positions()["v1"] == pytest.approx((0.6, 8.75, 0.0, 15.0), abs=1e-6)
    assert traffic.advance() == ()
    assert traffic.positions()["v1"] == pytest.approx((2.1, 8.75, 0.0, 15.0), abs=1e-6)


def test_a_vehicle_without_room_waits(traffic: SumoTraffic) -> None:
    traffic.offer(arrival("v1", 0.0, 0, 0), 0.0)
    traffic.advance()
    traffic.offer(arrival("v2", 0.0, 0, 0), 0.0)
    ticks = 1
    while "v2" not in traffic.advance():
        ticks += 1
    # 0.66 s and a body, at 15 m/s.
    assert ticks == 10


def test_a_vehicle_that_may_not_change_lanes_waits_at_the_end(traffic: SumoTraffic) -> None:
    traffic.offer(arrival("v1", 0.0, 0, 1), 0.0)
    traffic.allow_lane_changes("v1", allowed=False)
    for _ in range(900):
        traffic.advance()
    s_m, y_m, _, speed_mps = traffic.positions()["v1"]
    assert (y_m, speed_mps) == (1.75, 0.0)
    assert 900.0 < s_m <= 1000.0
    traffic.allow_lane_changes("v1", allowed=True)
    while s_m < 1000.0:
        traffic.advance()
        s_m, y_m, _, _ = traffic.positions()["v1"]
    assert y_m == pytest.approx(5.25)
