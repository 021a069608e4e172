"""Validators of configuration values: names, numbers, endpoints.

All of them raise `BadInputError` with the field, the value and the allowed values.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import attrs
from attrs.validators import optional

from laneweave.protocol.errors import BadInputError, unknown_name
from laneweave.protocol.names import NAME_PATTERN, NAME_RULE

HOST_PORT_RULE = "HOST:PORT with a port from 1 to 65535, or nothing"
LINK_OPTIONS = ("?rel=0", "?mixed_rel=1", "?rel=1;mixed_rel=1")
"""Zenoh's options for links over datagrams: all messages unreliable; unreliable and reliable
messages; the same, where links are not reliable by default (`udp/`)."""
ENDPOINT_RULE = (
    "unixsock-stream/PATH, tcp/HOST:PORT, tls/HOST:PORT, or udp/HOST:PORT or quic/HOST:PORT with "
    f"one of {', '.join(LINK_OPTIONS)} or nothing"
)
# Zenoh reads session settings, including those of TLS, after `?` and `#`: allow only known ones.
_NETWORK = re.compile(
    r"(?:tcp|tls|(?P<datagrams>udp|quic))/"
    r"(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\s/:?#\[\]]+):(?P<port>\d{1,5})"
    rf"(?P<options>{'|'.join(map(re.escape, LINK_OPTIONS))})?"
)
_SOCKET = re.compile(r"unixsock-stream/[^?#]+")
Validator = Callable[[Any, "attrs.Attribute[Any]", Any], None]


def within(low: float, high: float, *, open_low: bool = False) -> Validator:
    """Return a validator for a finite number in [low, high], or (low, high] if `open_low`."""

    def check(_: object, attribute: attrs.Attribute[Any], value: float) -> None:
        # NaN fails both comparisons.
        if not low <= value <= high or (open_low and value == low):
            bracket = "(" if open_low else "["
            raise BadInputError(attribute.name, value, f"{bracket}{low:g}, {high:g}]")

    return check


def within_or_none(low: float, high: float, *, open_low: bool = False) -> Validator:
    """Return a validator for None or a number `within` a range."""
    return optional(within(low, high, open_low=open_low))


def one_of(*choices: object) -> Validator:
    """Return a validator for a fixed set of values."""

    def check(_: object, attribute: attrs.Attribute[Any], value: object) -> None:
        if value not in choices:
            allowed = ", ".join(map(str, choices))
            raise unknown_name(attribute.name, value, choices, allowed)

    return check


def key_part(_: object, attribute: attrs.Attribute[Any], value: str) -> None:
    """Check that a value is valid as one part of a key."""
    if not NAME_PATTERN.fullmatch(value):
        raise BadInputError(attribute.name, value, NAME_RULE)


def key_parts(_: object, attribute: attrs.Attribute[Any], value: Sequence[str]) -> None:
    """Check that all values are unique and valid as parts of keys."""
    for one in value:
        key_part(None, attribute, one)
        if value.count(one) > 1:
            raise BadInputError(attribute.name, one, "each name once")


def host_port(_: object, attribute: attrs.Attribute[Any], value: str) -> None:
    """Check that a value is HOST:PORT or empty."""
    if value:
        host_and_port(attribute.name, value)


def host_and_port(name: str, text: str) -> tuple[str, int]:
    """Return the host and port of HOST:PORT; IPv6 addresses are in brackets.

    Raises:
        BadInputError: the text does not have this form.
    """
    host, _, port = text.rpartition(":")
    bare = host[1:-1] if host[:1] == "[" and host[-1:] == "]" else host
    is_port = port.isascii() and port.isdecimal() and len(port) < 6 and 1 <= int(port) <= 65535
    if not is_port or not bare or (":" in bare) != (bare != host) or " " in bare:
        raise BadInputError(name, text, HOST_PORT_RULE)
    return bare, int(port)


def check_endpoint(endpoint: str, name: str = "network.endpoint") -> str:
    """Return a Zenoh endpoint unchanged if it is valid; `name` is the field named in the error.

    Raises:
        BadInputError: the endpoint is malformed, or the Zenoh wheel lacks its protocol.
    """
    found = _NETWORK.fullmatch(endpoint)
    if found is None:
        valid = _SOCKET.fullmatch(endpoint) is not None
    else:
        valid = int(found["port"]) <= 65535 and bool(found["datagrams"] or not found["options"])
    if not valid:
        raise BadInputError(name, endpoint, ENDPOINT_RULE)
    return endpoint


def is_encrypted(endpoint: str) -> bool:
    """Return whether traffic through an endpoint is encrypted."""
    return link_of(endpoint).startswith(("tls", "quic"))


def link_of(endpoint: str) -> str:
    """Return the protocol of an endpoint with its options, such as `quic?rel=0`.

    Only endpoints of the same link can be connected.
    """
    address, question_mark, options = endpoint.partition("?")
    return address.partition("/")[0] + question_mark + options


def host_of(endpoint: str) -> str:
    """Return the host of a valid endpoint without brackets; empty for socket files."""
    found = _NETWORK.fullmatch(endpoint)
    return found["host"].strip("[]") if found else ""
