"""A table of cases fails with the rows that fail; variants are marked."""

from __future__ import annotations

import inspect

import pytest

from support.tables import for_each
from support.variants import variants


def test_a_failure_names_its_rows() -> None:
    seen: list[tuple[int, str]] = []

    @for_each("number, word", [(1, "one"), (2, "two"), (3, "three"), (4, "four")])
    def odd(number: int, word: str, tmp: str) -> None:
        seen.append((number, tmp))
        assert number % 2, word

    assert [*inspect.signature(odd).parameters] == ["tmp"]
    with pytest.raises(AssertionError, match="two") as caught:
        odd(tmp="x")
    assert seen == [(number, "x") for number in (1, 2, 3, 4)]
    first_note, further = caught.value.__notes__
    assert "'two'" in first_note
    assert further.startswith("1 further rows")
    assert "'four'" in further


def test_that_an_error_is_not_raised_is_a_failure_too() -> None:
    @for_each("value", [{}, {"a": 1}])
    @for_each(("key",), [("a",)])
    def missing(value: dict[str, int], key: str) -> None:
        with pytest.raises(KeyError):
            value[key]

    with pytest.raises(pytest.fail.Exception) as caught:
        missing()
    assert any("'a': 1" in note for note in caught.value.__notes__)


def test_an_empty_table_is_refused() -> None:
    with pytest.raises(AssertionError, match="tests nothing"):
        for_each("value", [])


def test_variants_but_the_first_are_for_make_test_more() -> None:
    kept, *others = variants([1, 2, pytest.param(3, id="three")])
    assert kept == 1
    assert [(one.values, one.id) for one in others] == [((2,), None), ((3,), "three")]
    assert all([mark.name for mark in one.marks] == ["more"] for one in others)
