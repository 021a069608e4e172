"""Names of vehicles, coordinators, roles and realms, which are parts of Zenoh's keys."""

from __future__ import annotations

import re
from collections.abc import Collection
from itertools import islice
from typing import Annotated, NewType

from msgspec import Meta

NAME_PATTERN = re.compile(r"[A-Za-z0-9_.-]{1,64}")
NAME_RULE = "letters, digits, `_`, `-`, `.`; at least 1, at most 64"
Name = NewType("Name", Annotated[str, Meta(pattern=rf"^{NAME_PATTERN.pattern}\Z")])
"""Name of a vehicle, coordinator or role: letters, digits, `_`, `-`, `.`; at most 64."""


def span_of(names: Collection[str]) -> str:
    """Return the first and the last of some numbered names as text, `v0001 to v0039`."""
    in_order = sorted(names, key=lambda name: (len(name), name))
    return f"{in_order[0]} to {in_order[-1]}"


def first_names(names: Collection[str], count: int) -> str:
    """Return at most `count` names as text, and how many others there are."""
    more = len(names) - count
    shown = ", ".join(islice(names, count))
    return f"{shown} and {more} more" if more > 0 else shown
