"""What waits for a node, in the order in which it is taken."""

from __future__ import annotations

import contextlib
import queue
import time
from collections import deque
from collections.abc import Iterator

from laneweave.protocol.runtime.metrics import Look
from laneweave.protocol.runtime.node import Computed, Stopping
from laneweave.protocol.runtime.transport import Delivery, Question

QUESTION_WAITS_S = 0.02
"""A question is taken at least so often, however much else there is to do,"""
QUESTION_SHARE = 0.1
"""unless questions have taken a larger part of the time than this."""

Item = Delivery | Computed | Look | Stopping
"""What a process has to do next."""


class Inbox:
    """What waits for a node.

    Questions of others wait until there is nothing else to do, or long enough: a flood of them must
    not keep a leader from leading. `put` may be called from callbacks and signal handlers:
    `SimpleQueue.put` is reentrant.
    """

    def __init__(self) -> None:
        """Begin with nothing."""
        self._items: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self._questions: deque[Question] = deque()
        self._next_question_s = 0.0
        """When the next question is taken, however much else there is to do."""

    def put(self, item: Item) -> None:
        """Add something; may be called from any thread, callback or signal handler."""
        if isinstance(item, Question):
            self._questions.append(item)
            self._items.put(None)  # wakes who waits
        else:
            self._items.put(item)

    def take(self, timeout_s: float) -> Iterator[Item]:
        """Yield what is next, after at most this time: nothing, an item, an item and a question."""
        with contextlib.suppress(queue.Empty):
            item = self._items.get(timeout=0.0 if self._questions else timeout_s)
            if item is not None:
                yield item
        now_s = time.monotonic()
        if self._questions and (self._items.empty() or now_s > self._next_question_s):
            yield self._questions.popleft()
            took_s = time.monotonic() - now_s
            self._next_question_s = now_s + max(QUESTION_WAITS_S, took_s / QUESTION_SHARE)
