"""Validators for the fields of configuration: what a value may be, said in the error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.topics import NAME_PATTERN, NAME_RULE

Validator = Callable[[Any, "attrs.Attribute[Any]", Any], None]


def within(low: float, high: float, *, open_low: bool = False) -> Validator:
    """Return a validator for a finite number in [low, high], or (low, high] if `open_low`."""

    def check(_: object, attribute: attrs.Attribute[Any], value: float) -> None:
        # NaN fails both comparisons.
        if not low <= value <= high or (open_low and value == low):
            bracket = "(" if open_low else "["
            raise BadInputError(attribute.name, value, f"{bracket}{low:g}, {high:g}]")

    return check


def one_of(*choices: object) -> Validator:
    """Return a validator for a fixed set of values."""

    def check(_: object, attribute: attrs.Attribute[Any], value: object) -> None:
        if value not in choices:
            raise BadInputError(attribute.name, value, ", ".join(map(str, choices)))

    return check


def key_part(_: object, attribute: attrs.Attribute[Any], value: str) -> None:
    """Check that a value can be one part of a key."""
    if not NAME_PATTERN.fullmatch(value):
        raise BadInputError(attribute.name, value, NAME_RULE)
