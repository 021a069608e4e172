"""Open queries are bounded in total and per sender."""

from __future__ import annotations

from laneweave.protocol.runtime.open_queries import (
    MAX_OPEN_PER_SENDER,
    MAX_OPEN_QUERIES,
    OpenQueries,
)


def test_a_query_is_taken_once() -> None:
    queries: OpenQueries[str] = OpenQueries()
    first, second = queries.add("a", "x"), queries.add("a", "y")
    assert first is not None
    assert second is not None
    assert [queries.pop(second), queries.pop(second), queries.pop(first)] == ["y", None, "x"]
    assert not queries._by_sender


def test_a_sender_with_too_many_does_not_exclude_another() -> None:
    queries: OpenQueries[int] = OpenQueries()
    tokens = [queries.add("flood", number) for number in range(MAX_OPEN_PER_SENDER + 1)]
    assert tokens[-1] is None
    assert queries.add("quiet", 0) is not None
    assert queries.pop(tokens[0] or 0) == 0
    assert queries.add("flood", 1) is not None


def test_the_total_is_bounded() -> None:
    queries: OpenQueries[int] = OpenQueries()
    tokens = [queries.add(str(number % 100), number) for number in range(MAX_OPEN_QUERIES + 1)]
    assert tokens[-1] is None
    assert None not in tokens[:-1]
