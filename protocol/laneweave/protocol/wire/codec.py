"""MessagePack codec of the messages: [version, kind, fields].

Decoding checks size, version, kind, field names, types, finiteness and ranges. Invalid bytes raise
only `BadInputError`.
"""

from __future__ import annotations

import math
from typing import Any

import msgpack

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import NAME_PATTERN, NAME_RULE
from laneweave.protocol.structuring import problems_of, strict_converter
from laneweave.protocol.wire.messages import Ballot, Name
from laneweave.protocol.wire.topics import TOPICS

VERSION = 1
MAX_BYTES = 1 << 20
KINDS: dict[str, type] = {
    topic.kind.__name__: topic.kind for topic in TOPICS if topic.kind is not None
}
_MIN_INT, _MAX_INT = -(2**63), 2**63 - 1
_MIN_FLOAT, _MAX_FLOAT = -1e12, 1e12
"""Range of floats: wider than any position, speed or time, and safe in calculations."""
_MAX_DEPTH = 8


def _name(value: object, _: type) -> str:
    if type(value) is not str or not NAME_PATTERN.fullmatch(value):
        raise BadInputError("", value, "a name of " + NAME_RULE)
    return value


def _integer(value: object, _: type) -> int:
    if type(value) is not int or not _MIN_INT <= value <= _MAX_INT:
        raise BadInputError("", value, "a 64-bit integer")
    return value


def _measure(value: object, _: type) -> float:
    if type(value) is float:
        if _MIN_FLOAT <= value <= _MAX_FLOAT:
            return value
    elif type(value) is int and _MIN_FLOAT <= value <= _MAX_FLOAT:
        return float(value)
    raise BadInputError("", value, f"a number in [{_MIN_FLOAT:g}, {_MAX_FLOAT:g}]")


def _ballot(value: object, _: type) -> Ballot:
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        raise BadInputError("", value, "a ballot [term, coordinator, incarnation, seq]")
    term, coordinator, incarnation, seq = value
    return Ballot(
        _integer(term, int),
        Name(_name(coordinator, str)),
        _integer(incarnation, int),
        _integer(seq, int),
    )


def _plain_data(value: object, _: type) -> dict[str, Any]:
    if not isinstance(value, dict) or not _is_plain(value, _MAX_DEPTH):
        allowed = "a map of JSON values: text keys, finite 64-bit numbers, not too deep"
        raise BadInputError("", value, allowed)
    return value


def _is_plain(value: object, depth: int) -> bool:
    match value:
        case None | bool() | str():
            return True
        case int():
            return _MIN_INT <= value <= _MAX_INT
        case float():
            return math.isfinite(value)
        case list():
            return depth > 0 and all(_is_plain(item, depth - 1) for item in value)
        case dict():
            return depth > 0 and all(
                type(key) is str and _is_plain(item, depth - 1) for key, item in value.items()
            )
    return False


def _make_converter(*, detailed: bool) -> Any:  # noqa: ANN401 (cattrs converters are generic)
    converter = strict_converter(detailed=detailed)
    converter.register_structure_hook(int, _integer)
    converter.register_structure_hook(float, _measure)
    converter.register_structure_hook(Name, _name)
    converter.register_structure_hook(Ballot, _ballot)
    converter.register_structure_hook_func(lambda kind: kind == dict[str, Any], _plain_data)
    return converter


_FAST = _make_converter(detailed=False)
_DETAILED = _make_converter(detailed=True)


def warm_up() -> None:
    """Generate the conversion code of all message classes in advance."""
    for kind in KINDS.values():
        _FAST.get_structure_hook(kind)
        _FAST.get_unstructure_hook(kind)


def encode(message: object) -> bytes:
    """Return the bytes of a message."""
    body = _FAST.unstructure(message)
    packed = msgpack.packb((VERSION, type(message).__name__, body))
    assert isinstance(packed, bytes)  # noqa: S101 (narrows msgpack's untyped result)
    return packed


def decode(payload: bytes, expected: type | None = None) -> object:
    """Return the message in `payload`.

    Args:
        payload: arbitrary bytes.
        expected: required message class; None: any.

    Raises:
        BadInputError: the payload is not one valid message of the expected class.
    """
    kind, body = _open_envelope(payload, expected)
    try:
        return _FAST.structure(body, kind)
    except Exception:  # noqa: BLE001 (the slow converter reports the field)
        return _explain(body, kind)


def _open_envelope(payload: bytes, expected: type | None) -> tuple[type, dict[str, Any]]:
    if len(payload) > MAX_BYTES:
        raise BadInputError("message", f"{len(payload)} bytes", f"at most {MAX_BYTES} bytes")
    try:
        envelope = msgpack.unpackb(payload, strict_map_key=False)
    except Exception as error:
        raise BadInputError("message", bytes(payload[:16]), "MessagePack") from error
    if not isinstance(envelope, list) or len(envelope) != 3:
        raise BadInputError("message", type(envelope).__name__, "[version, kind, fields]")
    version, name, body = envelope
    if type(version) is not int or version != VERSION:
        raise BadInputError("version", version, str(VERSION))
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind is None or (expected is not None and kind is not expected):
        allowed = expected.__name__ if expected is not None else ", ".join(KINDS)
        raise BadInputError("kind", name, allowed)
    if not isinstance(body, dict):
        raise BadInputError(kind.__name__, body, "a map of fields")
    return kind, body


def _explain(body: dict[str, Any], kind: type) -> object:
    try:
        return _DETAILED.structure(body, kind)
    except Exception as error:
        raise problems_of(error)[0].within(kind.__name__) from error
