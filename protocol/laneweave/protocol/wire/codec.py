"""MessagePack codec of the messages: [version, kind, [field, ...]].

Decoding checks size, version, kind, number of fields, types, finiteness and ranges. Invalid bytes
raise only `BadInputError`, which names the field.

**Versions.** A release adds fields only at the end of a class and with defaults, so that processes
of two releases understand each other: fields that an earlier release has not sent take their
defaults, and fields of a later one are skipped and counted. Any other change, also of keys, raises
`VERSION`, and processes refuse messages of another version. Named tuples never change.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import suppress
from functools import cache, lru_cache
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import msgpack
from msgspec import Raw, Struct, ValidationError, convert
from msgspec.msgpack import Decoder, Encoder
from msgspec.structs import FieldInfo, fields

from laneweave.protocol.errors import NO_VALUE, BadInputError
from laneweave.protocol.names import NAME_RULE
from laneweave.protocol.wire.field_types import Message
from laneweave.protocol.wire.process_messages import LogEvent
from laneweave.protocol.wire.topics import TOPICS

VERSION = 3
"""Version of the messages."""
MAX_BYTES = 1 << 20
KINDS: dict[str, type[Message]] = {
    topic.kind.__name__: topic.kind for topic in TOPICS if topic.kind is not None
}
REMEMBERED = 128
"""Number of decoded messages that a process remembers: while messages are lost, SENSE and COMMAND
are repeated, and decoding them takes longer than handling the repetition."""
REMEMBERED_BYTES = 2048
"""Maximum size of a message that is remembered, so that no sender can fill the memory."""
_ENCODER = Encoder()
_ENVELOPE = Decoder(tuple[int, str, Raw])
_DECODERS: dict[str, Decoder[Any]] = {name: Decoder(kind) for name, kind in KINDS.items()}
_MAX_DEPTH = 8
_MIN_INT, _MAX_INT = -(2**63), 2**63 - 1
_PLACE = re.compile(r"Expected (?P<allowed>.*?)(?:, got .*?)?(?: - at (?P<path>.*))?", re.DOTALL)
_LONGER = "Expected `array` of at most length"
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


def decode(
    payload: bytes,
    expected: type | None = None,
    on_skipped: Callable[[int], None] = lambda _: None,
) -> object:
    """Return the message in `payload`.

    Args:
        payload: arbitrary bytes.
        expected: required message class; None: any.
        on_skipped: called with the number of skipped fields if a later release has sent them.

    Raises:
        BadInputError: the payload is not one valid message of the expected class.
    """
    if len(payload) > MAX_BYTES:
        raise BadInputError("message", f"{len(payload)} bytes", f"at most {MAX_BYTES} bytes")
    try:
        version, name, body = _ENVELOPE.decode(payload)
        kind = KINDS[name]
        if version == VERSION and (expected is None or kind is expected):
            try:
                message = _DECODERS[name].decode(body)
            except ValidationError as error:
                if not str(error).startswith(_LONGER):
                    raise
                known, skipped = _known(msgpack.unpackb(body, strict_map_key=False), kind)
                message = _DECODERS[name].decode(_ENCODER.encode(known))
                on_skipped(skipped)
            if kind is not LogEvent or _is_plain(message.data, _MAX_DEPTH):
                return message
        problem = ""
    except Exception as error:  # noqa: BLE001 (the slow path names the field)
        problem = str(error) if isinstance(error, ValidationError) else ""
    raise _refusal(payload, expected, problem)


def remembering_decode(on_skipped: Callable[[int], None]) -> Callable[[bytes, type], object]:
    """Return `decode` with a memory for small messages, which are immutable."""

    def read(payload: bytes, kind: type) -> object:
        return decode(payload, kind, on_skipped)

    remembered = lru_cache(REMEMBERED)(read)

    def read_or_recall(payload: bytes, kind: type) -> object:
        small = len(payload) <= REMEMBERED_BYTES
        return remembered(payload, kind) if small else read(payload, kind)

    return read_or_recall


@cache
def _fields(kind: type[Struct]) -> tuple[FieldInfo, ...]:
    return fields(kind)


def _known(value: Any, hint: Any) -> tuple[Any, int]:  # noqa: ANN401 (annotations have no type)
    """Return a part of a message without fields that its class does not have, and their number."""
    hint = next((one for one in _options(hint) if one is not NoneType), hint)
    if isinstance(hint, type) and issubclass(hint, Struct) and isinstance(value, list):
        known = _fields(hint)
        pairs = [_known(item, one.type) for one, item in zip(known, value, strict=False)]
        skipped = max(0, len(value) - len(known))
    elif get_args(hint)[1:] == (Ellipsis,) and isinstance(value, list):
        pairs, skipped = [_known(item, get_args(hint)[0]) for item in value], 0
    elif get_origin(hint) is dict and isinstance(value, dict):
        items = {key: _known(item, get_args(hint)[1]) for key, item in value.items()}
        return (
            {key: item for key, (item, _) in items.items()},
            sum(count for _, count in items.values()),
        )
    else:
        return value, 0
    return [item for item, _ in pairs], skipped + sum(count for _, count in pairs)


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
    if match is not None:
        # A damaged payload may mean something else to this decoder, for example repeated keys.
        with suppress(Exception):
            return _refusal_of_part(kind, body, match)
    return BadInputError("message", bytes(payload[:16]), "MessagePack of a message")


def _refusal_of_part(kind: type, body: object, match: re.Match[str]) -> BadInputError:
    field, value, hint = _part(kind, body, match["path"] or "")
    lacking = _LENGTH.match(match.string.removeprefix("Expected "))
    if lacking is not None and isinstance(hint, type) and issubclass(hint, Struct):
        missing = _fields(hint)[int(lacking[1])].name
        return BadInputError(f"{field}.{missing}", NO_VALUE, "a value; this field is required")
    allowed = match["allowed"]
    for type_name, words in _IN_WORDS.items():
        allowed = allowed.replace(type_name, words)
    return BadInputError(field, value, allowed.split(" matching regex")[0].replace(" | ", " or "))


def _part(kind: type, body: object, path: str) -> tuple[str, Any, Any]:
    """Return the name, value and type of the part of a message to which a decoder's path leads.

    Raises:
        TypeError, LookupError, StopIteration: the message has no such part.
    """
    field, value, hint = kind.__name__, body, kind
    for step in re.findall(r"\[(\d+|\.\.\.)\]", path):
        hint = next((one for one in _options(hint) if one is not NoneType), hint)
        parts = get_args(hint)
        if step == "...":
            if not isinstance(value, dict):
                raise TypeError(value)
            key = next(key for key, item in value.items() if not _is_valid(item, parts[1]))
            field, value, hint = f"{field}[{key}]", value[key], parts[1]
            continue
        index = int(step)
        if not isinstance(value, list):
            raise TypeError(value)
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
