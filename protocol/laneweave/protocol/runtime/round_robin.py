"""Fair queue: first in, first out for each sender, and the senders in turn."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class RoundRobin(Generic[T]):
    """Items of several senders, taken round robin: one item of each sender in turn.

    A sender with many items delays the first item of another one by at most one item per sender.
    """

    def __init__(self) -> None:
        """Create an empty queue."""
        self._queues: dict[str, deque[T]] = {}
        """Items of each sender, oldest first; the sender whose turn it is comes first."""
        self._count = 0

    def __len__(self) -> int:
        """Return the number of items; safe while another thread changes the queue."""
        return self._count

    def __iter__(self) -> Iterator[T]:
        """Yield all items, sender by sender."""
        for items in self._queues.values():
            yield from items

    def count(self, sender: str) -> int:
        """Return the number of items of a sender."""
        return len(self._queues.get(sender, ()))

    @property
    def largest_sender(self) -> str:
        """Sender with the most items.

        Raises:
            ValueError: the queue is empty.
        """
        return max(self._queues, key=self.count)

    def append(self, sender: str, item: T) -> None:
        """Add the newest item of a sender."""
        self._queues.setdefault(sender, deque()).append(item)
        self._count += 1

    def pop(self) -> T:
        """Remove and return the oldest item of the sender whose turn it is.

        Raises:
            StopIteration: the queue is empty.
        """
        sender = next(iter(self._queues))
        items = self._queues.pop(sender)
        item = items.popleft()
        self._count -= 1
        if items:
            self._queues[sender] = items  # now the last in turn
        return item

    def pop_newest(self, sender: str) -> T:
        """Remove and return the newest item of a sender.

        Raises:
            KeyError: the sender has no items.
        """
        item = self._queues[sender][-1]
        self.remove(sender, item)
        return item

    def remove(self, sender: str, item: T) -> None:
        """Remove an item of a sender, wherever it is in its queue.

        Raises:
            KeyError, ValueError: the sender has no such item.
        """
        items = self._queues[sender]
        items.remove(item)
        self._count -= 1
        if not items:
            del self._queues[sender]
