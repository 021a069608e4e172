"""Settings that all processes of a road must share, since at least two roles act on them.

`GROUPS` lists them once. Processes compare digests of the groups (`runtime.settings_check`); people
read the values, which `scenario.common_settings` takes from a scenario. All other fields of a
scenario may differ between processes: only one role uses them, or a difference is harmless.

A field that a later release adds belongs to these settings only where it differs from its default,
and its default keeps the behaviour of this release: then both releases have the same digests.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping
from itertools import zip_longest
from types import MappingProxyType
from typing import Final

from attrs import field, frozen

from laneweave.protocol.wire.codec import VERSION
from laneweave.protocol.wire.topics import ROLES, Party

GROUPS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "road": (
            "road.lanes",
            "road.lane_width_m",
            "road.s1_m",
            "road.s2_m",
            "road.s3_m",
            "road.closures",
            "road.restrictions",
            "road.solid_lines",
            "entrance",
            "exit",
        ),
        "lattice": (
            "formation.gap_m",
            "formation.speed_mps",
            "formation.block_columns",
            "formation.operation",
            "runtime.tick_s",
            "runtime.max_pace",
            "runtime.max_road_s",
        ),
        "motion": (
            "formation.mode",
            "formation.cycle_s",
            "formation.move_s",
            "formation.change_columns",
            "vehicle",
            "vehicle_type",
            "sensing",
            "braking",
            "tracking.min_gap_m",
        ),
        "operation": (
            "formation.entry",
            "formation.close",
            "formation.max_columns",
            "formation.max_vehicles",
            "formation.settle_s",
            "formation.sort_in_s2",
        ),
    }
)
"""Names of the settings by group, as in a scenario file. A table stands for all of its fields.

All roles use the first three groups, only coordinators and the bridge the last one."""
_AGENT_GROUPS: Final = ("road", "lattice", "motion")
_FULL_ROLES: Final = (ROLES[Party.COORDINATOR], ROLES[Party.BRIDGE])
MAX_SHOWN: Final = 80
"""Maximum number of characters of a value in a text."""


@frozen
class Difference:
    """A setting that differs between two processes."""

    name: str
    own: str
    """Value as JSON text."""
    other: str

    def __str__(self) -> str:
        """Return both values in words; the other process is the bridge."""
        own, other = _shortened(self.own), _shortened(self.other)
        return f"{self.name} is {own} here, {other} at the bridge"


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 3]}..."


@frozen
class CommonSettings:
    """The settings of one process, and their digests."""

    values: Mapping[str, str]
    """Value of each setting as JSON text, by name."""
    digests: str = field(init=False)
    """A digest of each group, in the order of `GROUPS`; part of a key."""

    @digests.default
    def _digests_of_values(self) -> str:
        return "-".join(f"{_digest(self.values, group):08x}" for group in GROUPS)

    def differences(
        self, others: Mapping[str, str], groups: Iterable[str] = tuple(GROUPS)
    ) -> list[Difference]:
        """Return the settings of some groups that differ.

        Args:
            others: values of another process; those that it does not have count as equal.
            groups: names of the groups.
        """
        return [
            Difference(name, value, others[name])
            for group in groups
            for name, value in _of_group(self.values, group).items()
            if others.get(name, value) != value
        ]


def groups_of(role: str) -> tuple[str, ...]:
    """Return the groups that the processes of a role use."""
    return tuple(GROUPS) if role in _FULL_ROLES else _AGENT_GROUPS


def different_groups(digests: str, others: str, role: str) -> list[str]:
    """Return the groups that a role uses and whose digests differ."""
    pairs = zip_longest(GROUPS, digests.split("-"), others.split("-"))
    return [group for group, one, other in pairs if one != other and group in groups_of(role)]


def _of_group(values: Mapping[str, str], group: str) -> dict[str, str]:
    return {
        name: value
        for name, value in values.items()
        if any(name == one or name.startswith(f"{one}.") for one in GROUPS[group])
    }


def _digest(values: Mapping[str, str], group: str) -> int:
    # Processes with another version of the messages do not fit either.
    return zlib.crc32(json.dumps([VERSION, _of_group(values, group)], sort_keys=True).encode())
