"""MessagePack codec of the messages: [version, kind, [field, ...]].

Decoding checks size, version, kind, number of fields, types, finiteness and ranges. Invalid bytes
raise only `BadInputError`, which names the field.
"""

from __future__ import annotations

import math
import re
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import msgpack
from msgspec import Raw, Struct, ValidationError, convert
from msgspec.msgpack import Decoder, Encoder
from msgspec.structs import fields

from laneweave.protocol.errors import NO_VALUE, BadInputError
from laneweave.protocol.names import NAME_RULE
from laneweave.protocol.wire.field_types import Message
from laneweave.protocol.wire.messages import LogEvent
from laneweave.protocol.wire.topics import TOPICS

VERSION = 2
MAX_BYTES = 1 << 20
KINDS: dict[str, type[Message]] = {
    topic.kind.__name__: topic.kind for topic in TOPICS if topic.kind is not None
}
_ENCODER = Encoder()
_ENVELOPE = Decoder(tuple[int, str, Raw])
_DECODERS: dict[str, Decoder[Any]] = {name: Decoder(kind) for name, kind in KINDS.items()}
_MAX_DEPTH = 8
_MIN_INT, _MAX_INT = -(2**63), 2**63 - 1
_PLACE = re.compile(r"Expected (?P<allowed>.*?)(?:, got .*?)?(?: - at (?P<path>.*))?", re.DOTALL)
_LENGTH = re.compile(r"`array` of at least length \d+, got (\d+)")
_IN_WORDS = {
    "`int`": "a 64-bit integer",
    "`float`": "a number",
    "`bool`": "true or false",
    "`str`": f"a name of {NAME_RULE}",
    "`bytes`": "bytes",
    "`array`": "a list",
    "`object`": "a map",
    "`null`": "nothing",
}


def encode(message: object) -> bytes:
    """Return the bytes of a message."""
    return _ENCODER.encode((VERSION, type(message).__name__, message))


def decode(payload: bytes, expected: type | None = None) -> object:
    """Return the message in `payload`.

    Args:
        payload: arbitrary bytes.
        expected: required message class; None: any.

    Raises:
        BadInputError: the payload is not one valid message of the expected class.
    """
    if len(payload) > MAX_BYTES:
        raise BadInputError("message", f"{len(payload)} bytes", f"at most {MAX_BYTES} bytes")
    try:
        version, name, body = _ENVELOPE.decode(payload)
        kind = KINDS[name]
        if version == VERSION and (expected is None or kind is expected):
            message = _DECODERS[name].decode(body)
            if kind is not LogEvent or _is_plain(message.data, _MAX_DEPTH):
                return message
        problem = ""
    except Exception as error:  # noqa: BLE001 (the slow path names the field)
        problem = str(error) if isinstance(error, ValidationError) else ""
    raise _refusal(payload, expected, problem)


def _refusal(payload: bytes, expected: type | None, problem: str) -> BadInputError:
    """Return the error of a payload that is not a message; `problem`: the decoder's message."""
    try:
        envelope = msgpack.unpackb(payload, strict_map_key=False)
    except Exception:  # noqa: BLE001 (any error means the same)
        return BadInputError("message", bytes(payload[:16]), "MessagePack")
    if not isinstance(envelope, list) or len(envelope) != 3:
        return BadInputError("message", type(envelope).__name__, "[version, kind, fields]")
    version, name, body = envelope
    if type(version) is not int or version != VERSION:
        return BadInputError("version", version, str(VERSION))
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind is None or (expected is not None and kind is not expected):
        allowed = expected.__name__ if expected is not None else ", ".join(KINDS)
        return BadInputError("kind", name, allowed)
    if not problem and kind is LogEvent and isinstance(body, list):
        allowed = "a map of JSON values: text keys, finite 64-bit numbers, not too deep"
        return BadInputError("LogEvent.data", body[-1], allowed)
    match = _PLACE.fullmatch(problem)
    if match is None:
        return BadInputError("message", bytes(payload[:16]), "MessagePack of a message")
    field, value, hint = _part(kind, body, match["path"] or "")
    lacking = _LENGTH.match(problem.removeprefix("Expected "))
    if lacking is not None and isinstance(hint, type) and issubclass(hint, Struct):
        missing = fields(hint)[int(lacking[1])].name
        return BadInputError(f"{field}.{missing}", NO_VALUE, "a value; this field is required")
    allowed = match["allowed"]
    for type_name, words in _IN_WORDS.items():
        allowed = allowed.replace(type_name, words)
    return BadInputError(field, value, allowed.split(" matching regex")[0].replace(" | ", " or "))


def _part(kind: type, body: object, path: str) -> tuple[str, Any, Any]:
    """Return the name, value and type of the part of a message to which a decoder's path leads."""
    field, value, hint = kind.__name__, body, kind
    for step in re.findall(r"\[(\d+|\.\.\.)\]", path):
        hint = next((one for one in _options(hint) if one is not NoneType), hint)
        parts = get_args(hint)
        if step == "...":
            assert isinstance(value, dict)  # noqa: S101 (the decoder has found a map)
            key = next(key for key, item in value.items() if not _is_valid(item, parts[1]))
            field, value, hint = f"{field}[{key}]", value[key], parts[1]
            continue
        index = int(step)
        assert isinstance(value, list)  # noqa: S101 (the decoder has found an array)
        if parts:
            hint, field = parts[0 if parts[-1] is Ellipsis else index], f"{field}[{index}]"
        else:
            name, hint = list(get_type_hints(hint, include_extras=True).items())[index]
            field = f"{field}.{name}"
        value = value[index]
    return field, value, hint


def _options(hint: Any) -> tuple[Any, ...]:  # noqa: ANN401 (annotations have no type)
    return get_args(hint) if get_origin(hint) is UnionType else (hint,)


def _is_valid(value: object, hint: Any) -> bool:  # noqa: ANN401 (annotations have no type)
    try:
        convert(value, hint)
    except ValidationError:
        return False
    return True


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
