"""Conversion of a TOML file or of nested tables into a checked `Scenario`."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from laneweave.protocol.config.cross_checks import check_effects, check_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.deployment_fields import Security
from laneweave.protocol.scenario.fields import PAPERS_FORMATIONS, Scenario
from laneweave.protocol.structuring import structure


def load_scenario(path: Path | None, **overrides: object) -> Scenario:
    """Read a scenario and apply overrides such as `seed=3` or `demand__volume_veh_per_lane_h=1600`.

    Args:
        path: a TOML file; None: the defaults (the paper's road, formations of six).
        **overrides: values that replace the file's values; `None` keeps the file's value.
            `table__field` names a field of a table.

    Raises:
        BadInputError: the file cannot be read or is not TOML; a value is invalid, or has no effect
            in combination with the other values of the file.
    """
    data: dict[str, Any] = {}
    if path is not None:
        data = read_toml(path)
        _resolve_paths(data, path)
        check_effects(data, parse_scenario(data))
    return scenario_of(data, **overrides)


def scenario_of(tables: Mapping[str, Any], **overrides: object) -> Scenario:
    """Return the scenario of nested tables, with overrides as in `load_scenario`.

    Raises:
        BadInputError: a value is invalid.
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


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        BadInputError: the file cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInputError("file", str(path), f"a readable file ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        # Not UTF-8, not TOML, a NUL in the path, too many digits, nested too deep.
        raise BadInputError("file", str(path), f"valid TOML ({error})") from error


def parse_scenario(data: Mapping[str, Any]) -> Scenario:
    """Build a scenario from nested tables and check it.

    Raises:
        BadInputError: a field is unknown, has a wrong type or value, or contradicts another field.
    """
    scenario = structure(_with_current_names(data), Scenario)
    check_scenario(scenario)
    return scenario


def _with_current_names(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the tables with the former value `operation = "paper"` replaced by current fields."""
    formation = data.get("formation") if isinstance(data, Mapping) else None
    if not isinstance(formation, Mapping) or formation.get("operation") != "paper":
        return data
    return {**data, "formation": {**PAPERS_FORMATIONS, **formation, "operation": "formations"}}


def to_tables(scenario: Scenario) -> dict[str, Any]:
    """Return the nested tables from which `parse_scenario` builds this scenario."""
    return attrs.asdict(scenario)
