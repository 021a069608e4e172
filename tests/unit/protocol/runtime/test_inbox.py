"""What waits for a node: the questions of others do not keep it from its own affairs."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator

import pytest

from laneweave.protocol.runtime.inbox import (
    MAX_OPEN_PER_SENDER,
    MAX_OPEN_QUERIES,
    MAX_QUERY_WAIT_S,
    MAX_WAITING,
    OVERFLOW_S,
    QUERY_SHARE,
    Inbox,
    OpenQueries,
)
from laneweave.protocol.runtime.node import Stopping
from laneweave.protocol.runtime.transport import Overflow, Query, Received

MESSAGE = Received("k", b"")
QUESTION = Query("k", b"", 1)


def test_what_came_first_is_taken_first_and_questions_last() -> None:
    inbox = Inbox()
    for item in (QUESTION, MESSAGE, Stopping()):
        inbox.put(item)
    taken = list(inbox.take(0.0))
    while len(taken) < 3:
        taken += inbox.take(0.0)
    assert taken in ([MESSAGE, Stopping(), QUESTION], [QUESTION, MESSAGE, Stopping()])
    assert list(inbox.take(0.0)) == []


def test_a_question_is_taken_at_once_when_there_is_nothing_else() -> None:
    inbox = Inbox()
    for _ in range(3):
        inbox.put(QUESTION)
    taken = [item for _ in range(6) for item in inbox.take(0.0)]
    assert taken == 3 * [QUESTION]


def test_a_question_is_taken_at_times_whatever_else_there_is() -> None:
    inbox = Inbox()
    inbox.put(QUESTION)
    begun_s = time.monotonic()
    taken: list[object] = []
    while QUESTION not in taken:
        inbox.put(MESSAGE)
        inbox.put(MESSAGE)
        taken += inbox.take(0.0)
        assert time.monotonic() < begun_s + 20.0


def test_questions_that_take_long_get_a_small_part_of_the_time() -> None:
    inbox = Inbox()
    for _ in range(4):
        inbox.put(QUESTION)
    long_s = 0.01
    begun_s: list[float] = []
    ended_s: list[float] = []
    while len(begun_s) < 4:
        inbox.put(MESSAGE)
        inbox.put(MESSAGE)
        for item in inbox.take(0.0):
            if item == QUESTION:
                begun_s.append(time.monotonic())
                time.sleep(long_s)
                ended_s.append(time.monotonic())
    assert long_s / QUERY_SHARE > MAX_QUERY_WAIT_S
    for begin_s, end_s, next_s in zip(begun_s, ended_s, begun_s[1:], strict=False):
        assert next_s - begin_s >= (end_s - begin_s) / QUERY_SHARE


def test_senders_of_queries_are_served_in_turn() -> None:
    inbox = Inbox()
    flood = [Query("k", b"", n, sender=f"alive/client/{n}/flood") for n in range(50)]
    quiet = Query("k", b"", 100, sender="alive/client/1/quiet")
    for query in (*flood, quiet):
        inbox.put(query)
    taken = [item for _ in range(110) for item in inbox.take(0.0)]
    assert taken == [flood[0], quiet, *flood[1:]]


def test_a_flood_on_one_key_delays_other_keys_only_briefly() -> None:
    inbox, other = Inbox(), Received("other", b"")
    for _ in range(50 * MAX_WAITING):
        inbox.put(MESSAGE)
    inbox.put(other)
    taken = [item for _ in range(MAX_WAITING + 1) for item in inbox.take(0.0)]
    assert [item for item in taken if isinstance(item, Received)] == MAX_WAITING * [MESSAGE] + [
        other
    ]


def test_a_sender_that_varies_other_parts_of_its_keys_is_limited_too() -> None:
    inbox = Inbox()
    for number in range(50 * MAX_WAITING):
        inbox.put(Received(f"state/{number}/v0001", b""))
    taken = [item for _ in range(50 * MAX_WAITING) for item in inbox.take(0.0)]
    assert sum(isinstance(item, Received) for item in taken) == MAX_WAITING


def test_messages_are_taken_again_when_those_before_have_been_handled() -> None:
    inbox = Inbox()
    for _ in range(3):
        for _ in range(MAX_WAITING):
            inbox.put(MESSAGE)
        taken = [item for _ in range(MAX_WAITING) for item in inbox.take(0.0)]
        assert taken == MAX_WAITING * [MESSAGE]
    assert not inbox._waiting


def test_the_keys_of_dropped_messages_are_told_at_intervals() -> None:
    inbox = Inbox()
    told = 0
    until_s = time.monotonic() + 3.5 * OVERFLOW_S
    while time.monotonic() < until_s:
        for _ in range(2 * MAX_WAITING):
            inbox.put(MESSAGE)
        told += sum(item == Overflow("k") for item in inbox.take(0.0))
    assert 1 <= told <= 4


@pytest.fixture
def _frequent_thread_switches() -> Iterator[None]:
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval_s)


@pytest.mark.usefixtures("_frequent_thread_switches")
def test_inputs_of_many_threads_arrive_while_others_are_taken() -> None:
    threads, each = 3, 1000
    inbox = Inbox()
    taken: list[object] = []

    def put(thread: int) -> None:
        for number in range(each):
            inbox.put(Query("k", b"", number, sender=f"alive/client/{thread}/c{number}"))
            inbox.put(Received(f"state/1/v{number % 5}", b""))

    putting = [threading.Thread(target=put, args=(thread,)) for thread in range(threads)]
    for thread in putting:
        thread.start()
    begun_s = time.monotonic()
    while any(thread.is_alive() for thread in putting) or len(inbox._queries) > 0:
        taken += inbox.take(0.0)
        assert time.monotonic() < begun_s + 60.0
    queries = [item for item in taken if isinstance(item, Query)]
    assert len({item.sender for item in queries}) == len(queries) == threads * each


# --- open queries -----------------------------------------------------------------------------


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
