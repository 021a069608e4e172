"""Items of several senders are taken in turn, those of one sender in order."""

from __future__ import annotations

from collections import deque
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.runtime.round_robin import RoundRobin

ITEMS = st.lists(st.sampled_from("abc"), max_size=40)


def queue_of(senders: str | list[str]) -> RoundRobin[int]:
    queue: RoundRobin[int] = RoundRobin()
    for number, sender in enumerate(senders):
        queue.append(sender, number)
    return queue


def drain(queue: RoundRobin[int]) -> list[int]:
    return [queue.pop() for _ in range(len(queue))]


def test_senders_are_served_in_turn() -> None:
    assert drain(queue_of("aaaabbc")) == [0, 4, 6, 1, 5, 2, 3]


def test_a_sender_that_returns_is_the_last_in_turn() -> None:
    queue = queue_of("aab")
    assert [queue.pop(), queue.pop()] == [0, 2]
    queue.append("b", 7)
    assert drain(queue) == [1, 7]


@given(ITEMS)
def test_each_item_is_taken_once_and_those_of_a_sender_in_order(senders: list[str]) -> None:
    taken = drain(queue_of(senders))
    assert sorted(taken) == list(range(len(senders)))
    for sender in "abc":
        own = [number for number in taken if senders[number] == sender]
        assert own == sorted(own)


@given(ITEMS, st.integers(0, 50))
def test_a_sender_waits_for_at_most_one_item_of_each_other(senders: list[str], before: int) -> None:
    queue = queue_of(senders)
    for _ in range(min(before, len(queue))):
        queue.pop()
    queue.append("quiet", -1)
    assert drain(queue).index(-1) <= len({"a", "b", "c"} & set(senders))


def test_items_are_removed_from_anywhere() -> None:
    queue = queue_of("aaab")
    queue.remove("a", 1)
    assert queue.pop_newest("a") == 2
    assert (queue.count("a"), queue.count("b"), queue.count("c"), len(queue)) == (1, 1, 0, 2)
    assert queue.pop_newest("b") == 3
    assert list(queue) == drain(queue) == [0]
    with pytest.raises(ValueError, match="empty"):
        _ = queue.largest_sender


def test_the_largest_sender_has_the_most_items() -> None:
    assert queue_of("abbbcc").largest_sender == "b"


class ChangedMeanwhile(dict[str, deque[int]]):
    """A dictionary that another thread changes whenever it is iterated."""

    def values(self) -> Any:  # noqa: ANN401 (an iterator instead of a view)
        """Begin the iteration, then add a sender."""
        begun = iter(super().values())
        self["another"] = deque([0])
        return begun


def test_the_length_is_known_while_another_thread_adds_items() -> None:
    queue = queue_of("aab")
    queue._queues = ChangedMeanwhile(queue._queues)
    assert len(queue) == 3
