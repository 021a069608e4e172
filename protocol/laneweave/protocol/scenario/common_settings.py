"""Values of the common settings (`wire.common_settings`) in a scenario."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import lru_cache
from operator import attrgetter
from types import MappingProxyType
from typing import Any, Final

import attrs

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.common_settings import GROUPS, CommonSettings

_DERIVED: Final[Mapping[str, str]] = MappingProxyType(
    {"formation.cycle_s": "timing.cycles_s", "formation.block_columns": "formation.block_width"}
)
"""Settings whose defaults follow from others, and where their effective values are."""
_OF_DEMAND: Final = frozenset(
    {"volume_veh_per_h", "destinations", "lane_shares", "vehicle_types", "share"}
)
"""Fields of the tables `entrance` and `vehicle_type` that only the bridge uses."""


@lru_cache(maxsize=8)
def settings_of(scenario: Scenario) -> CommonSettings:
    """Return the common settings of a scenario."""
    return CommonSettings(MappingProxyType(dict(_values_of(scenario))))


def _values_of(scenario: Scenario) -> Iterator[tuple[str, str]]:
    for names in GROUPS.values():
        for name in names:
            value = attrgetter(_DERIVED.get(name, name))(scenario)
            if attrs.has(type(value)):
                for part, one in attrs.asdict(value).items():
                    yield f"{name}.{part}", json.dumps(one)
            else:
                yield name, json.dumps(value, default=_without_demand)


def _without_demand(table: Any) -> dict[str, Any]:  # noqa: ANN401 (tables have no common base)
    """Return the values that a table in a list of tables sets, but those of its demand."""

    def is_common(one: attrs.Attribute[Any], value: object) -> bool:
        return one.name not in _OF_DEMAND and value is not None

    return attrs.asdict(table, recurse=False, filter=is_common)
