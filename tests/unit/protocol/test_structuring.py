"""Strict structuring: nothing is coerced, and the path leads to what is wrong."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from attrs import field, frozen

from laneweave.protocol.errors import MAX_PROBLEMS, BadInputError
from laneweave.protocol.field_validators import within
from laneweave.protocol.structuring import KEY, NumberOrRange, json_form, structure, without
from support.refusals import refusal
from support.tables import for_each


@frozen
class Part:
    """A nested table."""

    size: float = field(validator=within(0.0, 10.0))
    name: str = "none"


@frozen
class Whole:
    """Everything that structuring knows."""

    count: int
    flag: bool = False
    raw: bytes = b""
    part: Part = Part(1.0)
    parts: tuple[Part, ...] = ()
    pair: tuple[int, str] = (1, "a")
    table: dict[str, tuple[int, ...]] = field(factory=dict)
    maybe: int | None = None
    span: NumberOrRange = 1.0


@pytest.mark.parametrize(
    ("given", "expected"), [(2, 2.0), (2.5, 2.5), ([1, 2.5], (1.0, 2.5)), ((1, 2), (1.0, 2.0))]
)
def test_a_number_or_a_range(given: object, expected: NumberOrRange) -> None:
    assert structure({"count": 1, "span": given}, Whole).span == expected


@pytest.mark.parametrize("given", ["1", True, [1], [1, 2, 3], [1, "2"], [1, math.inf], {"a": 1}])
def test_neither_a_number_nor_a_range(given: object) -> None:
    with pytest.raises(BadInputError, match=r"^span: got "):
        structure({"count": 1, "span": given}, Whole)


def test_good_data_becomes_the_class() -> None:
    data = {
        "count": 1,
        "flag": True,
        "raw": b"x",
        "part": {"size": 2},
        "parts": [{"size": 3.0, "name": "p"}, {"size": 4}],
        "pair": [2, "b"],
        "table": {"k": [1, 2]},
        "maybe": 5,
    }
    whole = structure(data, Whole)
    assert whole == Whole(
        1, True, b"x", Part(2.0), (Part(3.0, "p"), Part(4.0)), (2, "b"), {"k": (1, 2)}, 5
    )
    assert type(whole.part.size) is float


@for_each(
    ("change", "path"),
    [
        ({"count": True}, "count"),
        ({"count": "1"}, "count"),
        ({"count": 1.0}, "count"),
        ({"flag": 1}, "flag"),
        ({"raw": "x"}, "raw"),
        ({"raw": [1]}, "raw"),
        ({"part": None}, "part"),
        ({"part": []}, "part"),
        ({"part": {}}, "part.size"),
        ({"part": {"size": True}}, "part.size"),
        ({"part": {"size": "1"}}, "part.size"),
        ({"part": {"size": math.nan}}, "part.size"),
        ({"part": {"size": 10**400}}, "part.size"),
        ({"part": {"size": 11}}, "part.size"),
        ({"part": {"size": 1, "name": 1}}, "part.name"),
        ({"part": {"size": 1, "more": 1}}, "part.more"),
        ({"part": {"size": 1, 2: 3}}, "part"),
        ({"parts": {}}, "parts"),
        ({"parts": "ab"}, "parts"),
        ({"parts": {"size": 1}}, "parts"),
        ({"parts": [{"size": 1}, {"size": -1}]}, "parts[1].size"),
        ({"parts": [{"size": 1}, 5]}, "parts[1]"),
        ({"pair": "1a"}, "pair"),
        ({"pair": [1]}, "pair"),
        ({"pair": [1, "a", 2]}, "pair"),
        ({"pair": [1, 2]}, "pair[1]"),
        ({"pair": {1: 1, 2: "a"}}, "pair"),
        ({"table": []}, "table"),
        ({"table": {1: []}}, "table[1]"),
        ({"table": {"k": 1}}, "table[k]"),
        ({"table": {"k": [1, "2"]}}, "table[k][1]"),
        ({"maybe": "x"}, "maybe"),
        ({"maybe": False}, "maybe"),
        ({"more": 1}, "more"),
    ],
)
def test_what_is_wrong_is_named_by_its_path(change: dict[str, Any], path: str) -> None:
    error = refusal(structure, {"count": 1} | change, Whole)
    assert error.field == path
    assert str(error).startswith(f"{path}: got ")


@pytest.mark.parametrize("data", [None, 5, "x", [], [("count", 1)], {1: 2}])
def test_what_is_no_table_is_refused(data: Any) -> None:  # noqa: ANN401
    with pytest.raises(BadInputError):
        structure(data, Whole)


def test_a_missing_field_says_so() -> None:
    with pytest.raises(BadInputError, match=r"^count: got no value; allowed: .*required$"):
        structure({}, Whole)


def test_the_value_is_not_changed() -> None:
    data = {"count": 1, "table": {"k": [1]}}
    structure(data, Whole)
    assert data == {"count": 1, "table": {"k": [1]}}


def test_all_errors_are_reported_at_once() -> None:
    data = {
        "count": "x",
        "flagg": True,
        "part": {"size": 11, "name": 1},
        "parts": [{"size": -1}, {"size": 1}, {"name": "c"}, 5],
        "pair": [1.5, 2],
        "table": {"a": [1], "b": ["x", 2, "y"]},
    }
    problems = refusal(structure, data, Whole).problems
    assert [one.field for one in problems] == [
        "count",
        "part.name",
        "part.size",
        "parts[0].size",
        "parts[2].size",
        "parts[3]",
        "pair[0]",
        "pair[1]",
        "table[b][0]",
        "table[b][2]",
        "flagg",
    ]
    assert problems[-1].suggestion == "flag"


def test_all_validators_of_a_class_are_asked() -> None:
    @frozen
    class Two:
        a: int = field(validator=within(0, 1))
        b: int = field(default=0, validator=within(0, 1))

    assert [one.field for one in refusal(structure, {"a": 2, "b": 3}, Two).problems] == ["a", "b"]


def test_a_long_list_is_examined_up_to_a_number_of_errors() -> None:
    error = refusal(structure, {"count": 1, "parts": [0] * 10_000}, Whole)
    assert len(error.problems) == MAX_PROBLEMS
    error = refusal(structure, dict.fromkeys(map(str, range(10_000)), 1), Whole)
    assert len(error.problems) == MAX_PROBLEMS + 1


def test_a_key_of_another_table_is_suggested() -> None:
    assert refusal(structure, {"count": 1, "size": 2}, Whole).suggestion == "part.size"
    assert refusal(structure, {"count": 1, "part": {"size": 1, "maybe": 2}}, Whole).suggestion == (
        "maybe"
    )


@frozen
class Route:
    """A field whose name Python reserves."""

    source: str = field(default="all", metadata={KEY: "from"})


def test_a_field_may_have_another_name_in_files() -> None:
    assert structure({"from": "a"}, Route) == structure({"source": "a"}, Route) == Route("a")


@pytest.mark.parametrize(
    ("data", "line"),
    [
        ({"from": 1}, "from: got 1; "),
        ({"source": 1}, "source: got 1; "),
        ({"from": "a", "source": "a"}, "source: got 'a'; allowed: nothing if from is given"),
        ({"form": "a"}, "form: got an unknown key; allowed: one of from; did you mean from?"),
    ],
)
def test_errors_have_the_name_that_is_in_the_file(data: dict[str, Any], line: str) -> None:
    assert str(refusal(structure, data, Route)).startswith(line)


def test_without_removes_fields() -> None:
    data = {"a": [{"b": 1, "c": 2}], "d": 3}
    assert without(data, ["a[0].b", "d"]) == {"a": [{"c": 2}]}
    assert data == {"a": [{"b": 1, "c": 2}], "d": 3}
    with pytest.raises(LookupError):
        without(data, ["a[1].b"])


class Cell(NamedTuple):
    """A tuple with names."""

    column: int
    lane: int


@frozen
class Grid:
    """Values of all kinds that the JSON form can contain."""

    cells: frozenset[Cell]
    parts: tuple[Part, ...]
    size: float
    name: str | None = None


def test_the_json_form_consists_of_maps_and_sorted_lists() -> None:
    grid = Grid(frozenset({Cell(2, 0), Cell(1, 1)}), (Part(1.0, "a"),), np.float64(0.5))
    cells, parts = [[1, 1], [2, 0]], [{"size": 1.0, "name": "a"}]
    form = {"cells": cells, "parts": parts, "size": 0.5}
    assert json_form(grid) == form | {"name": None}
    assert json_form(grid, lambda _, value: value is not None) == form
    assert json_form([*grid.parts, {2, 1}]) == [*parts, [1, 2]]
    assert json.loads(json.dumps(json_form(grid))) == json_form(grid)
