"""Processes that find only the packages of some extras, although all are installed."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
EXTRA_OF_ROLE = {
    "coordinator": "plan",
    "agent": "agent",
    "bridge": "sim",
    "certs": "certs",
    "watch": "watch",
}
"""The extra that a role needs; all others need none."""


def normal(name: str) -> str:
    """Return the normalized name of a distribution."""
    return re.sub(r"[-_.]+", "-", name).lower()


def only_extras(*extras: str) -> dict[str, str]:
    """Return environment variables that hide all packages that these extras do not install."""
    hooks = Path(__file__).with_name("hidden_packages")
    return {"PYTHONPATH": str(hooks), "LANEWEAVE_TEST_HIDDEN": " ".join(_others(*extras))}


def only_for(role: str) -> dict[str, str]:
    """Return environment variables that hide all packages that a role does not need."""
    return only_extras(*filter(None, [EXTRA_OF_ROLE.get(role)]))


def installed_by(*extras: str) -> set[str]:
    """Return the distributions that laneweave and some of its extras install."""
    groups = [PROJECT["dependencies"], *(PROJECT["optional-dependencies"][one] for one in extras)]
    found: set[str] = set()
    waiting = [Requirement(one) for group in groups for one in group]
    while waiting:
        wanted = waiting.pop()
        # A distribution may be required again, with other extras.
        if str(wanted) not in found:
            found |= {str(wanted), normal(wanted.name)}
            waiting += _requirements(wanted.name, wanted.extras or {""})
    return found


def _requirements(name: str, extras: Iterable[str]) -> Iterator[Requirement]:
    for text in metadata.requires(name) or ():
        wanted = Requirement(text)
        if wanted.marker is None or any(wanted.marker.evaluate({"extra": one}) for one in extras):
            yield wanted


@cache
def _others(*extras: str) -> tuple[str, ...]:
    """Return the top-level modules that belong only to other distributions."""
    there = installed_by(*extras) | {"laneweave"}
    owners = metadata.packages_distributions()
    return tuple(name for name, found in owners.items() if not there & {*map(normal, found)})
