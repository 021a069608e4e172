"""A `BadInputError` is one short, readable line, whatever the value is."""

from __future__ import annotations

from typing import Any

import pytest

from laneweave.protocol.errors import BadInputError


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
