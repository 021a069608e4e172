"""Validators for the fields of configuration: what a value may be, said in the error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import attrs

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.wire.topics import NAME_PATTERN, NAME_RULE

HOST_PORT_RULE = "HOST:PORT with a port from 1 to 65535, or nothing"
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


def host_and_port(name: str, text: str) -> tuple[str, int]:
    """Return the parts of HOST:PORT; an IPv6 address is in brackets.

    Raises:
        BadInputError: it is no such thing.
    """
    host, _, port = text.rpartition(":")
    bare = host[1:-1] if host[:1] == "[" and host[-1:] == "]" else host
    is_port = port.isascii() and port.isdecimal() and len(port) < 6 and 1 <= int(port) <= 65535
    if not is_port or not bare or (":" in bare) != (bare != host) or " " in bare:
        raise BadInputError(name, text, HOST_PORT_RULE)
    return bare, int(port)


def host_port(_: object, attribute: attrs.Attribute[Any], value: str) -> None:
    """Check that a value is HOST:PORT, or empty."""
    if value:
        host_and_port(attribute.name, value)


def key_parts(_: object, attribute: attrs.Attribute[Any], value: Sequence[str]) -> None:
    """Check that values can be parts of keys, and that none is there twice."""
    for one in value:
        if not NAME_PATTERN.fullmatch(one):
            raise BadInputError(attribute.name, one, NAME_RULE)
        if value.count(one) > 1:
            raise BadInputError(attribute.name, one, "each name once")
