"""What waits for a node: the questions of others do not keep it from its own affairs."""

from __future__ import annotations

import time

from laneweave.protocol.runtime.inbox import MAX_QUERY_WAIT_S, QUERY_SHARE, Inbox
from laneweave.protocol.runtime.node import Stopping
from laneweave.protocol.runtime.transport import Query, Received

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
