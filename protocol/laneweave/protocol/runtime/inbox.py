"""Input queue of a node, with fair scheduling, and bounds on what waits or is not answered."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from typing import Generic, TypeVar

from laneweave.protocol.runtime.metrics import SnapshotRequest
from laneweave.protocol.runtime.node import Computed, Stopping
from laneweave.protocol.runtime.round_robin import RoundRobin
from laneweave.protocol.runtime.transport import (
    Delivery,
    Overflow,
    Query,
    Received,
    sender_name,
)

MAX_QUERY_WAIT_S = 0.02
"""Longest time a query waits while other work is queued, unless `QUERY_SHARE` requires more."""
MAX_WAITING = 100
"""Maximum number of waiting messages of one sender or receiver; further ones are dropped.

A flood from one sender (`sender_name`) then delays messages of others only briefly. Every message
may be lost, and a correct sender has at most a few messages under way."""
OVERFLOW_S = 0.1
"""Interval at which the node is notified of dropped messages."""
QUERY_SHARE = 0.1
"""Maximum fraction of time spent on queries while other work is queued."""

MAX_OPEN_QUERIES = 4096
"""Maximum number of open queries; further ones are declined."""
MAX_OPEN_PER_SENDER = 1024
"""Maximum number of open queries of one sender; further ones are declined."""

T = TypeVar("T")
Item = Delivery | Computed | SnapshotRequest | Stopping
"""Input of a node."""


class Inbox:
    """Input queue of a node.

    The first query yields to other work for at most `MAX_QUERY_WAIT_S`. `QUERY_SHARE` keeps a flood
    of queries from blocking a leader, and `MAX_WAITING` a flood of messages. Queries of several
    senders are taken round robin; those without a known sender count as of one sender.
    """

    def __init__(self) -> None:
        """Create an empty queue."""
        self._items: queue.SimpleQueue[Item | None] = queue.SimpleQueue()
        self._queries: RoundRobin[Query] = RoundRobin()
        self._waiting: Counter[str] = Counter()
        """Number of waiting messages by sender."""
        self._lock = threading.Lock()
        """Guards `_queries`, `_waiting` and `_overflowed`; never needed in a signal handler."""
        self._overflowed: dict[str, None] = {}
        """Keys of messages dropped since the last `Overflow`."""
        self._next_overflow_s = 0.0
        """Earliest time of the next `Overflow`."""
        self._next_query_s = 0.0
        """Time from which a query is taken even if other work is queued."""

    def put(self, item: Item) -> None:
        """Add an input; safe in any thread, callback or signal handler (`put` is reentrant)."""
        if isinstance(item, Query):
            with self._lock:
                self._queries.append(sender_name(item.sender), item)
            self._items.put(None)  # wake up `take`
        elif not isinstance(item, Received) or self._admit(item.key):
            self._items.put(item)

    def take(self, timeout_s: float) -> Iterator[Item]:
        """Wait for an input until a timeout; yield at most one query and one other input.

        The keys of dropped messages come in addition.
        """
        with contextlib.suppress(queue.Empty):
            item = self._items.get(timeout=0.0 if self._queries else timeout_s)
            if isinstance(item, Received):
                self._release(item.key)
            if item is not None:
                yield item
        now_s = time.monotonic()
        if self._overflowed and now_s >= self._next_overflow_s:
            self._next_overflow_s = now_s + OVERFLOW_S
            with self._lock:
                overflowed, self._overflowed = self._overflowed, {}
            yield from map(Overflow, overflowed)
        if self._queries and (self._items.empty() or now_s > self._next_query_s):
            with self._lock:
                query = self._queries.pop()
            yield query
            took_s = time.monotonic() - now_s
            self._next_query_s = now_s + max(MAX_QUERY_WAIT_S, took_s / QUERY_SHARE)

    def _admit(self, key: str) -> bool:
        """Count a message as waiting, or register it as dropped; return whether it may wait."""
        name = sender_name(key)
        with self._lock:
            if self._waiting[name] >= MAX_WAITING:
                self._overflowed[key] = None
                return False
            self._waiting[name] += 1
            return True

    def _release(self, key: str) -> None:
        name = sender_name(key)
        with self._lock:
            self._waiting[name] -= 1
            if not self._waiting[name]:
                del self._waiting[name]


class OpenQueries(Generic[T]):
    """Queries that have not been answered or declined yet, by token; safe in any thread."""

    def __init__(self) -> None:
        """Create an empty table."""
        self._queries: dict[int, tuple[str, T]] = {}
        """Sender and query by token."""
        self._by_sender: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._last_token = 0

    def add(self, sender: str, query: T) -> int | None:
        """Register a query and return its token; None if there are too many."""
        with self._lock:
            full = len(self._queries) >= MAX_OPEN_QUERIES
            if full or self._by_sender[sender] >= MAX_OPEN_PER_SENDER:
                return None
            self._last_token += 1
            self._queries[self._last_token] = sender, query
            self._by_sender[sender] += 1
            return self._last_token

    def pop(self, token: int) -> T | None:
        """Remove and return a query; None if the token is unknown."""
        with self._lock:
            sender, query = self._queries.pop(token, (None, None))
            if sender is not None:
                self._by_sender[sender] -= 1
                if not self._by_sender[sender]:
                    del self._by_sender[sender]
            return query
