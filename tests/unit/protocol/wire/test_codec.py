"""The codec: what goes in comes out; all that is not exactly a message is one `BadInputError`."""

from __future__ import annotations

import math
import random
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import NODEFAULT
from msgspec.structs import FieldInfo, fields

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.names import NAME_PATTERN
from laneweave.protocol.wire import messages, obstacle_messages, process_messages
from laneweave.protocol.wire.codec import KINDS, MAX_BYTES, VERSION, decode, encode
from laneweave.protocol.wire.messages import (
    Ballot,
    Heartbeat,
    Name,
    Plan,
    RoadClock,
    Sense,
    VehicleState,
)
from laneweave.protocol.wire.process_messages import ProcessSettings, Report
from support.examples import examples
from support.refusals import refusal
from support.tables import for_each
from support.wire_samples import HINTS, different, filled, is_struct

SAMPLES: dict[type, Any] = {kind: filled(kind, different()) for kind in KINDS.values()}
each_sample = for_each("sample", SAMPLES.values())
NAMES_NOT_ALLOWED = ("a/b", "a*", "", "x" * 65, "a b", "a#", "$", "a?", "é", "a\n", "v1\n", "\0")

Body = list[Any]


# --- what is well typed, and how to draw it ---------------------------------------------------


def is_well_typed(value: object, hint: Any) -> bool:  # noqa: ANN401
    """Tell whether a value is what the annotation says, exactly and at every depth."""
    if hint is Name:
        return type(value) is str and NAME_PATTERN.fullmatch(value) is not None
    if hint is Ballot:
        return type(value) is Ballot and all(map(is_well_typed, value, (int, Name, int, int)))
    if is_struct(hint):
        return type(value) is hint and all(
            is_well_typed(getattr(value, name), part) for name, part in HINTS[hint].items()
        )
    if hint is int:
        return type(value) is int and -(2**63) <= value < 2**63
    if hint is float:
        return type(value) is float and math.isfinite(value)
    if get_origin(hint) in (Union, UnionType):
        return any(is_well_typed(value, part) for part in get_args(hint))
    if get_origin(hint) is tuple:
        return _is_well_typed_tuple(value, get_args(hint))
    if get_origin(hint) is dict:
        key_hint, value_hint = get_args(hint)
        return type(value) is dict and all(
            is_well_typed(key, key_hint) and (value_hint is Any or is_well_typed(item, value_hint))
            for key, item in value.items()
        )
    return type(value) is hint


def _is_well_typed_tuple(value: object, parts: tuple[Any, ...]) -> bool:
    if type(value) is not tuple:
        return False
    if parts[-1] is Ellipsis:
        return all(is_well_typed(item, parts[0]) for item in value)
    return len(value) == len(parts) and all(map(is_well_typed, value, parts))


INTS = st.integers(-(2**63), 2**63 - 1)
NAMES = st.from_regex(NAME_PATTERN, fullmatch=True)
NUMBERS = st.floats(-1e12, 1e12)
PLAIN = st.dictionaries(
    st.text(max_size=8),
    st.recursive(
        st.none() | st.booleans() | INTS | NUMBERS | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
        ),
        max_leaves=6,
    ),
    max_size=4,
)
SIMPLE: dict[Any, st.SearchStrategy[Any]] = {
    int: INTS,
    float: NUMBERS,
    bool: st.booleans(),
    bytes: st.binary(max_size=40),
    Name: NAMES,
    str: st.text(max_size=40),
    NoneType: st.none(),
    Ballot: st.builds(Ballot, INTS, NAMES, INTS, INTS),
    dict[str, Any]: PLAIN,
}


def values(hint: Any) -> st.SearchStrategy[Any]:  # noqa: ANN401
    """Return a strategy for the values of an annotation."""
    if hint in SIMPLE:
        return SIMPLE[hint]
    if is_struct(hint):
        return st.builds(hint, **{name: values(part) for name, part in HINTS[hint].items()})
    parts = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        return st.one_of(*map(values, parts))
    if get_origin(hint) is dict:
        return st.dictionaries(values(parts[0]), values(parts[1]), max_size=4)
    if parts[-1] is Ellipsis:
        return st.lists(values(parts[0]), max_size=4).map(tuple)
    return st.tuples(*map(values, parts))


def envelope(message: object) -> tuple[int, str, Body]:
    """Return version, kind and fields of a message as a stranger would write them."""
    version, kind, body = msgpack.unpackb(encode(message), strict_map_key=False)
    return version, kind, body


def pack(*parts: object) -> bytes:
    packed: bytes = msgpack.packb(list(parts))
    return packed


def accepts_only_well_typed(payload: bytes) -> bool:
    """Decode any bytes; tell whether they were a message, which then has the right types."""
    problem: BadInputError | None = None
    try:
        message = decode(payload)
    except BadInputError as error:
        problem = error
    if problem is not None:
        assert len(str(problem).splitlines()) == 1
        return False
    assert is_well_typed(message, type(message))
    return True


def place_of(kind: type, name: str) -> int:
    """Return the place of a field in the array of a message."""
    return [*HINTS[kind]].index(name)


def changed(sample: object, name: str, value: object) -> bytes:
    """Return the bytes of a message with another value in a field."""
    version, kind, body = envelope(sample)
    body[place_of(type(sample), name)] = value
    return pack(version, kind, body)


# --- round trip -------------------------------------------------------------------------------


def test_every_class_of_a_message_has_a_sample() -> None:
    modules = messages, obstacle_messages, process_messages
    found = [one for module in modules for one in vars(module).values() if is_struct(one)]
    classes = {one for one in found if one.__module__ in [module.__name__ for module in modules]}
    assert classes == set(HINTS)


@each_sample
def test_a_sample_comes_back_equal_and_well_typed(sample: object) -> None:
    decoded = decode(encode(sample), type(sample))
    assert decoded == sample
    assert is_well_typed(decoded, type(sample))
    assert len(envelope(sample)[2]) == len(HINTS[type(sample)])


@pytest.mark.slow
@examples(200)
@given(st.sampled_from([*KINDS.values()]).flatmap(values))
def test_any_value_comes_back(message: object) -> None:
    decoded = decode(encode(message), type(message))
    assert decoded == message
    assert is_well_typed(decoded, type(message))


def test_an_int_is_taken_where_a_number_is_meant() -> None:
    decoded = decode(changed(SAMPLES[RoadClock], "t_s", 13))
    assert isinstance(decoded, RoadClock)
    assert type(decoded.t_s) is float


# --- the envelope -----------------------------------------------------------------------------


BEAT = envelope(SAMPLES[Heartbeat])[2]
VERSIONS: list[object] = [0, 1, 2, 4, -1, "1", None, True, 1.0, [1], {}, b"1", 2**64 - 1]
NO_KINDS: list[object] = [
    "Hearbeat", "heartbeat", "", "object", "Ballot", "Neighbour", 1, None, [], {}, b"Plan"
]  # fmt: skip
WRONG_ENVELOPES: list[tuple[object, str]] = [
    *(([version, "Heartbeat", BEAT], "version") for version in VERSIONS),
    *(([VERSION, kind, BEAT], "kind") for kind in NO_KINDS),
    *(
        ([VERSION, "RoadClock", body], "RoadClock")
        for body in (None, 1, "x", {}, {"tick": 1}, b"", True)
    ),
    *(
        (whole, "message")
        for whole in (None, 1, "Plan", {}, [], [1], [VERSION, "Plan"], [VERSION, "Plan", [], []],
                      {"0": VERSION, "1": "Plan"})
    ),
]  # fmt: skip


@for_each(("whole", "field"), WRONG_ENVELOPES)
def test_a_wrong_envelope_is_refused_by_its_part(whole: object, field: str) -> None:
    assert VERSION == 3
    packed: bytes = msgpack.packb(whole)
    assert refusal(decode, packed).field == field


def test_another_kind_than_the_expected_is_refused() -> None:
    for sample in SAMPLES.values():
        for expected in KINDS.values():
            if expected is not type(sample):
                error = refusal(decode, encode(sample), expected)
                assert error.field == "kind"
                assert expected.__name__ in str(error)


def test_an_oversize_payload_is_refused_before_it_is_read() -> None:
    payload = changed(SAMPLES[Report], "solve_ms", b"\0" * MAX_BYTES)
    assert refusal(decode, payload).field == "message"
    assert refusal(decode, b"\0" * (MAX_BYTES + 1)).field == "message"


# --- field by field ---------------------------------------------------------------------------

FIELDS = [(sample, name) for sample in SAMPLES.values() for name in HINTS[type(sample)]]
NUMBERS_NOT_ALLOWED = (math.nan, math.inf, -math.inf, 1.1e12, -1e300)
NOT_INTS: tuple[Any, ...] = (True, False, 1.0, "1", None, [], {}, b"1", 2**63, 2**64 - 1, -math.inf)
NOT_LISTS: tuple[Any, ...] = (None, 1, True, "ab", b"ab", {}, {0: 1, 1: 2}, {"0": 1})
NOT_MAPS: tuple[Any, ...] = (None, 1, True, "ab", b"ab", [], [["v1", 1]])
BALLOTS_NOT_ALLOWED: tuple[Any, ...] = (
    [], [1, "c", 2], [1, "c", 2, 3, 4], [True, "c", 2, 3], [1, "c/", 2, 3], [1, 7, 2, 3],
    [1, "c", 2.0, 3], [1, "c", 2, "3"], [2**63, "c", 2, 3], "abcd", b"abcd", 4, {},
    {"term": 1, "coordinator": "c", "incarnation": 2, "seq": 3}, [[1, "c", 2, 3]],
)  # fmt: skip


def wrong_values(hint: Any) -> list[Any]:  # noqa: ANN401
    """Return values that an annotation does not allow."""
    parts = get_args(hint)
    if hint == dict[str, Any]:
        deep: Any = 1
        for _ in range(300):
            deep = [deep]
        foreign: tuple[Any, ...] = (
            math.nan,
            b"x",
            2**63,
            msgpack.ExtType(5, b"x"),
            msgpack.Timestamp(1, 2),
            deep,
        )
        keys: list[Any] = [{1: 1}, {"a": {1: 1}}, {b"a": 1}]
        return [*NOT_MAPS, *keys, *({"a": item} for item in foreign)]
    if get_origin(hint) is dict:
        names = (*(NAMES_NOT_ALLOWED if parts[0] is Name else ()), 1, None, b"v1")
        named: list[Any] = [{name: right_value(parts[1])} for name in names]
        return [*NOT_MAPS, *named, *({"v1": wrong} for wrong in wrong_values(parts[1]))]
    if get_origin(hint) is tuple and parts[-1] is Ellipsis:
        return [*NOT_LISTS] + [[wrong] for wrong in wrong_values(parts[0])]
    if get_origin(hint) is tuple:
        good = [right_value(part) for part in parts]
        nested = [
            [*good[:place], wrong, *good[place + 1 :]]
            for place, part in enumerate(parts)
            for wrong in wrong_values(part)
        ]
        return [*NOT_LISTS, [], good[:-1], [*good, good[-1]], *nested]
    if is_struct(hint):
        body = [right_value(part) for part in HINTS[hint].values()]
        needed = sum(map(is_required, fields(hint)))
        lacking: list[Any] = [body[:count] for count in range(needed)]
        parts_wrong: list[Any] = [
            [*body[:place], wrong, *body[place + 1 :]]
            for place, part in enumerate(HINTS[hint].values())
            for wrong in wrong_values(part)
        ]
        return [*NOT_LISTS, *lacking, *parts_wrong]
    simple: dict[Any, list[Any]] = {
        int: [*NOT_INTS],
        float: [*NUMBERS_NOT_ALLOWED, True, "1.0", None, [], {}, b"1"],
        bool: [0, 1, 0.0, "true", None, [], {}, b""],
        bytes: ["x", None, 1, [], [0, 0], {}, True],
        str: [1, True, None, [], {}, b"v1", 1.5],
        Name: [*NAMES_NOT_ALLOWED, 1, True, None, [], {}, b"v1", 1.5],
        Ballot: [None, *BALLOTS_NOT_ALLOWED],
        Ballot | None: [*BALLOTS_NOT_ALLOWED],
    }
    if hint not in simple and NoneType in parts:
        return [wrong for wrong in wrong_values(parts[0]) if wrong is not None]
    return simple[hint]


def is_required(field: FieldInfo) -> bool:
    return field.default is NODEFAULT and field.default_factory is NODEFAULT


def right_value(hint: Any) -> Any:  # noqa: ANN401
    """Return one allowed value."""
    parts = get_args(hint)
    if get_origin(hint) is tuple:
        return [] if parts[-1] is Ellipsis else [right_value(part) for part in parts]
    if NoneType in parts:
        return None
    return {
        int: 1,
        float: 1.0,
        bool: True,
        bytes: b"",
        Name: "v1",
        str: "",
        Ballot: [1, "c", 2, 3],
    }[hint]


@for_each(("sample", "name"), FIELDS)
def test_every_wrong_value_of_a_field_is_refused_by_name(sample: object, name: str) -> None:
    wrongs = wrong_values(HINTS[type(sample)][name])
    assert len(wrongs) > 5
    for wrong in wrongs:
        error = refusal(decode, changed(sample, name, wrong), type(sample))
        assert error.field.startswith(f"{type(sample).__name__}.{name}"), (wrong, error)


@for_each(("sample", "name"), FIELDS)
def test_a_missing_field_is_refused_by_name(sample: object, name: str) -> None:
    """Fields are left out at the end of the array; those with a default may be missing."""
    version, kind, body = envelope(sample)
    place = place_of(type(sample), name)
    payload = pack(version, kind, body[:place])
    if is_required(fields(type(sample))[place]):  # type: ignore[arg-type]
        assert refusal(decode, payload).field == f"{kind}.{name}"
    else:
        assert accepts_only_well_typed(payload)


def longer(value: object, hint: Any) -> tuple[Any, int]:  # noqa: ANN401
    """Return a part of a message as a later release sends it, and how many fields were added."""
    hint = next((part for part in _parts_of_union(hint) if part is not NoneType), hint)
    if is_struct(hint) and isinstance(value, list):
        hints = list(HINTS[hint].values())
        found = [longer(item, part) for item, part in zip(value, hints, strict=False)]
        return [*(item for item, _ in found), "new", [1]], 2 + sum(count for _, count in found)
    if get_origin(hint) is tuple and get_args(hint)[-1] is Ellipsis and isinstance(value, list):
        found = [longer(item, get_args(hint)[0]) for item in value]
        return [item for item, _ in found], sum(count for _, count in found)
    return value, 0


def _parts_of_union(hint: Any) -> tuple[Any, ...]:  # noqa: ANN401
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


@each_sample
def test_fields_of_a_later_release_are_skipped_and_counted(sample: object) -> None:
    version, kind, body = envelope(sample)
    later, added = longer(body, type(sample))
    skipped: list[int] = []
    assert decode(pack(version, kind, later), type(sample), skipped.append) == sample
    assert skipped == [added]
    assert decode(encode(sample), type(sample), skipped.append) == sample
    assert skipped == [added]
    assert refusal(decode, pack(version + 1, kind, body)).field == "version"


@each_sample
def test_a_map_of_fields_is_refused(sample: object) -> None:
    version, kind, _ = envelope(sample)
    assert refusal(decode, pack(version, kind, {"tick": 1})).field == kind


def test_a_wrong_field_is_named_also_if_a_later_release_has_sent_it() -> None:
    version, kind, body = envelope(SAMPLES[RoadClock])
    error = refusal(decode, pack(version, kind, ["1", *body[1:], "new"]))
    assert error.field == "RoadClock.tick"


NEIGHBOUR = [0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("name", "wrong", "path"),
    [
        ("ahead", [[0, 1.0]], "[0].speed_mps"),
        ("ahead", [NEIGHBOUR, [0, "1", 1.0]], "[1].gap_m"),
        ("ahead", [{"lane": 0}], "[0]"),
        ("behind", [[*NEIGHBOUR, None]], "[0].accel_mps2"),
        ("setpoint", [0.0, math.inf], "[1]"),
        ("hold_cell", [0, "1"], "[1]"),
    ],
)
def test_the_path_leads_to_the_wrong_part(name: str, wrong: object, path: str) -> None:
    error = refusal(decode, changed(SAMPLES[Sense], name, wrong))
    assert error.field == f"Sense.{name}{path}"


def test_the_path_leads_into_maps() -> None:
    moves = {"v1": [[0, [0, 0], [0, 1]], [1, [0, 1], [0, None]]], "v2": []}
    error = refusal(decode, changed(SAMPLES[Plan], "moves", moves))
    assert error.field == "Plan.moves[v1][1][2][1]"
    assert error.value is None


# --- anything at all --------------------------------------------------------------------------


@for_each("opening", [b"\x91", b"\x81", b"\x81\xa1a", b"\x93\x02\xa4Plan\x91"])
@for_each("depth", [100, 500, 1000, 5000, 100_000])
def test_deep_nesting_is_refused(opening: bytes, depth: int) -> None:
    refusal(decode, opening * depth)
    refusal(decode, opening * depth + b"\x01")


@for_each(("sample", "name"), FIELDS)
@for_each("depth", [50, 900, 1100])
def test_a_deeply_nested_field_is_refused(sample: object, name: str, depth: int) -> None:
    inner = b"\x91" * depth + b"\x01"
    payload = changed(sample, name, "HERE").replace(b"\xa4HERE", inner)
    assert refusal(decode, payload).field.startswith((f"{type(sample).__name__}.{name}", "message"))


@each_sample
def test_every_truncation_and_every_addition_is_refused(sample: object) -> None:
    payload = encode(sample)
    for wrong in (payload + b"\0", *(payload[:length] for length in range(len(payload)))):
        assert refusal(decode, wrong).field == "message"


def test_a_repeated_key_is_refused() -> None:
    """The first value is wrong, and other decoders see only the second one."""
    settings = ProcessSettings(Name("agent"), Name("v1"), 1, {"MARK": "y"})
    pairs = b"".join(map(msgpack.packb, ("x", 1, "x", "y")))
    payload = encode(settings).replace(msgpack.packb({"MARK": "y"}), b"\x82" + pairs)
    with pytest.raises(BadInputError):
        decode(payload, ProcessSettings)


def test_an_extension_in_a_message_with_fields_of_a_later_release_is_refused() -> None:
    """A decoder that skips the further fields makes an array of the extension."""
    state = encode(SAMPLES[VehicleState])
    version, name, body = msgpack.unpackb(state, strict_map_key=False)
    for number in range(len(body)):
        for extension in (msgpack.ExtType(5, b"abc"), msgpack.Timestamp(1)):
            changed = [*body, "later"]
            changed[number] = extension
            with pytest.raises(BadInputError):
                decode(msgpack.packb([version, name, changed]), VehicleState)
    census = (
        b"\x93\x03\xa6Census\x97\xcb?\xf0\x00\x00\x00\x00\x00\x00\x91\x99\xa1v\x92\x00\x00"
        b"\x01\xcb\x00\x00\x00\x00\x00\x00\x00\x00\x93\x01\xcb@\x00\x00\x00\x00\x00\x00\x00"
        b"\xc0\xa3end\xa3car\xcb\x00\x00\x00\x00\x00\x00\x00\x00\x90\xc7\x03\x05abc\x91\x93"
        b"\x01\x02\xcb@\x08\x00\x00\x00\x00\x00\x00\xff\x00\x90"
    )
    with pytest.raises(BadInputError):
        decode(census.replace(b"\x93\x03\xa6", b"\x93" + msgpack.packb(VERSION) + b"\xa6"))


def test_random_bytes_and_bodies_are_refused() -> None:
    rng = random.Random(1)
    for number in range(13_000):
        head: bytes = b"" if number % 13 < 10 else b"\x93\x02" + msgpack.packb(rng.choice([*KINDS]))
        assert not accepts_only_well_typed(head + rng.randbytes(rng.randrange(80)))


@pytest.mark.slow
@each_sample
def test_flipped_bits_never_give_wrong_types(sample: object) -> None:
    payload = encode(sample)
    for place in range(len(payload)):
        for bit in range(8):
            flipped = bytearray(payload)
            flipped[place] ^= 1 << bit
            accepts_only_well_typed(bytes(flipped))


JUNK = st.recursive(
    st.none() | st.booleans() | INTS | st.floats() | st.text(max_size=5) | st.binary(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.none() | st.integers(-9, 9) | st.text(max_size=4), inner, max_size=4)
    ),
    max_leaves=10,
)


@pytest.mark.slow
@examples(150)
@given(st.sampled_from(list(SAMPLES.values())), st.data())
def test_junk_in_a_field_never_gives_wrong_types(sample: object, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from([*HINTS[type(sample)]]))
    accepts_only_well_typed(changed(sample, name, data.draw(JUNK)))
