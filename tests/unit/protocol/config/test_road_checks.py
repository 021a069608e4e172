"""Ramps, exits and destinations that are not possible are refused in one line."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, sections_for
from support.tables import for_each

Tables = dict[str, Any]
WEAVING: Tables = {
    "road": {
        "lanes": 4,
        "s1_m": 50.0,
        "s2_m": 100.0,
        "s3_m": 850.0,
        "closures": [{"lane": 0, "to_m": 250.0}, {"lane": 0, "from_m": 700.0}],
    },
    "entrance": [
        {"name": "on", "lane": 0, "at_m": 250.0, "merge_m": 400.0, "volume_veh_per_h": 600.0}
    ],
    "exit": [{"name": "off", "lanes": [0], "at_m": 700.0}],
    "demand": {"destinations": [{"exit": "off", "share": 0.2}]},
    "formation": {"operation": "rolling"},
}


def entrance(**fields: object) -> Callable[[Tables], object]:
    return lambda tables: tables["entrance"][0].update(fields)


def exit_(**fields: object) -> Callable[[Tables], object]:
    return lambda tables: tables["exit"][0].update(fields)


def to(*shares: tuple[str, float]) -> Callable[[Tables], object]:
    listed = [{"exit": name, "share": share} for name, share in shares]
    return lambda tables: tables["demand"].update(destinations=listed)


def shares(**fields: object) -> Callable[[Tables], object]:
    return lambda tables: tables["demand"].update(fields)


def twice(table: str) -> Callable[[Tables], object]:
    return lambda tables: tables[table].append(tables[table][0])


def ends_at(end_m: float) -> Callable[[Tables], object]:
    def change(tables: Tables) -> None:
        tables["road"]["closures"][1]["from_m"] = end_m
        tables["exit"][0]["at_m"] = end_m

    return change


PART = {"from_m": 400.0, "to_m": 450.0, "at_s": 5.0}
OTHER = {"from_m": 400.0, "to_m": 407.0, "at_s": 5.0, "speed_mps": 5.0}
"""An event of the road, but for its lane."""


@for_each(("change", "line"), [
        (entrance(lane=1), "entrance[0].lane: got 1"),
        (entrance(at_m=300.0), "entrance[0].at_m: got 300.0; allowed: 250"),
        (entrance(merge_m=300.0), "entrance[0].merge_m: got 300.0; allowed: from 400"),
        (entrance(merge_m=650.0), "entrance[0].merge_m: got 650.0"),
        (entrance(name="main"), "entrance[0].name: got 'main'"),
        (entrance(volume_veh_per_h=4000.0), "entrance[0].volume_veh_per_h"),
        (twice("entrance"), "entrance[1].name: got 'on'"),
        (exit_(lanes=[1]), "exit[0].lanes: got [1]"),
        (exit_(lanes=[]), "exit[0].lanes: got []"),
        (exit_(at_m=650.0), "exit[0].lanes: got [0]"),
        (exit_(name="end"), "exit[0].name: got 'end'"),
        (exit_(name="lane-1"), "exit[0].name: got 'lane-1'"),
        (twice("exit"), "exit[1].name: got 'off'"),
        (
            lambda tables: tables.update(vehicle={"max_accel_mps2": 0.2}),
            "vehicle.max_accel_mps2: got 0.2",
        ),
        (
            lambda tables: (
                tables["road"].update(closures=[{"lane": 0}]),
                tables.update(exit=[], demand={}),
                tables["entrance"][0].update(at_m=60_000.0, merge_m=60_000.0),
            ),
            "entrance[0].merge_m: got 60000.0",
        ),
        (entrance(lane_shares=[0, 1, 1, 1]), "entrance[0].lane_shares: got [0.0, 1.0, 1.0, 1.0]"),
        (shares(lane_shares=[0, 1, 1]), "demand.lane_shares: got [0.0, 1.0, 1.0]; allowed: one"),
        (shares(arrival_shares=[1, 1, 1, 1]), "demand.arrival_shares: got [1.0, 1.0, 1.0, 1.0]"),
        (shares(arrival_shares=[0, 0, 0, 0]), "demand.arrival_shares: got [0.0, 0.0, 0.0, 0.0]"),
        (
            shares(arrival_shares=[0, 0, 0, 1], volume_veh_per_lane_h=1300.0),
            "demand.volume_veh_per_lane_h: got 1300.0; allowed: at most 3600 vehicles per hour in",
        ),
        (
            lambda tables: (
                tables["demand"].update(volume_veh_per_lane_h=1200.0, arrival_shares=[0, 1, 0, 0]),
                tables["formation"].update(gap_m=20.0),
            ),
            "demand.volume_veh_per_lane_h: got 1200.0; allowed: at most 2700 vehicles per hour in",
        ),
        (
            entrance(vehicle_types=[{"type": "truck", "share": 0.5}]),
            "entrance[0].vehicle_types[0].type: got 'truck'; allowed: none",
        ),
        (ends_at(510.0), "exit[0].at_m: got 510.0; allowed: at least 515"),
        (to(("nowhere", 0.5)), "demand.destinations.exit: got 'nowhere'; allowed: an exit: off"),
        (to(("off", 0.7), ("off", 0.6)), "demand.destinations"),
        (
            lambda tables: tables.update(exit=[], demand={"volume_veh_per_lane_h": 3590.0}),
            "demand.volume_veh_per_lane_h: got 3590.0; allowed: at most 3400",
        ),
        (
            lambda tables: tables["road"].update(s2_m=450.0, s3_m=500.0),
            "demand.destinations: got 'off'",
        ),
        (
            lambda tables: tables["road"].update(
                closures=[{"lane": lane} for lane in range(4)]
            ),
            "road.closures",
        ),
        *(
            (lambda tables, event=event: tables["road"].update(events=[event]), problem)
            for event, problem in (
                ({"lane": 4} | PART, "road.events[0].lane: got 4; allowed: a lane from 0 to 3"),
                ({"lane": 1} | PART | {"to_m": 300.0}, "road.events[0].to_m: got 300.0; allowed: "),
                ({"lane": 1} | PART | {"until_s": 5.0}, "road.events[0].until_s: got 5.0; allowed"),
                ({"lane": 1} | PART | {"to_m": 9e3}, "road.events[0].from_m: got 400.0; allowed: "),
                ({"lane": 0} | OTHER, "road.events[0].lane: got 0; allowed: a lane without ends"),
                ({"lane": 1} | OTHER | {"to_m": 450.0}, "road.events[0].to_m: got 450.0; allowed"),
                ({"lane": 1} | OTHER | {"from_m": 9.0, "to_m": 9.5}, "road.events[0].from_m: got"),
                ({"lane": 1} | OTHER | {"speed_mps": 99.0}, "road.events[0].speed_mps: got 99.0"),
            )
        ),
        (
            lambda tables: tables.update(formation={"max_columns": 14}),
            "exit[0].at_m: got 700.0; allowed: at least 710: a formation that has passed",
        ),
    ])  # fmt: skip
def test_roads_that_are_not_possible_are_refused_in_one_line(
    change: Callable[[Tables], object], line: str
) -> None:
    tables = copy.deepcopy(WEAVING)
    change(tables)
    with pytest.raises(BadInputError) as caught:
        parse_scenario(tables)
    (text,) = str(caught.value).splitlines()
    assert line in text


def test_sections_begin_at_ramps_and_end_at_exits() -> None:
    sections = parse_scenario(WEAVING).geometry.sections
    first = sections[0]
    assert (first.lane, first.from_m, first.to_m, first.exit) == (0, 250.0, 700.0, "off")
    assert first.moves_from_m == 400.0
    assert [section.exit for section in sections[1:]] == ["lane-1", "lane-2", "lane-3"]
    assert sections_for(sections, 0, "off") == {0}
    assert sections_for(sections, ANY_LANE, END_OF_ROAD) == {1, 2, 3}
    assert sections_for(sections, 2, END_OF_ROAD) == {2}


def test_the_time_at_v_f_counts_from_the_entrance_to_the_destination() -> None:
    scenario = parse_scenario(WEAVING)
    assert scenario.geometry.free_flow_trip_s(0) == pytest.approx(50.0)
    assert scenario.geometry.free_flow_trip_s(1, "off") == pytest.approx(700.0 / 15.0)
    assert [one.entrance for one in scenario.geometry.entry_points] == [
        "on",
        "main",
        "main",
        "main",
    ]


@pytest.mark.parametrize(
    ("merge_m", "formation", "volume", "slot_s"),
    [
        (400.0, {}, 1600.0, 5.0),  # 300 m take 20 s
        (300.0, {}, 1600.0, 6.0),
        (520.0, {}, 1600.0, 4.0),
        (520.0, {"gap_m": 20.0}, 1600.0, 5.2),
        (400.0, {}, 2300.0, 5.0),
        (300.0, {}, 2300.0, 5.0),
        (400.0, {"gap_m": 20.0}, 2300.0, 5.2),
        (400.0, {"cycle_s": 6.0}, 1600.0, 6.0),
    ],
)
def test_slots_are_short_enough_for_the_lanes_of_ramps(
    merge_m: float, formation: dict[str, float], volume: float, slot_s: float
) -> None:
    tables = copy.deepcopy(WEAVING)
    tables["entrance"][0].update(at_m=100.0, merge_m=merge_m, volume_veh_per_h=100.0)
    tables["road"]["closures"][0].update(to_m=100.0)
    tables["formation"].update(formation)
    tables["demand"] = {"volume_veh_per_lane_h": volume}
    assert parse_scenario(tables).timing.cycles_s == pytest.approx((slot_s, slot_s))
