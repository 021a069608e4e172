"""A `BadInputError` is one short, readable line, whatever the value is."""

from __future__ import annotations

import pickle
from typing import Any

import pytest

from laneweave.protocol.errors import (
    UNKNOWN_KEY,
    BadInputError,
    combined,
    most_similar,
    raise_all,
    unknown_name,
)


@pytest.mark.parametrize(
    "value",
    [
        "x" * 10**6,
        "a\nb\r\x1b[2J\u2028c",
        16**20_000,
        list(range(10**5)),
        {"a": "b" * 10**5},
        b"\n",
    ],
    ids=["long", "controls", "huge int", "list", "map", "bytes"],
)
def test_an_error_is_one_short_readable_line(value: object) -> None:
    for field in ("road.lanes", str(value)[:200] if not isinstance(value, int) else "x"):
        line = str(BadInputError(field, value, "what is allowed"))
        assert len(line.splitlines()) == 1
        assert line.isprintable()
        assert len(line) < 300
        assert line.endswith("; allowed: what is allowed")


def test_an_error_shows_values_that_contain_themselves_or_nest_deeply() -> None:
    loop: list[Any] = []
    loop.append(loop)
    deep: list[Any] = []
    for _ in range(5000):
        deep = [deep]
    for value in (loop, deep):
        assert len(str(BadInputError("field", value, "less"))) < 120


def test_within_joins_names() -> None:
    def joined(parent: str, field: str) -> str:
        return BadInputError(field, 1, "2").within(parent).field

    assert joined("road", "lanes") == "road.lanes"
    assert joined("kill", "[1].at_s") == "kill[1].at_s"
    assert joined("", "seed") == "seed"
    assert joined("seed", "") == "seed"


def several() -> BadInputError:
    return combined([BadInputError("a", 1, "2"), BadInputError("[0].b", 3, "4")])


def test_several_errors_are_one_that_has_them_all() -> None:
    error = several()
    assert str(error) == "a: got 1; allowed: 2 (and 1 more error)"
    assert [str(one) for one in error.problems] == [
        "a: got 1; allowed: 2",
        "[0].b: got 3; allowed: 4",
    ]
    assert [one.field for one in error.within("t").problems] == ["t.a", "t[0].b"]
    assert [one.place for one in error.at("x:1").at("x:2").problems] == ["x:1", "x:1"]
    assert str(combined([*error.problems, error, error])) == str(error)


def test_one_error_is_itself() -> None:
    error = BadInputError("a", 1, "2")
    assert combined([error]) is error
    assert error.problems == (error,)
    raise_all([])
    with pytest.raises(BadInputError, match=r"^a: got 1; allowed: 2$"):
        raise_all([error])


@pytest.mark.parametrize("error", [several(), BadInputError("a", 1, "2").at("x:1")])
def test_errors_go_to_other_processes(error: BadInputError) -> None:
    again = pickle.loads(pickle.dumps(error))  # noqa: S301 (made here)
    assert (type(again), str(again)) == (type(error), str(error))
    assert list(map(str, again.problems)) == list(map(str, error.problems))


def test_an_error_ends_with_a_suggestion_and_its_place() -> None:
    error = BadInputError("a", "tapa", "tappa", choices=("tappa",), place="x.toml:3")
    assert str(error) == "a: got 'tapa'; allowed: tappa; did you mean tappa? (x.toml:3)"
    assert str(error.within("t")) == f"t.{error}"
    error = BadInputError("a", UNKNOWN_KEY, "b").suggesting("t.a").at("x.toml:3")
    assert str(error) == "a: got an unknown key; allowed: b; did you mean t.a? (x.toml:3)"


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("lane", "lanes"),
        ("LANES", "lanes"),
        ("lane-width-m", "lane_width_m"),
        ("volume", "volume_veh_per_lane_h"),
        ("wings", ""),
        ("", ""),
        (3, ""),
        ("lanes" * 10**5, ""),
    ],
)
def test_the_most_similar_name(name: object, meant: str) -> None:
    choices = ("lane_width_m", "volume_veh_per_lane_h", "lanes", "s1_m")
    assert most_similar(name, choices) == meant


def test_an_unknown_name() -> None:
    assert str(unknown_name("solver", "tapa", ("tappa", "branching"))) == (
        "solver: got 'tapa'; allowed: one of tappa, branching; did you mean tappa?"
    )
    assert str(unknown_name("road.lane", UNKNOWN_KEY, ("lanes",), "known keys")) == (
        "road.lane: got an unknown key; allowed: known keys; did you mean lanes?"
    )
