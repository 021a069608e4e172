"""The key grammar: what is built is read back, and nothing foreign is understood."""

from __future__ import annotations

import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from laneweave.protocol.names import NAME_PATTERN
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.codec import KINDS
from support.refusals import refusal
from support.tables import for_each

KEYS = topics.Keys("r-1")
NAMES = st.from_regex(NAME_PATTERN, fullmatch=True)
BAD_PARTS = ("", "a/b", "a*", "**", "$*", "a#b", "a?b", "a b", "é", "x" * 65, "a\n", "{x}", "@")


def filled(topic: topics.Topic, text: str = "x") -> dict[str, str]:
    return {name: f"{text}{index}" for index, name in enumerate(topic.parameters)}


@given(st.sampled_from(topics.TOPICS), st.lists(NAMES, min_size=5, max_size=5), NAMES)
@example(topics.STATE, ["y" * 64] * 5, "x" * 64)
def test_what_is_built_is_read_back(topic: topics.Topic, texts: list[str], realm: str) -> None:
    keys = topics.Keys(realm)
    parameters = dict(zip(topic.parameters, texts, strict=False))
    key = keys.key(topic, **parameters)
    assert keys.read(key) == (topic, parameters)
    assert topics.matches(keys.all_of(topic), key)
    assert not re.search(r"[*$?#\s{}]|//|^/|/$", key)


def test_numbers_become_text() -> None:
    key = KEYS.key(topics.STATE, block=-3, vehicle="v1")
    assert key == "laneweave/r-1/state/-3/v1"
    assert KEYS.read(key) == (topics.STATE, {"block": "-3", "vehicle": "v1"})
    # Equal numbers with different texts stay apart.
    keys = [KEYS.key(topics.COMMAND, vehicle=vehicle) for vehicle in (1, True, 1.0, "1")]
    assert [key.rpartition("/")[2] for key in keys] == ["1", "True", "1.0", "1"]


def test_the_parameters_of_a_key_cannot_be_changed() -> None:
    key = KEYS.key(topics.COMMAND, vehicle="v1")
    known = KEYS.read(key)
    assert known is not None
    with pytest.raises(TypeError):
        known[1]["vehicle"] = "v2"  # type: ignore[index]
    assert KEYS.read(key) == (topics.COMMAND, {"vehicle": "v1"})


def test_topics_are_distinct_and_have_no_reserved_characters() -> None:
    assert len({topic.name for topic in topics.TOPICS}) == len(topics.TOPICS)
    for topic in topics.TOPICS:
        assert re.fullmatch(r"([a-z]+|{[a-z]+})(/([a-z]+|{[a-z]+}))*", topic.pattern)
        assert re.fullmatch(r"[a-z-]+", topic.name)
    shapes = {re.sub(r"{\w+}", "*", topic.pattern) for topic in topics.TOPICS}
    assert len(shapes) == len(topics.TOPICS)
    keys = [KEYS.key(topic, **filled(topic)) for topic in topics.TOPICS]
    for topic, key in zip(topics.TOPICS, keys, strict=True):
        assert [other for other in keys if topics.matches(KEYS.all_of(topic), other)] == [key]


def test_only_short_messages_that_the_next_one_replaces_may_be_lost_by_a_link() -> None:
    unreliable = {topic.name for topic in topics.TOPICS if not topic.reliable}
    assert unreliable == {"clock", "state", "motion", "heartbeat", "obstacles"}


def test_every_message_kind_has_one_topic() -> None:
    carried = [topic.kind for topic in topics.TOPICS if topic.kind is not None]
    assert sorted(kind.__name__ for kind in carried) == sorted(KINDS)


@for_each("topic", topics.TOPICS)
def test_a_foreign_realm_is_not_understood(topic: topics.Topic) -> None:
    key = KEYS.key(topic, **filled(topic))
    assert topics.Keys("r-2").read(key) is None
    assert topics.Keys("r").read(key) is None
    assert KEYS.read(key.replace("laneweave/", "other/")) is None
    assert KEYS.read("/" + key) is None
    assert KEYS.read(key + "/") is None
    assert KEYS.read(key + "/more") is None
    assert KEYS.read(key.rpartition("/")[0]) is None


@for_each("key", ["", "/", "laneweave", "laneweave/r-1", "laneweave/r-1/", "laneweave/r-1/none",
     "laneweave/r-1/CLOCK", "laneweave/r-1/clock/x", "laneweave/r-1/state/1", "clock",
     "laneweave/r-1/state//v1", "laneweave/r-1/alive/tram/x", "laneweave//r-1/clock",
     "laneweave/r-1/command/*", "laneweave/r-1/command/**", "laneweave/r-1/**",
     "laneweave/*/clock", "laneweave/r-1/command/é", "laneweave/r-1/command/{vehicle}",
     "laneweave/r-1/command/" + "x" * 65, "laneweave/r-1/command/a b"])  # fmt: skip
def test_a_malformed_key_is_not_understood(key: str) -> None:
    assert KEYS.read(key) is None


@given(st.text(max_size=40))
def test_any_text_is_read_or_refused(text: str) -> None:
    for key in (text, f"laneweave/r-1/{text}", f"laneweave/r-1/state/{text}"):
        known = KEYS.read(key)
        if known is not None:
            topic, parameters = known
            assert KEYS.key(topic, **parameters) == key


@for_each("part", BAD_PARTS)
def test_what_is_no_key_part_is_refused(part: str) -> None:
    assert refusal(KEYS.key, topics.COMMAND, vehicle=part).field == "vehicle"
    assert refusal(topics.Keys, part).field == "network.realm"
    assert refusal(topics.Keys, "*").field == "network.realm"


def test_expressions_leave_parameters_open() -> None:
    assert KEYS.all_of(topics.CLOCK) == "laneweave/r-1/clock"
    assert KEYS.all_of(topics.VEHICLE_ALIVE) == "laneweave/r-1/alive/vehicle/*/*"
    assert KEYS.key(topics.STATE, block=2, vehicle="*") == "laneweave/r-1/state/2/*"


def test_a_missing_parameter_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(KeyError):
        KEYS.key(topics.COMMAND)


@for_each(
    ("expression", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/c", False),
        ("a/*", "a/b", True),
        ("a/*", "a", False),
        ("a/*", "a/b/c", False),
        ("*/b", "a/b", True),
        ("a/**", "a", True),
        ("a/**", "a/b/c", True),
        ("**/c", "a/b/c", True),
        ("a/**/c", "a/c", True),
        ("a/**/c", "a/b/b/c", True),
        ("a/**/c", "a/b", False),
        ("**", "a/b", True),
    ],
)
def test_matching_follows_zenohs_rules(expression: str, key: str, *, expected: bool) -> None:
    assert topics.matches(expression, key) is expected


@for_each("topic", topics.TOPICS)
def test_declared_expressions_begin_with_a_wildcard_and_match_the_same_keys(
    topic: topics.Topic,
) -> None:
    keys = topics.Keys("site")
    key = keys.key(topic, **filled(topic))
    for expression in (key, keys.all_of(topic)):
        declared = topics.declared(expression)
        assert declared.startswith("*/")
        assert topics.matches(declared, key)
        assert topics.declared(declared) == declared
    assert topics.undeclared(topics.declared(key)) == key
    assert topics.declared("**") == "**"
