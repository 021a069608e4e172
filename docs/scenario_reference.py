"""The table of all scenario fields in SCENARIO.md.

Default, unit and range come from the code; the meaning of a field is in the document itself, so a
new field gets a row whose meaning has to be written there.
"""

from __future__ import annotations

import inspect
import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

import attrs

from laneweave.protocol.field_validators import HOST_PORT_RULE
from laneweave.protocol.names import NAME_RULE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS

MISSING = "?"
"""Meaning of a field that the document does not describe yet."""
UNITS = {
    "veh_per_lane_h": "vehicles/(lane h)",
    "mps3": "m/s3",
    "mps2": "m/s2",
    "mps": "m/s",
    "m": "m",
    "s": "s",
    "ticks": "ticks",
}


def scenario_table(meanings: Mapping[str, str]) -> str:
    """Return the table of all scenario fields, with the meanings of fields by name."""
    lines = [_row(["Field", "Default", "Unit", "Allowed", "Meaning"]), "|---|---|---|---|---|"]
    for name, attribute in scenario_fields():
        meaning = meanings.get(name, MISSING)
        cells = [default_of(attribute), _unit(name), _allowed(attribute), meaning]
        lines.append(_row([f"`{name}`", *cells]))
    return "\n".join(lines)


def meanings_in(text: str) -> dict[str, str]:
    """Return the last cell of each row of a table of fields, by the name in its first cell."""
    rows = re.findall(r"^\| `([\w.]+)` \|.*(?<!\\)\| (.*) \|$", text, re.MULTILINE)
    return dict(rows)


def scenario_fields() -> Iterator[tuple[str, attrs.Attribute[Any]]]:
    """Yield all fields of a scenario with their full names."""
    for outer in attrs.fields(Scenario):
        kind: type = type(outer.default)
        if attrs.has(kind):
            for inner in attrs.fields(kind):
                yield f"{outer.name}.{inner.name}", inner
        else:
            yield outer.name, outer


def default_of(attribute: attrs.Attribute[Any]) -> str:
    """Return the default of a field, as documents show it."""
    value = attribute.default
    if value is attrs.NOTHING:
        return "required"
    if value is None:
        return "not set"
    if isinstance(value, tuple):
        return f"`{json.dumps(list(value))}`"
    if isinstance(value, attrs.Factory(dict).__class__):
        return "`{}`"
    return f"`{json.dumps(value)}`"


def limits_of(attribute: attrs.Attribute[Any]) -> Mapping[str, Any]:
    """Return the arguments of a field's validator; empty without a validator."""
    rule = _rule_of(attribute)
    return {} if rule is None else inspect.getclosurevars(rule).nonlocals


def _rule_of(attribute: attrs.Attribute[Any]) -> Any:  # noqa: ANN401 (any validator)
    """Return the validator of a field; for an optional field, that of its values."""
    return getattr(attribute.validator, "validator", attribute.validator)


def range_of(limits: Mapping[str, Any]) -> str:
    """Return the range of a number, as documents show it."""
    bracket = "(" if limits["open_low"] else "["
    return f"{bracket}{_number(limits['low'])}, {_number(limits['high'])}]"


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _unit(name: str) -> str:
    return next((unit for end, unit in UNITS.items() if name.endswith(f"_{end}")), "")


def _allowed(attribute: attrs.Attribute[Any]) -> str:
    if attribute.validator is None:
        # Parsing a scenario resolves the annotations from text to types, with their modules.
        kind = attribute.type.__name__ if attribute.type in (str, bool) else str(attribute.type)
        kinds = {
            "str": "text",
            "tuple[float, ...]": "list of numbers",
            "tuple[str, ...]": "list of texts",
            "bool": "`true`, `false`",
        }
        return kinds.get(kind, "list of tables")
    found = limits_of(attribute)
    if "choices" in found:
        return ", ".join(f"`{json.dumps(one)}`" for one in found["choices"] if one is not None)
    if "low" in found:
        return range_of(found)
    rules = {
        "key_part": NAME_RULE,
        "host_port": HOST_PORT_RULE,
        "key_parts": f"list of names: {NAME_RULE}",
        "_fleets": "table of shards `I/N` or lists of vehicles, by name",
        "_conflict_kinds": "any of " + ", ".join(f"`{kind}`" for kind in CONFLICT_KINDS),
    }
    return rules[getattr(_rule_of(attribute), "__name__", "")]


def _number(value: float) -> str:
    if isinstance(value, int) and value > 2**53:
        return f"2^{math.ceil(math.log2(value))} - 1"
    return f"{value:.10g}"
