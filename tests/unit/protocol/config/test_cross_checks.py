"""Fields of a scenario that do not fit together, and values of a file that have no effect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario, to_tables
from support.refusals import refusal
from support.tables import for_each

# --- fields that do not fit together ----------------------------------------------------------

MTLS: dict[str, Any] = {"network": {"endpoint": "tls/r:7447"}, "security": {"mode": "mtls"}}
DENSE = {"volume_veh_per_lane_h": 3600}
WEAK = {"min_accel_mps2": -5.0}
LATE = {"reaction_s": 0.4}
FOUR = {"cycle_s": 4.0}
MISFITS: list[tuple[str, dict[str, Any]]] = [
    ("formation.settle_s", {"formation": {"settle_s": 3.1}}),
    ("radio.technology", {"radio": {"power_dbm": 20.0}}),
    ("radio.technology", {"radio": {"technology": "none", "cellular_loss": 0.0}}),
    ("formation.settle_s", {"formation": {"settle_s": 5.0, "operation": "paper"}}),
    ("formation.settle_s", {"vehicle": {"max_speed_mps": 15.5}, "formation": {"settle_s": 28.1}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [0.5, 0.5]}}),
    ("demand.lane_shares", {"road": {"lanes": 2}, "demand": {"lane_shares": [1, 1, 1]}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [0, 0, 0]}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [1, -1, 1]}}),
    ("demand.lane_shares", {"demand": {"lane_shares": [1e308, 1e308, 1e308]}}),
    ("road.lane_width_m", {"road": {"lane_width_m": 2.0}, "vehicle": {"width_m": 2.0}}),
    ("road.lane_width_m", {"road": {"lane_width_m": 2.25}}),
    (
        "demand.volume_veh_per_lane_h",
        {"demand": DENSE | {"min_headway_s": 1.01}},
    ),
    ("formation.gap_m", {"formation": {"gap_m": 5.0}}),
    ("formation.gap_m", {"vehicle": {"length_m": 30.0}}),
    ("formation.move_s", {"formation": {"move_s": 3.8}}),
    ("formation.move_s", {"formation": {"cycle_s": 4.0, "move_s": 4.1}}),
    ("formation.move_s", {"formation": {"cycle_s": 3.0, "move_s": 3.8}}),
    ("formation.move_s", {"formation": {"operation": "rolling", "move_s": 3.8}}),
    ("formation.speed_mps", {"formation": {"speed_mps": 25.0}}),
    ("formation.speed_mps", {"vehicle": {"max_speed_mps": 10.0}}),
    ("formation.weight_oblique", {"formation": {"mode": 2, "weight_oblique": 2}}),
    ("road.s3_m", {"road": {"s3_m": 100.0}}),
    ("road.s3_m", {"formation": {"close": "columns", "block_columns": 24, "gap_m": 30.0}}),
    ("road.s3_m", {"formation": {"max_columns": 24, "gap_m": 30.0}}),
    ("formation.conflicts", {"formation": {"conflicts": ["node", "edge"]}}),
    ("formation.conflicts", {"formation": {"mode": 2, "conflicts": ["node", "edge", "special-1"]}}),
    ("network.election_s", {"network": {"election_s": 0.2, "heartbeat_s": 0.1}}),
    ("network.election_s", {"network": {"heartbeat_s": 5.0}}),
    ("network.lease_s", {"network": {"lease_s": 0.5, "heartbeat_s": 0.5, "election_s": 2.0}}),
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
    ("network.endpoint", MTLS | {"network": {"endpoint": "tcp/r:7447"}}),
    ("network.endpoint", MTLS | {"network": {"endpoint": "unixsock-stream/r"}}),
    ("network.endpoint", MTLS | {"network": {"endpoint": "udp/r:1?rel=1;mixed_rel=1"}}),
    ("security.mode", {"network": {"endpoint": "quic/r:7447?mixed_rel=1"}}),
    ("network.listen", MTLS | {"network": {"listen": ["tls/r:1", "tcp/r:2"]}}),
    ("security.mode", {"network": {"endpoint": "tls/r:7447"}}),
    ("security.mode", {"network": {"listen": ["tls/r:7447"]}}),
    ("demand.duration_s", MTLS | {"demand": {"duration_s": 80_000.0}}),
    ("security.clients", MTLS | {"security": {"mode": "mtls", "clients": ["x" * 58]}}),
    (
        "security.fleets[a]",
        MTLS | {"security": {"mode": "mtls", "fleets": {"a": ["b"], "f": ["a"]}}},
    ),
    ("security.fleets[v0001]", MTLS | {"security": {"mode": "mtls", "fleets": {"v0001": "0/1"}}}),
    ("demand.arrival_shares", MTLS | {"demand": {"arrival_shares": [0.5, 0.5]}}),
    ("demand.arrival_shares", MTLS | {"demand": {"arrival_shares": [0.0, 0.0, 0.0]}}),
    ("security.folder", MTLS | {"security": {"mode": "mtls", "folder": ""}}),
    ("network.endpoint", MTLS | {"network": {"endpoint": "tls/[::1]:7447"}}),
    ("network.endpoint", MTLS | {"network": {"endpoint": "quic/[2001:db8::1]:7447"}}),
    ("security.mode", {"security": {"mode": "tls"}}),
    ("security.fleets", {"security": {"fleets": {"a b": "0/1"}}}),
    ("security.fleets[a]", {"security": {"fleets": {"a": "1/1"}}}),
    (
        "formation.max_joined",
        {"formation": {"max_columns": 24, "max_joined": 4}, "road": {"lanes": 5}},
    ),
    ("security.fleets", {"security": {"fleets": {"a": ["v/1"]}}}),
    ("security.fleets", {"security": {"fleets": {"a": ["v", "v"]}}}),
    ("security.observers", {"security": {"observers": ["*"]}}),
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


@for_each(("field", "data"), MISFITS)
def test_fields_that_do_not_fit_are_refused_by_name(field: str, data: dict[str, Any]) -> None:
    assert refusal(parse_scenario, data).field == field


@for_each(
    "data",
    [
        {"demand": {"lane_shares": [1, 0, 0]}},
        {"demand": DENSE | {"min_headway_s": 1.0}},
        {"formation": FOUR | {"move_s": 4.0}},
        {"formation": {"cycle_s": 3.9}},
        {"formation": {"operation": "rolling", "cycle_s": 6.0}},
        {"formation": {"mode": 2}},
        {"formation": {"mode": 2, "weight_oblique": 1}},
        {"formation": {"conflicts": ["geometric"]}},
        {"road": {"lanes": 1}},
        {"formation": {"max_columns": 20, "max_joined": 4}, "road": {"lanes": 5}},
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
    ("formation.join", 'join = "room"'),
    ("formation.max_columns", 'close = "columns"\nmax_columns = 7'),
    ("formation.max_columns", 'operation = "paper"\nmax_columns = 7'),
]


@pytest.mark.parametrize(("field", "lines"), INERT)
def test_a_file_s_value_without_effect_is_refused_by_name(
    tmp_path: Path, field: str, lines: str
) -> None:
    path = tmp_path / "x.toml"
    path.write_text(f"[formation]\n{lines}\n", encoding="utf-8")
    error = refusal(load_scenario, path)
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
    assert load_scenario(path, formation__operation="rolling").formation.planner == "rolling"
    path.write_text('[formation]\noperation = "rolling"\nsort_in_s2 = true\n', encoding="utf-8")
    assert load_scenario(path).formation.sort_in_s2
    path.write_text('[formation]\nclose = "columns"\nblock_columns = 6\n', encoding="utf-8")
    assert load_scenario(path).lattice.block_columns == 6
    for formation in ({"operation": "rolling"}, {"close": "columns"}, {"operation": "paper"}):
        scenario = parse_scenario({"formation": formation})
        assert parse_scenario(to_tables(scenario)) == scenario
