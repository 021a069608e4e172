"""MessagePack codec of the messages: [version, kind, fields].

Decoding checks size, version, kind, field names, types, finiteness and ranges; whatever is wrong
becomes one `BadInputError`. It never raises anything else, whatever the bytes.
"""

from __future__ import annotations

from typing import Any

import msgpack
from attrs import fields
from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn

from laneweave.protocol import messages
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.messages import Ballot, Name
from laneweave.protocol.structuring import first_problem, strict_converter
from laneweave.protocol.topics import NAME_PATTERN

VERSION = 1
MAX_BYTES = 1 << 20
KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        messages.Heartbeat,
        messages.Prepare,
        messages.Plan,
        messages.VehicleState,
        messages.Sense,
        messages.Command,
        messages.Census,
        messages.RoadClock,
        messages.Report,
        messages.LogEvent,
    )
}
_MAX_INT = 2**63


def _name(value: object, _: type) -> str:
    if type(value) is not str or not NAME_PATTERN.fullmatch(value):
        raise BadInputError("", value, "a name of letters, digits, `_`, `-`, `.`; at most 64")
    return value


def _integer(value: object, _: type) -> int:
    if type(value) is not int or not -_MAX_INT <= value < _MAX_INT:
        raise BadInputError("", value, "a 64-bit integer")
    return value


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
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise BadInputError("", value, "a map with text keys")
    return value


def _make_converter(*, detailed: bool) -> Any:  # noqa: ANN401 (cattrs converters are generic)
    converter = strict_converter(detailed=detailed)
    converter.register_structure_hook(int, _integer)
    converter.register_structure_hook(Name, _name)
    converter.register_structure_hook(Ballot, _ballot)
    converter.register_structure_hook_func(lambda kind: kind == dict[str, Any], _plain_data)
    # Parts before wholes: the generated code of a whole looks its parts up once.
    for kind in (messages.Neighbour, messages.CensusEntry, messages.Announcement, *KINDS.values()):
        converter.register_structure_hook(
            kind,
            make_dict_structure_fn(
                kind,
                converter,
                _cattrs_forbid_extra_keys=True,
                _cattrs_detailed_validation=detailed,
            ),
        )
        converter.register_unstructure_hook(kind, make_dict_unstructure_fn(kind, converter))
    return converter


_FAST = _make_converter(detailed=False)
_DETAILED = _make_converter(detailed=True)


def encode(message: object) -> bytes:
    """Return the bytes of a message."""
    body = _FAST.unstructure(message)
    packed = msgpack.packb((VERSION, type(message).__name__, body))
    assert isinstance(packed, bytes)  # noqa: S101 (narrows msgpack's untyped result)
    return packed


def decode(payload: bytes, expected: type | None = None) -> object:
    """Return the message in `payload`.

    Args:
        payload: any bytes.
        expected: the message class that this key carries; None: any.

    Raises:
        BadInputError: the bytes are not exactly one well-formed message of the expected kind.
    """
    kind, body = _open_envelope(payload, expected)
    try:
        return _FAST.structure(body, kind)
    except Exception:  # noqa: BLE001 (whatever it was, the slow converter names the field)
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
        raise first_problem(error).within(kind.__name__) from error


def field_names(kind: type) -> tuple[str, ...]:
    """Return the field names of a message class, for the documentation."""
    return tuple(attribute.name for attribute in fields(kind))
