"""The scenario: the paper's defaults, and one readable line for everything that is wrong."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import attrs
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.protocol.config.loading import load_scenario, parse_scenario, read_toml, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.tables import FormationSettings, Scenario

FOLDER = Path(__file__).parents[4] / "scenarios"
TABLES = [
    attribute.name for attribute in attrs.fields(Scenario) if attrs.has(type(attribute.default))
]


def refusal(data: dict[str, Any]) -> BadInputError:
    with pytest.raises(BadInputError) as caught:
        parse_scenario(data)
    assert_readable(caught.value)
    return caught.value


def assert_readable(error: BadInputError) -> None:
    line = str(error)
    assert len(line.splitlines()) == 1
    assert line.isprintable()
    assert line.startswith(re.split(r"[\n\x1b]", error.field)[0])
    assert "; allowed: " in line
    for jargon in ("object has no", "not iterable", "argument of type", "unhashable"):
        assert jargon not in line


def nested(dotted: str, value: object) -> dict[str, Any]:
    *tables, key = dotted.split(".")
    data: dict[str, Any] = {key: value}
    for table in reversed(tables):
        data = {table: data}
    return data


# --- defaults ---------------------------------------------------------------------------------


def test_defaults_are_the_table_of_the_paper() -> None:
    scenario = load_scenario(None)
    formation, vehicle, road = scenario.formation, scenario.vehicle, scenario.road
    assert formation.gap_m == 15.0
    assert scenario.cycles_s == (4.0, 7.0)
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
    assert scenario.lane_shares == pytest.approx((1 / 3,) * 3)


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
        conflicts=explicit,
    )
    assert load_scenario(FOLDER / "paper.toml") == attrs.evolve(default, formation=formation)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_every_scenario_of_the_repository_loads(path: Path) -> None:
    assert load_scenario(path).schema == "laneweave.scenario/1"


def test_the_lattice_is_that_of_the_tables() -> None:
    formation = {"close": "columns", "block_columns": 6}
    lattice = parse_scenario({"road": {"lanes": 2}, "formation": formation}).lattice
    assert (lattice.lanes, lattice.block_columns) == (2, 6)
    assert Scenario().lattice.block_columns == 1
    assert (lattice.pitch_m, lattice.speed_mps, lattice.lane_width_m) == (15.0, 15.0, 3.5)


# --- one field that is wrong ------------------------------------------------------------------

LEAVES = [
    (f"{table}.{attribute.name}", attribute.default)
    for table in TABLES
    for attribute in attrs.fields(type(getattr(Scenario(), table)))
]
TABLE_BY_NAME: type = type(attrs.Factory(dict))
NOT_NUMBERS: tuple[Any, ...] = ("1", True, None, [], [1], {}, math.nan, math.inf, -math.inf)


@pytest.mark.parametrize("table", ["", *(f"{table}." for table in TABLES)])
def test_an_unknown_key_is_refused_by_name(table: str) -> None:
    error = refusal(nested(f"{table}speling", 1))
    assert error.field == f"{table}speling"
    assert "one of" in error.allowed


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("value", [5, "x", True, None, [], [{}], 1.5])
def test_a_table_that_is_none_is_refused(table: str, value: object) -> None:
    assert refusal({table: value}).field == table


@pytest.mark.parametrize(("field", "default"), LEAVES, ids=[field for field, _ in LEAVES])
def test_every_wrong_type_of_every_field_is_refused_by_name(field: str, default: object) -> None:
    if isinstance(default, str):
        wrongs: tuple[Any, ...] = (1, True, None, [], {}, 1.5)
    elif isinstance(default, tuple):
        wrongs = (1, True, None, "node", {}, {"a": 1}, [True], [[]], [None], [math.nan], [{}])
    elif isinstance(default, TABLE_BY_NAME):
        wrongs = (1, True, None, [], "x", 1.5, {"a": 1}, {"a": []}, {"a": "x"}, {"a": [1]})
    elif field in ("formation.cycle_s", "formation.planning_deadline_s"):
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
        assert refusal(nested(field, wrong)).field.split("[")[0] == field, wrong


OUT_OF_RANGE: list[tuple[str, Any]] = [
    ("schema", "laneweave.scenario/2"),
    ("schema", 1),
    ("seed", -1),
    ("seed", 2**63),
    ("seed", 1.0),
    ("seed", 10**400),
    ("road.lanes", 0),
    ("road.lanes", 9),
    ("road.lanes", -3),
    ("road.lane_width_m", 1.9),
    ("road.lane_width_m", 10.1),
    ("road.s1_m", -0.1),
    ("road.s2_m", 20_001),
    ("road.s3_m", 0),
    ("demand.volume_veh_per_lane_h", -5),
    ("demand.volume_veh_per_lane_h", 0),
    ("demand.volume_veh_per_lane_h", 5000),
    ("demand.volume_veh_per_lane_h", math.nan),
    ("demand.duration_s", 0),
    ("demand.duration_s", 86_401),
    ("demand.min_headway_s", -1),
    ("demand.min_headway_s", 61),
    ("formation.gap_m", 0.5),
    ("formation.cycle_s", 0.4),
    ("formation.move_s", 61),
    ("formation.speed_mps", 0),
    ("formation.block_columns", 0),
    ("formation.block_columns", 25),
    ("formation.max_vehicles", 0),
    ("formation.max_vehicles", 37),
    ("formation.mode", 0),
    ("formation.mode", 3),
    ("formation.conflicts", ["nod"]),
    ("formation.conflicts", ["node", ""]),
    ("formation.weight_straight", 2),
    ("formation.weight_oblique", 3),
    ("formation.weight_oblique", -1),
    ("formation.solver", "magic"),
    ("formation.solver", None),
    ("formation.planning_deadline_s", 0),
    ("formation.max_nodes", 0),
    ("vehicle.length_m", 0.9),
    ("vehicle.width_m", 4.5),
    ("vehicle.max_speed_mps", 81),
    ("vehicle.min_accel_mps2", 0),
    ("vehicle.min_accel_mps2", 10),
    ("vehicle.max_accel_mps2", 0),
    ("vehicle.max_jerk_mps3", 0),
    ("vehicle.max_lateral_accel_mps2", -1),
    ("vehicle.max_lateral_jerk_mps3", 101),
    ("vehicle.max_slip_ratio", 0),
    ("vehicle.max_slip_ratio", 1.01),
    ("tracking.horizon_ticks", 9),
    ("tracking.horizon_ticks", 201),
    ("tracking.min_gap_m", -1),
    ("network.realm", ""),
    ("network.realm", "a/b"),
    ("network.realm", "*"),
    ("network.realm", "a b"),
    ("network.realm", "x" * 65),
    ("network.realm", "é"),
    ("network.realm", "a\n"),
    ("network.lease_s", 0),
    ("network.heartbeat_s", 0),
    ("network.election_s", 61),
    ("network.resend_s", 0),
    ("runtime.tick_s", 0),
    ("runtime.tick_s", 1.1),
    ("runtime.tick_resend_s", 0),
    ("runtime.tick_deadline_s", 0),
    ("runtime.agent_silent_s", 0),
    ("runtime.agent_start_s", 121),
    ("runtime.announce_s", -1),
    ("runtime.coordinators", 0),
    ("runtime.coordinators", 10),
    ("runtime.vehicles_per_process", 0),
    ("runtime.max_road_s", 0),
]


@pytest.mark.parametrize(("field", "value"), OUT_OF_RANGE)
def test_a_value_out_of_range_is_refused_by_name(field: str, value: object) -> None:
    assert refusal(nested(field, value)).field == field


# --- fields that do not fit together ----------------------------------------------------------

LATE = {"reaction_s": 0.4}
FOUR = {"cycle_s": 4.0}
MISFITS: list[tuple[str, dict[str, Any]]] = [
    ("formation.settle_s", {"formation": {"settle_s": 3.1}}),
    ("formation.settle_s", {"formation": {"settle_s": 5.0, "operation": "paper"}}),
    ("formation.settle_s", {"vehicle": {"max_speed_mps": 15.5}, "formation": {"settle_s": 28.1}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [0.5, 0.5]}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [1, 1, 1, 1]}}),
    ("demand.lane_shares", {"road": {"lanes": 2}, "demand": {"lane_shares": [1, 1, 1]}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [0, 0, 0]}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [1, -1, 1]}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [1e308, 1e308, 1e308]}}),
    ("road.lane_width_m", {"road": {"lane_width_m": 2.0}, "vehicle": {"width_m": 2.0}}),
    ("road.lane_width_m", {"road": {"lane_width_m": 2.0}, "vehicle": {"width_m": 3.0}}),
    ("road.lane_width_m", {"road": {"lane_width_m": 2.25}}),
    (
        "demand.volume_veh_per_lane_h",
        {"demand": {"volume_veh_per_lane_h": 3600, "min_headway_s": 1.01}},
    ),
    ("demand.volume_veh_per_lane_h", {"demand": {"min_headway_s": 60}}),
    ("formation.gap_m", {"formation": {"gap_m": 5.0}}),
    ("formation.gap_m", {"vehicle": {"length_m": 30.0}}),
    ("formation.move_s", {"formation": {"move_s": 3.8}}),
    ("formation.move_s", {"formation": {"cycle_s": 4.0, "move_s": 4.1}}),
    ("formation.move_s", {"formation": {"cycle_s": 3.0, "move_s": 3.8}}),
    ("formation.move_s", {"formation": {"operation": "rolling", "move_s": 3.8}}),
    ("formation.speed_mps", {"formation": {"speed_mps": 25.0}}),
    ("formation.speed_mps", {"vehicle": {"max_speed_mps": 10.0}}),
    (
        "formation.weight_oblique",
        {"formation": {"mode": 2, "weight_oblique": 2}},
    ),
    ("road.s3_m", {"road": {"s3_m": 100.0}}),
    ("road.s3_m", {"formation": {"close": "columns", "block_columns": 24, "gap_m": 30.0}}),
    ("road.s3_m", {"formation": {"max_columns": 24, "gap_m": 30.0}}),
    ("formation.conflicts", {"formation": {"conflicts": ["node"]}}),
    ("formation.conflicts", {"formation": {"conflicts": ["node", "edge"]}}),
    (
        "formation.conflicts",
        {"formation": {"mode": 2, "conflicts": ["node", "edge", "special-1"]}},
    ),
    ("network.election_s", {"network": {"election_s": 0.2, "heartbeat_s": 0.1}}),
    ("network.election_s", {"network": {"heartbeat_s": 5.0}}),
    (
        "network.lease_s",
        {"network": {"lease_s": 0.5, "heartbeat_s": 0.5, "election_s": 2.0}},
    ),
    ("formation.cycle_s", {"formation": {"cycle_s": 4.05}}),
    ("formation.move_s", {"formation": {"cycle_s": 4.0, "move_s": 3.85}}),
    ("formation.cycle_s", {"runtime": {"tick_s": 0.3}}),
    ("formation.move_s", {"runtime": {"tick_s": 1.0}}),
    ("formation.cycle_s", {"formation": {"cycle_s": 1.0, "move_s": 1.0}, "runtime": {"tick_s": 1}}),
    ("tracking.horizon_ticks", {"tracking": {"horizon_ticks": 67}}),
    ("tracking.horizon_ticks", {"tracking": {"horizon_ticks": 37}, "formation": FOUR}),
    ("runtime.tick_s", {"runtime": {"tick_s": 0.01}, "tracking": {}}),
    ("network.lease_s", {"network": {"lease_s": 3.1}}),
    ("network.lease_s", {"runtime": {"agent_silent_s": 0.9}}),
    ("runtime.tick_resend_s", {"runtime": {"tick_resend_s": 0.3}}),
    ("runtime.tick_resend_s", {"runtime": {"tick_deadline_s": 0.05}}),
    ("runtime.tick_deadline_s", {"runtime": {"tick_deadline_s": 3.1}}),
    ("runtime.tick_deadline_s", {"runtime": {"tick_deadline_s": 2.0, "agent_silent_s": 1.5}}),
    ("braking.reaction_s", {"braking": {"reaction_s": 0.09}}),
    ("braking.reaction_s", {"runtime": {"tick_s": 0.2}}),
    ("formation.gap_m", {"formation": {"gap_m": 14.0, "speed_mps": 24.0}, "braking": LATE}),
    ("formation.gap_m", {"braking": {"reaction_s": 0.7}}),
    ("formation.gap_m", {"braking": {"margin_m": 9.0}}),
    ("braking.reaction_s", {"braking": {"reaction_s": 0.15}}),
    ("formation.gap_m", {"sensing": {"other_speed_noise_mps": 1.5}}),
    (
        "formation.gap_m",
        {"braking": {"lead_brake_mps2": 30.0}, "vehicle": {"min_accel_mps2": -5.0}},
    ),
]


def test_there_is_time_to_settle() -> None:
    """The longest way is three quarters of a column, or twice as much with interlaced entry."""
    for settling in (
        {"settle_s": 3.7},
        {"settle_s": 5.2, "operation": "paper"},
        {"settle_s": 3.2, "operation": "rolling"},
    ):
        parse_scenario({"formation": settling})
    slow = {"max_speed_mps": 15.5}
    parse_scenario({"vehicle": slow, "formation": {"settle_s": 28.2, "operation": "rolling"}})


@pytest.mark.parametrize(("field", "data"), MISFITS)
def test_fields_that_do_not_fit_are_refused_by_name(field: str, data: dict[str, Any]) -> None:
    assert refusal(data).field == field


@pytest.mark.parametrize(
    "data",
    [
        {"demand": {"lane_shares": [1, 0, 0]}},
        {"demand": {"volume_veh_per_lane_h": 3600, "min_headway_s": 1.0}},
        {"formation": FOUR | {"move_s": 4.0}},
        {"formation": {"cycle_s": 3.9}},
        {"formation": {"operation": "rolling", "cycle_s": 6.0}},
        {"formation": {"mode": 2}},
        {"formation": {"mode": 2, "weight_oblique": 1}},
        {"formation": {"conflicts": ["geometric"]}},
        {"road": {"lanes": 1}},
        {"tracking": {"horizon_ticks": 68}},
        {"tracking": {"horizon_ticks": 38}, "formation": FOUR},
        {"tracking": {"horizon_ticks": 38}, "formation": {"operation": "paper"}},
        {"tracking": {"horizon_ticks": 58}, "formation": {"operation": "rolling"}},
        {"network": {"lease_s": 3.0}},
        {"runtime": {"tick_deadline_s": 3.0}},
        {"runtime": {"tick_resend_s": 0.29}},
        {"runtime": {"tick_s": 0.05}, "tracking": {"horizon_ticks": 136}},
        {"runtime": {"tick_s": 0.2}, "braking": {"reaction_s": 0.2}},
        {"formation": {"gap_m": 8.0}},
        {"braking": {"reaction_s": 0.5}},
        {"seed": 2**63 - 1},
        {"road": {}},
    ],
)
def test_what_just_fits_is_taken(data: dict[str, Any]) -> None:
    parse_scenario(data)


def test_lane_shares_sum_to_one() -> None:
    scenario = parse_scenario({"demand": {"lane_shares": [2, 1, 1]}})
    assert scenario.lane_shares == (0.5, 0.25, 0.25)


# --- files ------------------------------------------------------------------------------------


def file_refusal(path: Path) -> BadInputError:
    with pytest.raises(BadInputError) as caught:
        load_scenario(path)
    assert_readable(caught.value)
    return caught.value


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    assert file_refusal(tmp_path / "none.toml").field == "file"
    assert file_refusal(Path("a\0b")).field == "file"


def test_a_folder_is_refused(tmp_path: Path) -> None:
    assert file_refusal(tmp_path).field == "file"


@pytest.mark.parametrize(
    "content",
    [
        b"seed = ",
        b"seed 1",
        b"\xff\xfe",
        b"seed = 1\nseed = 2",
        b"[road\nlanes = 3",
        b"\x00",
        b"{}",
        b"seed = " + b"9" * 5000,
        b"seed = " + b"[" * 5000,
        b"road.lanes = 3\nroad = 1",
    ],
    ids=range(10),
)
def test_what_is_no_toml_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.toml"
    path.write_bytes(content)
    assert file_refusal(path).field == "file"


def test_values_that_toml_allows_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    for line, field in (
        ("seed = 0x" + "f" * 5000, "seed"),
        ("seed = 1979-05-27", "seed"),
        ("[road]\nlanes = nan", "road.lanes"),
        ("[demand]\nvolume_veh_per_lane_h = inf", "demand.volume_veh_per_lane_h"),
        ("[[road]]\nlanes = 3", "road"),
        ('"a\\nb" = 1', "a\nb"),
        ('[road]\n"a\\u001b[2J" = 1', "road.a\x1b[2J"),
    ):
        path.write_text(line, encoding="utf-8")
        assert file_refusal(path).field == field


def test_an_empty_file_is_the_default(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("", encoding="utf-8")
    assert load_scenario(path) == Scenario()


# --- values of a file that would have no effect -----------------------------------------------

INERT = [
    ("formation.sort_in_s2", 'operation = "formations"\nsort_in_s2 = false'),
    ("formation.reward_drift", "reward_drift = true"),
    ("formation.reward_drift", 'operation = "paper"\nreward_drift = true'),
    ("formation.entry", 'operation = "rolling"\nentry = "free"'),
    ("formation.close", 'operation = "rolling"\nclose = "columns"'),
    ("formation.max_vehicles", 'operation = "rolling"\nmax_vehicles = 6'),
    ("formation.max_columns", 'operation = "rolling"\nmax_columns = 7'),
    ("formation.max_joined", 'operation = "rolling"\nmax_joined = 2'),
    ("formation.weight_straight", 'operation = "rolling"\nweight_straight = 1'),
    ("formation.planning_deadline_s", 'operation = "rolling"\nplanning_deadline_s = 2.0'),
    ("formation.max_nodes", 'operation = "rolling"\nmax_nodes = 10'),
    ("formation.block_columns", 'operation = "rolling"\nclose = "columns"\nblock_columns = 4'),
    ("formation.block_columns", "block_columns = 4"),
    ("formation.max_columns", 'close = "columns"\nmax_columns = 7'),
    ("formation.max_columns", 'operation = "paper"\nmax_columns = 7'),
]


@pytest.mark.parametrize(("field", "lines"), INERT)
def test_a_file_s_value_without_effect_is_refused_by_name(
    tmp_path: Path, field: str, lines: str
) -> None:
    path = tmp_path / "x.toml"
    path.write_text(f"[formation]\n{lines}\n", encoding="utf-8")
    error = file_refusal(path)
    if 'rolling"\nclose' in lines:
        assert error.field == "formation.close"  # the first one
    else:
        assert error.field == field
    assert error.allowed.startswith("none")


def test_values_with_an_effect_are_taken_and_those_of_options_and_recordings_too(
    tmp_path: Path,
) -> None:
    """An option may change what a file's values do; a recording holds all fields."""
    path = tmp_path / "x.toml"
    path.write_text("[formation]\nmax_vehicles = 5\nmax_columns = 6\n", encoding="utf-8")
    assert load_scenario(path, formation__operation="rolling").formation.rolling
    path.write_text('[formation]\noperation = "rolling"\nsort_in_s2 = true\n', encoding="utf-8")
    assert load_scenario(path).formation.sort_in_s2
    path.write_text('[formation]\nclose = "columns"\nblock_columns = 6\n', encoding="utf-8")
    assert load_scenario(path).lattice.block_columns == 6
    for formation in ({"operation": "rolling"}, {"close": "columns"}, {"operation": "paper"}):
        scenario = parse_scenario({"formation": formation})
        assert parse_scenario(to_tables(scenario)) == scenario


# --- an earlier name, and the lengths of slots --------------------------------------------------


def test_paper_stands_for_interlaced_blocks_of_columns_and_slots_of_four_seconds(
    tmp_path: Path,
) -> None:
    meant = FormationSettings(
        operation="formations", entry="interlaced", close="columns", cycle_s=4.0
    )
    assert parse_scenario({"formation": {"operation": "paper"}}).formation == meant
    assert load_scenario(None, formation__operation="paper").formation == meant
    path = tmp_path / "x.toml"
    path.write_text('[formation]\noperation = "paper"\n', encoding="utf-8")
    assert load_scenario(path).formation == meant
    # What else is said counts.
    said = {"operation": "paper", "cycle_s": 6.0, "move_s": 5.0, "entry": "free"}
    assert parse_scenario({"formation": said}).formation == attrs.evolve(
        meant, cycle_s=6.0, move_s=5.0, entry="free"
    )
    assert refusal({"formation": {"operation": "papers"}}).field == "formation.operation"


def test_a_recording_of_the_paper_s_operation_under_its_earlier_name_is_read() -> None:
    tables = to_tables(load_scenario(FOLDER / "paper.toml"))
    earlier = {"operation": "paper", "cycle_s": 4.0, "move_s": 3.8, "block_columns": 4}
    kept = {
        name: value
        for name, value in tables["formation"].items()
        if name not in ("entry", "close", "max_columns")
    }
    recording = tables | {"formation": kept | earlier, "tracking": {"horizon_ticks": 40}}
    expected = load_scenario(FOLDER / "paper.toml")
    tracking = attrs.evolve(expected.tracking, horizon_ticks=40)
    assert parse_scenario(recording) == attrs.evolve(expected, tracking=tracking)


def test_slots_are_from_four_to_seven_seconds_unless_they_are_given() -> None:
    scenario = Scenario()
    assert scenario.slots_s == pytest.approx([4.0 + 0.2 * number for number in range(16)])
    assert scenario.move_durations == set(range(38, 70, 2))
    assert (scenario.move_s, scenario.horizon_ticks) == (3.8, 70)
    given = parse_scenario({"formation": {"cycle_s": 5.0}})
    assert (given.slots_s, given.horizon_ticks, given.move_s) == ((5.0,), 50, 4.8)
    assert given.move_durations == {48}
    slower = parse_scenario({"formation": {"cycle_s": 5.0, "move_s": 4.0}})
    assert slower.move_durations == {40}
    rolling = parse_scenario({"formation": {"operation": "rolling"}})
    assert (rolling.slots_s, rolling.horizon_ticks) == ((6.0,), 60)
    dense = parse_scenario(
        {"formation": {"operation": "rolling"}, "demand": {"volume_veh_per_lane_h": 2001.0}}
    )
    assert (dense.slots_s, dense.horizon_ticks) == ((4.0,), 40)
    long = parse_scenario({"tracking": {"horizon_ticks": 80}})
    assert long.horizon_ticks == 80


# --- round trip and overrides -----------------------------------------------------------------

SCENARIOS = st.builds(
    lambda lanes, volume, seed, mode, oblique, realm: attrs.evolve(
        Scenario(),
        seed=seed,
        road=attrs.evolve(Scenario().road, lanes=lanes),
        demand=attrs.evolve(
            Scenario().demand,
            volume_veh_per_lane_h=volume,
            lane_shares=tuple(float(lane + 1) for lane in range(lanes)),
        ),
        formation=attrs.evolve(Scenario().formation, mode=mode, weight_oblique=oblique),
        network=attrs.evolve(Scenario().network, realm=realm),
    ),
    st.integers(1, 8),
    st.floats(1, 3600),
    st.integers(0, 2**63 - 1),
    st.sampled_from((1, 2)),
    st.sampled_from((None, 0, 1)),
    st.text("abcXYZ019_.-", min_size=1, max_size=64),
)


@settings(max_examples=50, deadline=None)
@given(SCENARIOS)
def test_tables_give_the_same_scenario_back(scenario: Scenario) -> None:
    tables = to_tables(scenario)
    assert parse_scenario(tables) == scenario
    assert parse_scenario(json.loads(json.dumps(tables))) == scenario


def test_overrides_replace_the_values_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("seed = 5\n[demand]\nduration_s = 10.0\n", encoding="utf-8")
    scenario = load_scenario(
        path, seed=7, demand__volume_veh_per_lane_h=1600, runtime__coordinators=None
    )
    assert scenario.seed == 7
    assert scenario.demand.duration_s == 10.0
    assert scenario.demand.volume_veh_per_lane_h == 1600.0
    assert scenario.runtime.coordinators == Scenario().runtime.coordinators
    assert load_scenario(path, seed=None).seed == 5


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        ({"seed": -1}, "seed"),
        ({"demand__volume_veh_per_lane_h": math.nan}, "demand.volume_veh_per_lane_h"),
        ({"demand__speling": 1}, "demand.speling"),
        ({"speling__x": 1}, "speling"),
        ({"runtime__coordinators": "3"}, "runtime.coordinators"),
    ],
)
def test_a_wrong_override_is_refused_by_name(overrides: dict[str, object], field: str) -> None:
    with pytest.raises(BadInputError) as caught:
        load_scenario(None, **overrides)
    assert caught.value.field == field


def test_an_override_of_a_table_that_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.write_text("demand = 5", encoding="utf-8")
    with pytest.raises(BadInputError) as caught:
        load_scenario(path, demand__duration_s=1.0)
    assert caught.value.field == "demand"


def test_read_toml_returns_plain_tables() -> None:
    assert read_toml(FOLDER / "demo.toml")["demand"]["duration_s"] == 90.0
