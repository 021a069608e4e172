"""The tables of a scenario: the paper's defaults, and the allowed values of each field."""

from __future__ import annotations

import inspect
import math
from pathlib import Path
from typing import Any

import attrs
import pytest

from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from support.refusals import refusal
from support.tables import for_each

FOLDER = Path(__file__).parents[4] / "scenarios"
TABLES = [
    attribute.name for attribute in attrs.fields(Scenario) if attrs.has(type(attribute.default))
]


def nested(dotted: str, value: object) -> dict[str, Any]:
    *tables, key = dotted.split(".")
    data: dict[str, Any] = {key: value}
    for table in reversed(tables):
        data = {table: data}
    return data


# --- defaults and what follows from them -----------------------------------------------------


def test_defaults_are_the_table_of_the_paper() -> None:
    scenario = load_scenario(None)
    formation, vehicle, road = scenario.formation, scenario.vehicle, scenario.road
    assert formation.gap_m == 15.0
    assert scenario.timing.cycles_s == (4.0, 7.0)
    assert formation.speed_mps == 15.0
    assert vehicle.max_speed_mps == 25.0
    assert vehicle.min_accel_mps2 == -10.0
    assert vehicle.max_accel_mps2 == 5.0
    assert (road.s1_m, road.s2_m, road.s3_m) == (50.0, 350.0, 600.0)
    assert road.lanes == 3
    assert formation.max_vehicles == 6
    assert formation.mode == 1
    assert formation.conflict_kinds == ("node", "edge", "special-1", "closing")
    assert FormationSettings(mode=2).conflict_kinds == ("geometric", "closing")
    assert scenario.demand.volume_veh_per_lane_h == 1000.0
    assert road.length_m == 1000.0
    assert road.sorting_start_m == 400.0
    assert scenario.flow.lane_shares == pytest.approx((1 / 3,) * 3)


@pytest.mark.parametrize(
    ("formation", "bound"),
    [
        ({"operation": "paper"}, 1800.0),
        ({"operation": "paper", "gap_m": 20.0}, 1350.0),
        ({}, 3600.0),
        ({"operation": "rolling"}, 3600.0),
    ],
)
def test_bound_of_the_road(formation: dict[str, Any], bound: float) -> None:
    """V_u = 3600 v_F / (2 d_F) of the paper, for interlaced entry."""
    settings = parse_scenario({"formation": formation}).formation
    assert settings.bound_veh_per_lane_h == pytest.approx(bound)
    share = 2.0 if settings.interlaced else 1.0
    assert bound == pytest.approx(3600.0 * settings.speed_mps / (share * settings.gap_m))


def test_the_file_of_the_paper_holds_the_defaults_but_for_its_formations() -> None:
    explicit = ("node", "edge", "special-1", "closing")
    default = Scenario()
    formation = attrs.evolve(
        default.formation,
        entry="interlaced",
        close="columns",
        cycle_s=4.0,
        move_s=3.8,
        targets="parallel",
        solver="tappa",
        conflicts=explicit,
    )
    runtime = attrs.evolve(default.runtime, hold_period_ticks=1)
    expected = attrs.evolve(default, formation=formation, runtime=runtime)
    assert load_scenario(FOLDER / "paper.toml") == expected


def test_the_lattice_is_that_of_the_tables() -> None:
    formation = {"close": "columns", "block_columns": 6}
    lattice = parse_scenario({"road": {"lanes": 2}, "formation": formation}).lattice
    assert (lattice.lanes, lattice.block_columns) == (2, 6)
    assert Scenario().lattice.block_columns == 1
    assert (lattice.pitch_m, lattice.speed_mps, lattice.lane_width_m) == (15.0, 15.0, 3.5)


def test_lane_shares_sum_to_one() -> None:
    scenario = parse_scenario({"demand": {"lane_shares": [2, 1, 1]}})
    assert scenario.flow.lane_shares == (0.5, 0.25, 0.25)


def test_slots_are_from_four_to_seven_seconds_unless_they_are_given() -> None:
    scenario = Scenario()
    assert scenario.timing.slots_s == pytest.approx([4.0 + 0.2 * number for number in range(16)])
    assert scenario.timing.move_durations == set(range(38, 70, 2))
    assert (scenario.timing.move_s, scenario.timing.horizon_ticks) == (3.8, 70)
    given = parse_scenario({"formation": {"cycle_s": 5.0}})
    timing = given.timing
    assert (timing.slots_s, timing.horizon_ticks, timing.move_s) == ((5.0,), 50, 4.8)
    assert timing.move_durations == {48}
    slower = parse_scenario({"formation": {"cycle_s": 5.0, "move_s": 4.0}})
    assert slower.timing.move_durations == {40}
    rolling = parse_scenario({"formation": {"operation": "rolling"}})
    assert (rolling.timing.slots_s, rolling.timing.horizon_ticks) == ((6.0,), 60)
    for volume, slot_s in ((2000.0, 6.0), (2000.1, 5.4), (2200.0, 5.4), (2200.1, 5.0)):
        dense = parse_scenario(
            {"formation": {"operation": "rolling"}, "demand": {"volume_veh_per_lane_h": volume}}
        )
        assert dense.timing.slots_s == (slot_s,)
        assert dense.timing.horizon_ticks == round(slot_s / dense.runtime.tick_s)
    long = parse_scenario({"tracking": {"horizon_ticks": 80}})
    assert long.timing.horizon_ticks == 80


# --- one field that is wrong ------------------------------------------------------------------

LEAVES = [
    (f"{table}.{attribute.name}", attribute.default)
    for table in TABLES
    for attribute in attrs.fields(type(getattr(Scenario(), table)))
]
TABLE_BY_NAME: type = type(attrs.Factory(dict))
NOT_NUMBERS: tuple[Any, ...] = ("1", True, None, [], [1], {}, math.nan, math.inf, -math.inf)


@for_each("table", ["", *(f"{table}." for table in TABLES)])
def test_an_unknown_key_is_refused_by_name(table: str) -> None:
    error = refusal(parse_scenario, nested(f"{table}speling", 1))
    assert error.field == f"{table}speling"
    assert "one of" in error.allowed


@for_each("table", TABLES)
@for_each("value", [5, "x", True, None, [], [{}], 1.5])
def test_a_table_that_is_none_is_refused(table: str, value: object) -> None:
    assert refusal(parse_scenario, {table: value}).field == table


@for_each(("field", "default"), LEAVES)
def test_every_wrong_type_of_every_field_is_refused_by_name(field: str, default: object) -> None:
    if isinstance(default, str):
        wrongs: tuple[Any, ...] = (1, True, None, [], {}, 1.5)
    elif isinstance(default, tuple):
        wrongs = (1, True, None, "node", {}, {"a": 1}, [True], [[]], [None], [math.nan], [{}])
    elif isinstance(default, TABLE_BY_NAME):
        wrongs = (1, True, None, [], "x", 1.5, {"a": 1}, {"a": []}, {"a": "x"}, {"a": [1]})
    elif field == "formation.solver":
        wrongs = (1, True, [], {}, 1.5)
    elif field in (
        "formation.cycle_s",
        "sumo.begin_s",
        "sumo.scale",
        "formation.planning_deadline_s",
        "lc2013.accel_mps2",
        "lc2013.decel_mps2",
    ):
        wrongs = tuple(wrong for wrong in NOT_NUMBERS if wrong is not None)
    elif default is None:
        wrongs = ("1", True, 1.0, [], {}, math.nan)
    elif isinstance(default, bool):
        wrongs = (0, 1, 1.0, "true", None, [], {}, math.nan)
    elif isinstance(default, int):
        wrongs = (*NOT_NUMBERS, 1.0, 16**5000)
    else:
        wrongs = (*NOT_NUMBERS, 10**400, -(10**400), 16**5000)
    for wrong in wrongs:
        assert refusal(parse_scenario, nested(field, wrong)).field.split("[")[0] == field, wrong


def beyond(attribute: attrs.Attribute[Any]) -> list[Any]:
    """Return values outside of a field's range or choices, which docs/SCENARIO.md lists."""
    rule = getattr(attribute.validator, "validator", attribute.validator)
    known = inspect.getclosurevars(rule).nonlocals if rule is not None else {}
    if "low" in known:
        return [known["low"] - 1, known["high"] + 1, *[known["low"]] * known["open_low"]]
    return ["magic", 4] if "choices" in known else []


OUT_OF_RANGE = {
    f"{table}.{attribute.name}": beyond(attribute)
    for table in TABLES
    for attribute in attrs.fields(type(getattr(Scenario(), table)))
    if beyond(attribute)
} | {
    "schema": ["laneweave.scenario/2"],
    "seed": [-1, 2**63],
    "formation.conflicts": [["nod"], ["node", ""]],
    "network.realm": ["", "a/b", "*", "a b", "x" * 65, "é", "a\n"],
}


@for_each(("field", "values"), OUT_OF_RANGE.items())
def test_values_out_of_range_are_refused_by_name(field: str, values: list[Any]) -> None:
    for value in values:
        assert refusal(parse_scenario, nested(field, value)).field == field, value
