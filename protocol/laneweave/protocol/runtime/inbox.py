"""Input queue of a node, with fair scheduling of queries."""

from __future__ import annotations

import contextlib
import queue
import time
from collections import deque
from collections.abc import Iterator

from laneweave.protocol.runtime.metrics import SnapshotRequest
from laneweave.protocol.runtime.node import Computed, Stopping
from laneweave.protocol.runtime.transport import Delivery, Query

MAX_QUERY_WAIT_S = 0.02
"""Longest time a query waits while other work is queued, unless `QUERY_SHARE` requires more."""
QUERY_SHARE = 0.1
"""Maximum fraction of time spent on queries while other work is queued."""

Item = Delivery | Computed | SnapshotRequest | Stopping
"""Input of a node."""


class Inbox:
    """Input queue of a node.

    Queries yield to other work for at most `MAX_QUERY_WAIT_S`. `QUERY_SHARE` keeps a flood of
    queries from blocking a leader.
    """

    def __init__(self) -> None:
        """Create an empty queue."""
        self._items: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self._queries: deque[Query] = deque()
        self._next_query_s = 0.0
        """Time from which a query is taken even if other work is queued."""

    def put(self, item: Item) -> None:
        """Add an input; safe in any thread, callback or signal handler (`put` is reentrant)."""
        if isinstance(item, Query):
            self._queries.append(item)
            self._items.put(None)  # wake up `take`
        else:
            self._items.put(item)

    def take(self, timeout_s: float) -> Iterator[Item]:
        """Wait for an input until a timeout; yield at most one query and one other input."""
        with contextlib.suppress(queue.Empty):
            item = self._items.get(timeout=0.0 if self._queries else timeout_s)
            if item is not None:
                yield item
        now_s = time.monotonic()
        if self._queries and (self._items.empty() or now_s > self._next_query_s):
            yield self._queries.popleft()
            took_s = time.monotonic() - now_s
            self._next_query_s = now_s + max(MAX_QUERY_WAIT_S, took_s / QUERY_SHARE)
