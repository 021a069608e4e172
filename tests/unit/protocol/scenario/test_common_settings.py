"""The settings that all processes of a road must share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import attrs
import pytest

from laneweave.protocol.config.scenario_files import load_scenario, parse_scenario, to_tables
from laneweave.protocol.scenario.common_settings import settings_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.common_settings import (
    GROUPS,
    different_groups,
)
from support.tables import for_each

ROOT = Path(__file__).parents[4]
DIGESTS = json.loads(Path(__file__).with_name("digests.json").read_text(encoding="utf-8"))
SINGLE_ROLE = {
    "demand": "only the bridge draws vehicles; what follows for T_F is compared",
    "rule": "reference methods run in one process",
    "lc2013": "reference methods run in one process",
    "network": "each process has its own links and deadlines",
    "security": "each process has its own files; the router enforces the rights",
    "radio": "each receiver loses messages by itself; safety does not depend on it",
    "service": "of each coordinator",
    "observation": "of each process",
    "sumo": "of the bridge",
    "schema": "checked when a file is read",
    "seed": "the bridge draws vehicles; coordinators draw waiting times",
}
"""Tables that may differ between processes, and why."""
SINGLE_ROLE_FIELDS = {
    "formation.weight_straight": "coordinator",
    "formation.weight_oblique": "coordinator",
    "formation.solver": "coordinator",
    "formation.planning_deadline_s": "coordinator",
    "formation.max_nodes": "coordinator",
    "formation.max_joined": "coordinator",
    "formation.join": "coordinator",
    "formation.structures": "coordinator",
    "formation.targets": "coordinator",
    "formation.conflicts": "coordinator; vehicles check the footprints of a plan themselves",
    "formation.reward_drift": "coordinator",
    "road.events": "bridge, which tells all others",
    "tracking.horizon_ticks": "agent",
    "tracking.shortcut": "agent",
    "runtime.tick_resend_s": "bridge",
    "runtime.tick_deadline_s": "bridge",
    "runtime.agent_silent_s": "bridge",
    "runtime.agent_start_s": "bridge",
    "runtime.announce_s": "bridge",
    "runtime.hold_period_ticks": "agent",
    "runtime.coordinators": "launcher, router",
    "runtime.vehicles_per_process": "launcher",
}
"""Fields of other tables that only one role uses, and this role."""
PAIRS = [
    ("road.lanes", {"road": {"lanes": 4}}),
    ("road.closures", {"road": {"closures": [{"lane": 0, "from_m": 700.0}]}}),
    ("formation.gap_m", {"formation": {"gap_m": 16.0}}),
    ("formation.cycle_s", {"formation": {"cycle_s": 5.0}}),
    ("formation.max_vehicles", {"formation": {"max_vehicles": 8}}),
    ("vehicle.min_accel_mps2", {"vehicle": {"min_accel_mps2": -9.0}}),
    ("vehicle_type", {"vehicle_type": [{"name": "truck", "share": 0.1, "length_m": 12.0}]}),
    ("braking.margin_m", {"braking": {"margin_m": 0.5}}),
    ("runtime.tick_s", {"runtime": {"tick_s": 0.05}}),
]


def test_every_field_of_a_scenario_is_common_or_has_a_reason_not_to_be() -> None:
    """A new field must be put in one of both places."""
    grouped = {name for names in GROUPS.values() for name in names}
    fields: set[str] = set()
    for table in attrs.fields(Scenario):
        name, kind = table.name, cast("type[attrs.AttrsInstance]", type(table.default))
        if name in grouped or name in SINGLE_ROLE:
            fields.add(name)
        else:
            fields |= {f"{name}.{one.name}" for one in attrs.fields(kind)}
    assert fields == grouped | set(SINGLE_ROLE) | set(SINGLE_ROLE_FIELDS)
    assert not grouped & (set(SINGLE_ROLE) | set(SINGLE_ROLE_FIELDS))


@for_each("setting, tables", PAIRS)
def test_a_difference_is_found_and_named(setting: str, tables: dict[str, Any]) -> None:
    one, other = (settings_of(parse_scenario(each)) for each in ({}, tables))
    assert setting in [each.name for each in one.differences(other.values)]
    group = next(group for group, names in GROUPS.items() if _is_in(setting, names))
    assert group in different_groups(one.digests, other.digests, "bridge")
    assert f"{setting} is {one.values[setting]} here, {other.values[setting]} at the bridge" in [
        str(each) for each in one.differences(other.values)
    ]


def _is_in(setting: str, names: tuple[str, ...]) -> bool:
    return any(setting == name or setting.startswith(f"{name}.") for name in names)


def test_what_is_written_otherwise_but_means_the_same_does_not_differ() -> None:
    plain = settings_of(parse_scenario({}))
    for tables in (
        {"road": {"lanes": 3, "s1_m": 50}},
        {"demand": {"volume_veh_per_lane_h": 1500.0}, "seed": 9},
        {"formation": {"block_columns": 5}},  # without effect, as formations close by vehicles
        to_tables(parse_scenario({})),
    ):
        assert settings_of(parse_scenario(tables)).digests == plain.digests


def test_demand_counts_where_the_slots_follow_from_it() -> None:
    quiet, dense = (
        settings_of(
            parse_scenario(
                {
                    "formation": {"operation": "rolling"},
                    "demand": {"volume_veh_per_lane_h": volume},
                }
            )
        )
        for volume in (1500.0, 2300.0)
    )
    assert [each.name for each in quiet.differences(dense.values)] == ["formation.cycle_s"]


@pytest.mark.parametrize("scenario", DIGESTS)
def test_scenarios_have_the_digests_of_the_release_before(scenario: str) -> None:
    """Otherwise an upgrade stops the road, process by process: see `common_settings`."""
    path = ROOT / "scenarios" / f"{scenario}.toml"
    assert settings_of(load_scenario(path)).digests == DIGESTS[scenario]
