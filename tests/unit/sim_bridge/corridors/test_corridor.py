"""Which road a corridor of a SUMO network is."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from attrs import evolve

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.protocol.vehicle.lane_ends import HANDOVER_M
from laneweave.sim_bridge.corridors.corridor import (
    MIN_AT_M,
    Corridor,
    braking_m,
    corridor_of,
    lattice_speed_mps,
)
from laneweave.sim_bridge.corridors.corridor_search import find_approaches, find_corridors
from laneweave.sim_bridge.corridors.scenario_tables import checked_tables, scenario_tables
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor, corridor_in, read_corridor
from laneweave.sim_bridge.corridors.sumo_network import Edge, Lane, Link, Network
from support.interchange import (
    CORRIDOR,
    FORK,
    LONGEST_CORRIDOR,
    MAIN_SPEED_MPS,
    POCKET,
    RAMP_SPEED_MPS,
    TRUCKS,
    scenario_of,
    stream,
    vehicle,
    write_interchange,
)


@pytest.fixture(scope="module")
def network(interchange: SumoCorridor) -> Network:
    return interchange.simulation.network


def checked(found: SumoCorridor, **changed: Any) -> dict[str, Any]:  # noqa: ANN401 (fields)
    """Return the tables of a corridor of which some fields are changed."""
    found = evolve(found, corridor=evolve(found.corridor, **changed))
    return checked_tables(found, {"config": "small.sumocfg", "corridor": found.corridor.name})


def giving_way(network: Network) -> Network:
    """Return the network with a main road that gives way before its last edge."""
    links = [evolve(one, state="m") if one.target.edge == "main5" else one for one in network.links]
    return Network(network.edges, tuple(links))


# --- the road ---------------------------------------------------------------------------------


def test_lanes_are_joined_by_links_from_outside_are_ramps_and_to_outside_exits(
    interchange: SumoCorridor,
) -> None:
    corridor = interchange.corridor
    assert [(one.name, one.first_lane, len(one.lanes)) for one in corridor.edges] == [
        ("main1", 1, 3),
        ("main2", 0, 4),
        ("main3", 1, 3),
        ("main4", 0, 4),
        ("main5", 1, 3),
    ]
    assert (corridor.lanes, corridor.length_m) == (4, 1960.0 - HANDOVER_M)
    assert not corridor.unused
    (ramp,), (exit_,) = corridor.ramps, corridor.ways_out
    assert (ramp.edge, ramp.to_edge, ramp.lane, ramp.merge_m) == ("on", "main4", 0, 1110.0)
    assert ramp.speed_mps == RAMP_SPEED_MPS
    # It begins behind the exit in the same lane, though its edges are longer.
    assert exit_.at_m == 950.0 - HANDOVER_M < ramp.at_m < ramp.merge_m - 100.0
    assert (exit_.edge, exit_.from_edge, exit_.lanes) == ("off", "main2", (0,))
    assert corridor.closures == (
        Closure(0, 0.0, 700.0),
        Closure(0, exit_.at_m, ramp.at_m),
        Closure(0, 1360.0),
    )


def test_a_part_of_the_edges_is_a_corridor_too(network: Network) -> None:
    corridor = corridor_of(network, "main3", "main5")
    assert [edge.from_m for edge in corridor.edges] == [0.0, 160.0, 410.0]
    assert corridor.ramps[0].at_m == MIN_AT_M
    assert not corridor.ways_out
    single = corridor_of(network, "main1", "main1")
    assert (single.lanes, single.closures, single.ramps) == (3, (), ())


def test_lanes_of_the_last_edge_may_lead_to_different_edges(tmp_path: Path) -> None:
    # Lane 0 leads ahead, too; nobody may leave by an edge that cars do not reach.
    routes = ("left", "ahead", "right", "left")
    vehicles = [vehicle(str(number), number, route) for number, route in enumerate(routes)]
    vehicles.append('<trip id="ends" depart="9" from="main1" to="main1"/>')
    found = read_corridor(write_interchange(tmp_path, vehicles, network=FORK), "main1:main1")
    assert found.corridor.lanes_to == {"ahead": (0, 1), "left": (2,), "right": (0,)}
    assert not found.corridor.ways_out
    assert [one.lanes for one in found.passes] == [(2,), (0, 1), (0,), (2,), ()]
    assert [found.passes[1].preferred_lane(lane) for lane in range(3)] == [0, 1, 1]
    assert found.passes[4].preferred_lane(1) == ANY_LANE
    assert scenario_tables(found)["demand"]["lane_shares"] == [0.4, 0.2, 0.4]


def test_names_of_edges_may_contain_colons(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, stream(3), types=TRUCKS)
    for name, expected in (
        ("main1", "FIRST_EDGE:LAST_EDGE"),
        ("main1:", "FIRST_EDGE:LAST_EDGE"),
        ("main1:nowhere", "two edges of the network"),
        ("main5:main1", "0 edges can be reached from main5"),
    ):
        with pytest.raises(BadInputError, match=expected):
            read_corridor(config, name)
    for file in tmp_path.glob("small.*"):
        text = file.read_text(encoding="utf-8")
        file.write_text(re.sub(r"\bmain([15])(?=_|\b)", r"main:\1", text), encoding="utf-8")
    assert read_corridor(config, "main:1:main:5").corridor.name == "main:1:main:5"
    with pytest.raises(BadInputError, match="two edges of the network"):
        read_corridor(config, "main:1:main:6")


def test_sumo_has_room_to_brake_where_vehicles_give_way_behind_the_corridor(
    network: Network,
) -> None:
    brakes_m = braking_m(lattice_speed_mps(MAIN_SPEED_MPS))
    assert brakes_m == pytest.approx(116.4, abs=0.1)

    def with_crossing(length_m: float) -> Network:
        """The exit gives way; behind main5, after `length_m`, is a traffic light."""
        links = [
            evolve(one, state="m") if one.target.edge == "off" else one for one in network.links
        ]
        behind, last = (
            Edge(name, (Lane(f"{name}_0", name, 0, length_m, 3.2, 20.0),))
            for name in ("behind", "last")
        )
        links += [Link(lane, behind.lanes[0]) for lane in network.edges["main5"].lanes]
        links.append(Link(behind.lanes[0], last.lanes[0], traffic_light="L"))
        return Network({**network.edges, "behind": behind, "last": last}, tuple(links))

    corridor = corridor_of(with_crossing(50.0), "main1", "main5")
    assert corridor.length_m == pytest.approx(1960.0 - brakes_m + 50.0)
    (exit_,) = corridor.ways_out
    assert exit_.at_m == pytest.approx(950.0 - brakes_m)
    assert any((one.lane, one.from_m) == (0, exit_.at_m) for one in corridor.closures)
    far = corridor_of(with_crossing(200.0), "main1", "main5")
    assert far.length_m == 1960.0 - HANDOVER_M
    with pytest.raises(BadInputError, match=r"length of behind: got 50\.0; allowed: at least 64 m"):
        corridor_of(with_crossing(50.0), "main1", "behind")


def two_lane_ramp(network: Network) -> Network:
    on, main4 = network.edges["on"], network.edges["main4"]
    second = evolve(on.lanes[0], name="on_1", index=1)
    links = [link for link in network.links if link.target.name != "main4_1"]
    links.append(Link(second, main4.lanes[1]))
    edges = {**network.edges, "on": evolve(on, lanes=(*on.lanes, second))}
    return Network(edges, tuple(links))


def test_each_lane_of_a_ramp_is_an_entrance(network: Network) -> None:
    corridor = corridor_of(two_lane_ramp(network), "main1", "main5")
    first, second = corridor.ramps
    assert (first.edge, second.edge, first.lane, second.lane) == ("on", "on", 0, 1)
    assert first.name == first.entrance == second.entrance != second.name


def with_way_out(network: Network, edge: str, index: int) -> Network:
    """Return the network with another edge, to which the lane of an edge with this index leads."""
    from_edge, on = network.edges[edge], network.edges["on"]
    lanes = [*from_edge.lanes]
    if index == len(lanes):
        lanes.append(evolve(lanes[0], name=f"{edge}_{index}", index=index))
    away = Edge("away", (evolve(on.lanes[0], name="away_0", edge="away"),))
    links = (*network.links, Link(lanes[index], away.lanes[0]))
    edges = {**network.edges, edge: evolve(from_edge, lanes=tuple(lanes)), "away": away}
    return Network(edges, links)


@pytest.mark.parametrize(
    ("edge", "index", "path"),
    [
        ("before", 0, ["on"]),
        ("before", 1, ["on"]),
        ("on", 0, []),
        ("on", 1, []),
    ],
)
def test_a_ramp_begins_behind_edges_that_lead_elsewhere_too(
    network: Network, edge: str, index: int, path: list[str]
) -> None:
    """SUMO drives other vehicles there."""
    (whole,) = corridor_of(network, "main1", "main5").ramps
    assert [link.origin.edge for link in whole.path] == ["on", "before"]
    routes = [("first", "before", "on", "main4"), ("first", edge, "away")]
    (ramp,) = corridor_of(with_way_out(network, edge, index), "main1", "main5", routes).ramps
    assert [link.origin.edge for link in ramp.path] == path


@pytest.mark.parametrize("ends", [False, True])
def test_a_ramp_begins_behind_an_edge_on_which_a_route_ends(network: Network, ends: bool) -> None:
    """Unused turnarounds, which netconvert adds, do not matter."""
    routes = [("first", "before", "on", "main4"), *([("first", "before")] if ends else [])]
    (ramp,) = corridor_of(with_way_out(network, "before", 0), "main1", "main5", routes).ramps
    assert [link.origin.edge for link in ramp.path] == (["on"] if ends else ["on", "before"])


@pytest.mark.parametrize(("edge", "path"), [("before", ["on"]), ("on", [])])
def test_a_ramp_begins_behind_edges_with_lanes_that_end(
    network: Network, edge: str, path: list[str]
) -> None:
    """Vehicles in such lanes change to the ramp's lane behind its beginning."""
    lanes = network.edges[edge].lanes
    lanes = (*lanes, evolve(lanes[0], name=f"{edge}_1", index=1))
    edges = {**network.edges, edge: evolve(network.edges[edge], lanes=lanes)}
    (ramp,) = corridor_of(Network(edges, network.links), "main1", "main5").ramps
    assert [link.origin.edge for link in ramp.path] == path


def test_a_ramp_whose_last_edge_leads_elsewhere_too_is_refused(interchange: SumoCorridor) -> None:
    network = with_way_out(interchange.simulation.network, "on", 0)
    corridor = corridor_of(network, "main1", "main5", [("before", "on", "away")])
    with pytest.raises(BadInputError, match="lead to the corridor"):
        checked(interchange, ramps=corridor.ramps)


def test_vehicles_must_not_have_to_give_way_on_a_corridor(network: Network) -> None:
    with pytest.raises(BadInputError, match="its state is 'm'"):
        corridor_of(giving_way(network), "main1", "main5")


@pytest.mark.parametrize("text", ["", "<net", "<routes/>"])
def test_a_file_that_is_no_network_is_refused(tmp_path: Path, text: str) -> None:
    config = write_interchange(tmp_path)
    (tmp_path / "small.net.xml").write_text(text, encoding="utf-8")
    with pytest.raises(BadInputError, match="net-file"):
        read_corridor(config, CORRIDOR)


# --- the search for corridors -----------------------------------------------------------------


def ring(count: int) -> Network:
    """Return a ring of edges with two lanes."""
    edges = {
        f"e{n}": Edge(
            f"e{n}",
            tuple(Lane(f"e{n}_{lane}", f"e{n}", lane, 300.0, 3.2, 20.0) for lane in range(2)),
        )
        for n in range(count)
    }
    links = (
        Link(edges[f"e{n}"].lanes[lane], edges[f"e{(n + 1) % count}"].lanes[lane])
        for n in range(count)
        for lane in range(2)
    )
    return Network(edges, tuple(links))


def test_the_longest_chain_with_priority_is_found(interchange: SumoCorridor) -> None:
    simulation = interchange.simulation
    (found,) = find_corridors(simulation)
    # Vehicles that depart on its second edge are left out.
    assert (found.name, found.volume_veh_per_h) == (LONGEST_CORRIDOR, 10 * 60.0)
    parts = find_corridors(evolve(simulation, network=giving_way(simulation.network)))
    assert {one.name for one in parts} == {"start:main4", "main5:main5"}
    (found,) = find_corridors(evolve(simulation, network=ring(4)))
    assert (found.name, found.volume_veh_per_h) == ("e0:e3", 0.0)
    assert found.found is not None
    assert found.found.corridor.length_m == 1200.0 - HANDOVER_M


def test_the_lane_of_an_unused_ramp_stays_closed_if_it_begins_just_before_the_end(
    interchange: SumoCorridor,
) -> None:
    corridor = interchange.corridor
    (ramp,) = corridor.ramps
    passes = tuple(one for one in interchange.passes if one.entrance != ramp.entrance)

    def opens_m(merge_m: float) -> float | None:
        changed = evolve(corridor, ramps=(evolve(ramp, merge_m=merge_m),))
        tables = scenario_tables(evolve(interchange, corridor=changed, passes=passes))
        closed = [one for one in tables["road"]["closures"] if one["lane"] == ramp.lane]
        found: list[float | None] = [one.get("to_m") for one in closed if "from_m" in one]
        return found[0]

    assert opens_m(ramp.merge_m) == pytest.approx(ramp.merge_m, abs=0.01)
    assert opens_m(corridor.length_m - 20.0) is None


# --- the scenario -----------------------------------------------------------------------------


def test_the_tables_are_a_valid_scenario(scenario: Scenario) -> None:
    assert scenario.geometry.shared_lanes == {0}
    assert scenario.formation.speed_mps == 26.5
    assert not scenario.formation.change_columns
    truck = scenario.types["truck"].limits
    assert (truck.length_m, truck.max_accel_mps2) == (7.1, 1.3)
    # SUMO's trucks brake with 7 m/s2 in an emergency.
    assert truck.min_accel_mps2 == -7.0
    assert scenario.entrance[0].volume_veh_per_h == pytest.approx(600.0, rel=0.05)


def late_ramp(corridor: Corridor) -> dict[str, Any]:
    return {"ramps": (evolve(corridor.ramps[0], merge_m=corridor.ramps[0].merge_m + 200.0),)}


def ramp_without_priority(corridor: Corridor) -> dict[str, Any]:
    return {"ramps": (evolve(corridor.ramps[0], path=(), at_m=corridor.ramps[0].merge_m),)}


def late_opening(corridor: Corridor) -> dict[str, Any]:
    return {"closures": (evolve(corridor.closures[0], to_m=900.0), *corridor.closures[1:])}


def short_acceleration_lane(corridor: Corridor) -> dict[str, Any]:
    last = evolve(corridor.closures[-1], from_m=corridor.ramps[0].merge_m + 60.0)
    return {"closures": (*corridor.closures[:-1], last)}


def test_a_ramp_may_lead_into_a_lane_that_is_open_at_the_start(interchange: SumoCorridor) -> None:
    corridor = interchange.corridor
    scenario = parse_scenario(checked(interchange, closures=corridor.closures[1:]))
    in_lane_0 = [one.entrance for one in scenario.geometry.entry_points if one.lane == 0]
    assert in_lane_0 == ["main", "on"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (late_ramp, r"on-ramp from on of 345 m into lane main4_0 of 50 m \(entrance"),
        (ramp_without_priority, "on-ramp: got 'on'; allowed: on-ramps whose vehicles"),
        (late_opening, r"exit to off from lane main2_0, open for 46 m \(exit.*longer are"),
        (short_acceleration_lane, r"end of lane main4_0|on-ramp from on.*main4_0"),
    ],
)
def test_what_does_not_fit_is_named_as_in_the_network(
    interchange: SumoCorridor, change: Callable[[Corridor], dict[str, Any]], expected: str
) -> None:
    with pytest.raises(BadInputError, match=expected):
        checked(interchange, **change(interchange.corridor))


@pytest.mark.parametrize(
    ("truck", "expected"),
    [
        ('accel="0.8"', ""),
        ('accel="0.2"', r"vehicles that accelerate with 0\.2 m/s2"),
        ('width="2.9"', r"width of vehicles of class truck: got 2\.9; allowed: at most 2\.7 m"),
    ],
)
def test_types_that_are_too_weak_or_too_wide_are_named(
    tmp_path: Path, truck: str, expected: str
) -> None:
    types = f'<vType id="truck" vClass="truck" sigma="0" decel="4" {truck}/>'
    found = read_corridor(write_interchange(tmp_path, stream(60), types=types), CORRIDOR)
    if not expected:
        assert scenario_tables(found)
        return
    with pytest.raises(BadInputError, match=expected):
        scenario_tables(found)


def test_to_a_turn_pocket_sumo_drives_from_the_lane_beside_it(tmp_path: Path) -> None:
    vehicles = [vehicle(turn, 1.0, f"pocket {turn}") for turn in ("ahead", "left")]
    found = read_corridor(write_interchange(tmp_path, vehicles, network=POCKET), "main1:main2")
    assert found.corridor.closures == (Closure(2, 0.0),)
    assert found.corridor.lanes_to == {"ahead": (0, 1), "left": (1,)}
    assert [one.lanes for one in found.passes] == [(0, 1), (1,)]
    assert parse_scenario(checked(found)).road.first_lanes == (0, 1)
    network = found.simulation.network
    links = (
        evolve(link, state="m", traffic_light="B") if link.origin.edge == "main2" else link
        for link in network.links
    )
    signals = evolve(found.simulation, network=evolve(network, links=tuple(links)))
    (approach,) = find_approaches(signals)
    assert (approach.name, approach.control) == ("main1:main2", "light")
    assert [(one.edge, one.lanes) for one in approach.turns] == [("ahead", (0, 1)), ("left", (2,))]


def test_shares_of_types_that_are_no_round_figures_are_valid(tmp_path: Path) -> None:
    types = (
        f'{TRUCKS}<vType id="van" vClass="delivery" length="6" sigma="0"/>'
        '<vType id="bus" vClass="bus" length="7" accel="1.5" decel="4.1" sigma="0"/>'
    )
    kinds = ("truck", "van", *4 * ("bus",))
    by_ramp = [vehicle(f"r{n}", 30 + 4 * n, "ramp", kind) for n, kind in enumerate(kinds)]
    ahead = [vehicle(f"m{n}", 2 * n, "main") for n in range(12)]
    config = write_interchange(tmp_path, [*ahead, *by_ramp], types=types)
    shares = [one.share for one in scenario_of(config).entrance[0].vehicle_types]
    assert 0.999 < sum(shares) <= 1.0


def test_more_vehicles_than_the_road_carries_wait_and_prefer_no_lane(tmp_path: Path) -> None:
    """A plain road would otherwise have to be long enough for random preferences."""
    crowd = [vehicle(f"m{number}", 1.0, "main") for number in range(9)]
    found = read_corridor(write_interchange(tmp_path, crowd), CORRIDOR)
    assert found.simulation.duration_s == 2.0
    scenario = parse_scenario(checked(found))
    assert scenario.demand.volume_veh_per_lane_h == 3600.0
    plain = corridor_in(found.simulation, "main1", "main1")
    assert parse_scenario(checked(plain)).flow.lane_shares == ()


def test_a_corridor_that_nobody_enters_at_its_start_is_refused(interchange: SumoCorridor) -> None:
    passes = tuple(one for one in interchange.passes if one.entrance == "on")
    with pytest.raises(BadInputError, match="a corridor that vehicles enter on main1"):
        scenario_tables(evolve(interchange, passes=passes))
