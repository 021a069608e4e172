"""Conversion of a TOML file or of nested tables into a checked `Scenario`."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import attrs

from laneweave.protocol.config import demand_checks, deployment_checks, motion_checks, road_checks
from laneweave.protocol.config.source_files import read_toml_source
from laneweave.protocol.errors import BadInputError, raise_all
from laneweave.protocol.scenario.deployment_fields import Security
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import PAPERS_FORMATIONS
from laneweave.protocol.structuring import structure

_CHECKS = (
    (
        motion_checks.check_types,
        road_checks.check_lane_rules,
        demand_checks.check_lanes,
        motion_checks.check_motion,
        road_checks.check_closures,
        road_checks.check_events,
        road_checks.check_entrances,
        road_checks.check_dead_ends,
        road_checks.check_exits,
        demand_checks.check_joined_cells,
        demand_checks.check_drawn_capacity,
        demand_checks.check_destinations,
        motion_checks.check_structures,
        motion_checks.check_timing,
        motion_checks.check_braking,
        motion_checks.check_settling,
        deployment_checks.check_secured_demand,
    ),
    (deployment_checks.check_periods,),
    (deployment_checks.check_radio,),
    (deployment_checks.check_sumo,),
    (deployment_checks.check_security,),
)
"""Checks in the order in which they run. One may use what those before it in its group have
established, so that a group reports its first error only; the groups are independent."""

FORMER_FIELDS: Final[Mapping[str, frozenset[str]]] = {
    "service": frozenset({"cache_entries", "cache_s"}),
    "tracking": frozenset({"always_solve"}),
}
"""Fields of tables in earlier files, which are ignored."""


def load_scenario(path: Path | None, **overrides: object) -> Scenario:
    """Read a scenario and apply overrides such as `seed=3` or `demand__volume_veh_per_lane_h=1600`.

    Args:
        path: a TOML file; None: the defaults (the paper's road, formations of six).
        **overrides: values that replace the file's values; `None` keeps the file's value.
            `table__field` names a field of a table.

    Raises:
        BadInputError: the file cannot be read or is not TOML; values are invalid, even if an
            override replaces them, or have no effect in combination with the other values of the
            file. The error has all of them, with their lines.
    """
    if path is None:
        return scenario_of({}, **overrides)
    file = read_toml_source(path)
    _resolve_paths(file.tables, path)
    with file.located():
        scenario = _structured(file.tables)
        raise_all([*effect_problems(file.tables, scenario), *scenario_problems(scenario)])
    given = {name.replace("__", ".") for name, value in overrides.items() if value is not None}
    if not given:
        return scenario
    with file.located(given):
        return scenario_of(file.tables, **overrides)


def scenario_of(tables: Mapping[str, Any], **overrides: object) -> Scenario:
    """Return the scenario of nested tables, with overrides as in `load_scenario`.

    Raises:
        BadInputError: values are invalid.
    """
    data = copy.deepcopy(dict(tables))
    for name, value in overrides.items():
        if value is None:
            continue
        *names, key = name.split("__")
        target = data
        for table in names:
            target = target.setdefault(table, {})
            if not isinstance(target, dict):
                raise BadInputError(table, target, "a table")
        target[key] = value
    return parse_scenario(data)


def _resolve_paths(data: dict[str, Any], path: Path) -> None:
    """Resolve paths relative to the scenario file: certificates, and SUMO's configuration."""
    for table, key, default in (("security", "folder", Security().folder), ("sumo", "config", "")):
        fields = data.get(table)
        if isinstance(fields, dict):
            value = fields.get(key, default)
            if isinstance(value, str) and value:
                fields[key] = str(path.parent / value)


def parse_scenario(data: Mapping[str, Any]) -> Scenario:
    """Build a scenario from nested tables and check it.

    Raises:
        BadInputError: fields are unknown, have a wrong type or value, or contradict each other.
    """
    scenario = _structured(data)
    check_scenario(scenario)
    return scenario


def _structured(data: Mapping[str, Any]) -> Scenario:
    return structure(_with_current_names(data), Scenario)


def _with_current_names(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the tables without former fields, and with current ones for `operation = "paper"`."""
    if not isinstance(data, Mapping):
        return data
    formation = data.get("formation")
    if isinstance(formation, Mapping) and formation.get("operation") == "paper":
        current = {**PAPERS_FORMATIONS, **formation, "operation": "formations"}
        data = {**data, "formation": current}
    for table, former in FORMER_FIELDS.items():
        fields = data.get(table)
        if isinstance(fields, Mapping) and not former.isdisjoint(fields):
            kept = {name: value for name, value in fields.items() if name not in former}
            data = {**data, table: kept}
    return data


def to_tables(scenario: Scenario) -> dict[str, Any]:
    """Return the nested tables from which `parse_scenario` builds this scenario."""
    return attrs.asdict(scenario)


def check_scenario(scenario: Scenario) -> None:
    """Check the fields against each other.

    Raises:
        BadInputError: fields violate rules.
    """
    raise_all(scenario_problems(scenario))


def scenario_problems(scenario: Scenario) -> Iterator[BadInputError]:
    """Yield errors of fields that contradict each other, the first one of each group of checks."""
    for group in _CHECKS:
        try:
            for check in group:
                check(scenario)
        except BadInputError as error:
            yield error


def effect_problems(data: Mapping[str, Any], scenario: Scenario) -> Iterator[BadInputError]:
    """Yield an error for each value in a file that has no effect in the resulting scenario."""
    formation, given = scenario.formation, data.get("formation", {})
    by_vehicles = formation.closes_by_vehicles
    for name in given:
        if f"formation.{name}" in formation.traits.unused:
            allowed = f'none where formation.operation is "{formation.operation}"'
            yield BadInputError(f"formation.{name}", given[name], allowed)
    for name, has_effect, allowed in (
        ("max_columns", by_vehicles, 'none, unless formation.close is "vehicles"'),
        ("join", formation.max_joined > 1, "none, unless formation.max_joined is above 1"),
        ("block_columns", not by_vehicles, 'none, unless formation.close is "columns"'),
    ):
        if name in given and not has_effect:
            yield BadInputError(f"formation.{name}", given[name], allowed)
