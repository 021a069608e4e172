"""Which road a corridor of a SUMO network is."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from attrs import evolve

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.sim_bridge.corridors.corridor import (
    HANDOVER_M,
    MIN_AT_M,
    SPEED_SHARE,
    braking_m,
    corridor_of,
)
from laneweave.sim_bridge.corridors.corridor_search import find_corridors
from laneweave.sim_bridge.corridors.scenario_tables import checked_tables, scenario_tables
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor, read_corridor
from laneweave.sim_bridge.corridors.sumo_network import Edge, Lane, Link, Network
from laneweave.sim_bridge.corridors.sumo_simulation import read_simulation
from support.interchange import (
    CORRIDOR,
    LONGEST_CORRIDOR,
    MAIN_SPEED_MPS,
    RAMP_SPEED_MPS,
    TRUCKS,
    interchange_network,
    stream,
    vehicle,
    write_interchange,
)


def checked(found: SumoCorridor) -> dict[str, Any]:
    return checked_tables(found, {"config": "small.sumocfg", "corridor": found.corridor.name})


def test_lanes_of_edges_are_joined_by_their_links(tmp_path: Path) -> None:
    corridor = corridor_of(interchange_network(tmp_path), "main1", "main5")
    assert [(one.name, one.first_lane, len(one.lanes)) for one in corridor.edges] == [
        ("main1", 1, 3),
        ("main2", 0, 4),
        ("main3", 1, 3),
        ("main4", 0, 4),
        ("main5", 1, 3),
    ]
    assert (corridor.lanes, corridor.length_m) == (4, 1960.0 - HANDOVER_M)
    assert not corridor.unused


def test_a_lane_from_outside_is_a_ramp_and_a_lane_that_leads_out_an_exit(tmp_path: Path) -> None:
    corridor = corridor_of(interchange_network(tmp_path), "main1", "main5")
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


def test_a_part_of_the_edges_is_a_corridor_too(tmp_path: Path) -> None:
    corridor = corridor_of(interchange_network(tmp_path), "main3", "main5")
    assert [edge.from_m for edge in corridor.edges] == [0.0, 160.0, 410.0]
    assert corridor.ramps[0].at_m == MIN_AT_M
    assert not corridor.ways_out
    single = corridor_of(interchange_network(tmp_path), "main1", "main1")
    assert (single.lanes, single.closures, single.ramps) == (3, (), ())


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("main1", "FIRST_EDGE:LAST_EDGE"),
        ("main1:", "FIRST_EDGE:LAST_EDGE"),
        ("main1:nowhere", "two edges of the network"),
        ("main5:main1", "0 edges can be reached from main5"),
    ],
)
def test_an_impossible_corridor_is_refused(tmp_path: Path, name: str, expected: str) -> None:
    config = write_interchange(tmp_path, stream(3), types=TRUCKS)
    with pytest.raises(BadInputError, match=expected):
        read_corridor(config, name)


def test_names_of_edges_may_contain_colons(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, stream(3), types=TRUCKS)
    for file in tmp_path.glob("small.*"):
        text = file.read_text(encoding="utf-8")
        file.write_text(re.sub(r"\bmain([15])(?=_|\b)", r"main:\1", text), encoding="utf-8")
    found = read_corridor(config, "main:1:main:5")
    assert found.corridor.name == "main:1:main:5"
    with pytest.raises(BadInputError, match="two edges of the network"):
        read_corridor(config, "main:1:main:6")


def test_what_does_not_fit_is_named_as_in_the_network(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, stream(60), types=TRUCKS)
    found = read_corridor(config, CORRIDOR)
    assert checked(found)
    (ramp,), opening = found.corridor.ramps, found.corridor.closures[0]
    late = evolve(found.corridor, ramps=(evolve(ramp, merge_m=ramp.merge_m + 200.0),))
    with pytest.raises(
        BadInputError, match=r"on-ramp from on of 345 m into lane main4_0 of 50 m \(entrance"
    ):
        checked(evolve(found, corridor=late))
    gives_way = evolve(found.corridor, ramps=(evolve(ramp, path=(), at_m=ramp.merge_m),))
    with pytest.raises(BadInputError, match="on-ramp: got 'on'; allowed: on-ramps whose vehicles"):
        checked(evolve(found, corridor=gives_way))
    others = found.corridor.closures[1:]
    early = evolve(found.corridor, closures=(evolve(opening, to_m=900.0), *others))
    with pytest.raises(
        BadInputError, match=r"exit to off from lane main2_0, open for 46 m \(exit.*longer are"
    ):
        checked(evolve(found, corridor=early))
    closures = tuple(
        evolve(one, from_m=ramp.merge_m + 60.0) if one.from_m > ramp.merge_m else one
        for one in found.corridor.closures
    )
    short = evolve(found.corridor, closures=closures)
    with pytest.raises(BadInputError, match=r"end of lane main4_0|on-ramp from on.*main4_0"):
        checked(evolve(found, corridor=short))


@pytest.mark.parametrize(("accel_mps2", "fits"), [(0.8, True), (0.2, False)])
def test_types_that_are_too_weak_are_named(
    tmp_path: Path, accel_mps2: float, *, fits: bool
) -> None:
    types = f'<vType id="truck" vClass="truck" accel="{accel_mps2}" decel="4" sigma="0"/>'
    config = write_interchange(tmp_path, stream(60), types=types)
    found = read_corridor(config, CORRIDOR)
    if fits:
        assert scenario_tables(found)
        return
    with pytest.raises(BadInputError, match=r"vehicles that accelerate with 0\.2 m/s2"):
        scenario_tables(found)


def test_a_corridor_does_not_end_where_its_lanes_part(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="lane 0 to off; lane 1 to main3"):
        corridor_of(interchange_network(tmp_path), "main1", "main2")


def test_sumo_has_room_to_brake_where_vehicles_give_way_behind_the_corridor(tmp_path: Path) -> None:
    whole = interchange_network(tmp_path)
    brakes_m = braking_m(SPEED_SHARE * MAIN_SPEED_MPS)
    assert brakes_m == pytest.approx(103.1, abs=0.1)

    def with_crossing(length_m: float) -> Network:
        """The exit gives way; behind main5, after `length_m`, is a traffic light."""
        links = [evolve(one, state="m") if one.target.edge == "off" else one for one in whole.links]
        behind, last = (
            Edge(name, (Lane(f"{name}_0", name, 0, length_m, 3.2, 20.0),))
            for name in ("behind", "last")
        )
        links += [Link(lane, behind.lanes[0]) for lane in whole.edges["main5"].lanes]
        links.append(Link(behind.lanes[0], last.lanes[0], traffic_light="L"))
        return Network({**whole.edges, "behind": behind, "last": last}, tuple(links))

    corridor = corridor_of(with_crossing(50.0), "main1", "main5")
    assert corridor.length_m == pytest.approx(1960.0 - brakes_m + 50.0)
    (exit_,) = corridor.ways_out
    assert exit_.at_m == pytest.approx(950.0 - brakes_m)
    assert any((one.lane, one.from_m) == (0, exit_.at_m) for one in corridor.closures)
    far = corridor_of(with_crossing(200.0), "main1", "main5")
    assert far.length_m == 1960.0 - HANDOVER_M
    with pytest.raises(BadInputError, match=r"length of behind: got 50\.0; allowed: at least 58 m"):
        corridor_of(with_crossing(50.0), "main1", "behind")


def test_a_lane_that_begins_just_before_the_end_is_not_used(tmp_path: Path) -> None:
    found = read_corridor(write_interchange(tmp_path, stream(60), types=TRUCKS), CORRIDOR)
    beyond = Closure(0, found.corridor.closures[-1].from_m, found.corridor.length_m - 50.0)
    late = evolve(found.corridor, closures=(*found.corridor.closures[:-1], beyond))
    closures = checked(evolve(found, corridor=late))["road"]["closures"]
    assert closures[-1] == {"lane": 0, "from_m": beyond.from_m}


def test_more_vehicles_than_the_road_carries_wait(tmp_path: Path) -> None:
    crowd = [vehicle(f"m{number}", 1.0, "main") for number in range(9)]
    found = read_corridor(write_interchange(tmp_path, crowd), CORRIDOR)
    assert found.simulation.duration_s == 2.0
    scenario = parse_scenario(checked(found))
    assert scenario.demand.volume_veh_per_lane_h == 3600.0


def test_vehicles_of_a_corridor_prefer_no_lane(tmp_path: Path) -> None:
    """A plain road would otherwise have to be long enough for random preferences."""
    vehicles = [vehicle(f"m{number}", 3.0 * number, "main") for number in range(3)]
    found = read_corridor(write_interchange(tmp_path, vehicles), "main1:main1")
    assert parse_scenario(checked(found)).flow.lane_shares == ()


def test_vehicles_of_a_corridor_do_not_give_way(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="its state is 'm'"):
        corridor_of(interchange_network(tmp_path, state="m"), "main1", "main5")


@pytest.mark.parametrize("text", ["", "<net", "<routes/>"])
def test_a_file_that_is_no_network_is_refused(tmp_path: Path, text: str) -> None:
    config = write_interchange(tmp_path)
    (tmp_path / "small.net.xml").write_text(text, encoding="utf-8")
    with pytest.raises(BadInputError, match="net-file"):
        read_corridor(config, CORRIDOR)


def test_the_longest_chain_with_priority_is_found(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, [vehicle("r", 0.0, "ramp")])
    simulation = read_simulation(config)
    (found,) = find_corridors(simulation)
    assert (found.name, found.volume_veh_per_h) == (LONGEST_CORRIDOR, 3600.0)
    without = evolve(simulation, network=interchange_network(tmp_path, state="m"))
    assert {one.name for one in find_corridors(without)} == {"start:main4", "main5:main5"}
    (found,) = find_corridors(evolve(simulation, network=ring(4)))
    assert found.name == "e0:e3"
    assert found.found is not None
    assert found.found.corridor.length_m == 1200.0 - HANDOVER_M


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


def test_a_ramp_with_two_lanes_is_refused_in_words_of_the_network(tmp_path: Path) -> None:
    whole = interchange_network(tmp_path)
    on, main4 = whole.edges["on"], whole.edges["main4"]
    second = evolve(on.lanes[0], name="on_1", index=1)
    edges = {**whole.edges, "on": evolve(on, lanes=(*on.lanes, second))}
    links = [link for link in whole.links if link.target.name != "main4_1"]
    links.append(Link(second, main4.lanes[1]))
    with pytest.raises(BadInputError, match="on-ramps of one lane, but 2 lanes of on lead"):
        corridor_of(Network(edges, tuple(links)), "main1", "main5")


def test_a_ramp_in_line_with_a_lane_that_is_open_at_the_start_is_refused(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, stream(60), types=TRUCKS)
    found = read_corridor(config, CORRIDOR)
    closures = found.corridor.closures[1:]
    with pytest.raises(BadInputError, match="begin the corridor on a later edge"):
        checked(evolve(found, corridor=evolve(found.corridor, closures=closures)))


def test_vehicles_that_are_too_wide_are_named(tmp_path: Path) -> None:
    types = '<vType id="truck" vClass="truck" width="2.9" sigma="0"/>'
    found = read_corridor(write_interchange(tmp_path, stream(60), types=types), CORRIDOR)
    expected = r"width of vehicles of class truck: got 2\.9; allowed: at most 2\.7 m"
    with pytest.raises(BadInputError, match=expected):
        scenario_tables(found)


def test_the_tables_are_a_valid_scenario(tmp_path: Path) -> None:
    found = read_corridor(write_interchange(tmp_path, stream(90), types=TRUCKS), CORRIDOR)
    scenario = parse_scenario(scenario_tables(found))
    assert scenario.geometry.shared_exit_lanes == {0}
    assert scenario.formation.speed_mps == 25.0
    assert not scenario.formation.change_columns
    truck = scenario.types["truck"].limits
    assert (truck.length_m, truck.max_accel_mps2) == (7.1, 1.3)
    # SUMO's trucks brake with 7 m/s2 in an emergency.
    assert truck.min_accel_mps2 == -7.0
    assert scenario.entrance[0].volume_veh_per_h == pytest.approx(600.0, rel=0.05)


def test_a_corridor_that_nobody_enters_at_its_start_is_refused(tmp_path: Path) -> None:
    config = write_interchange(tmp_path, [vehicle("r", 0.0, "ramp")])
    found = read_corridor(config, CORRIDOR)
    with pytest.raises(BadInputError, match="a corridor that vehicles enter on main1"):
        scenario_tables(found)
