"""Open queries of a server: bounded in total and per sender."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Generic, TypeVar

MAX_OPEN_QUERIES = 4096
"""Maximum number of open queries; further ones are declined."""
MAX_OPEN_PER_SENDER = 1024
"""Maximum number of open queries of one sender; further ones are declined."""

T = TypeVar("T")


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
