"""Limits on a search: a deadline, a maximum number of nodes, and memory."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from typing import Final

Clock = Callable[[], float]

DEFAULT_MEMORY_MB: Final = 300.0

_RELEASE_S_PER_NODE = 3e-6
"""Time to free a node's memory after the search."""


class BudgetSpentError(Exception):
    """The deadline has passed or the node limit is reached; results so far stay valid."""


class Budget:
    """A deadline and limits on the nodes and on the memory of a search."""

    def __init__(
        self,
        *,
        deadline: float | None = None,
        max_nodes: int | None = None,
        max_memory_mb: float = DEFAULT_MEMORY_MB,
        compiled_only: bool = False,
        clock: Clock = time.monotonic,
    ) -> None:
        """Set the limits.

        Args:
            deadline: a reading of `clock`.
            max_nodes: limit on nodes.
            max_memory_mb: limit on the arrays of a search.
            compiled_only: whether code that is not compiled yet must not be used.
            clock: returns the time [s].
        """
        self._deadline = deadline
        self._max_nodes = max_nodes
        self._clock = clock
        self.max_bytes = 1e6 * max_memory_mb
        self.compiled_only = compiled_only
        self.nodes = 0
        self.paused_s = 0.0
        """Time that did not count, by the clock of the deadline."""
        self.paused_wall_s = 0.0
        """The same by a clock on the wall, for the time that a response reports."""

    def check_time(self, ahead_s: float = 0.0) -> None:
        """Raise `BudgetSpentError` if the deadline has passed or is less than `ahead_s` away."""
        if self._deadline is None:
            return
        if self._clock() + ahead_s + self.nodes * _RELEASE_S_PER_NODE >= self._deadline:
            raise BudgetSpentError

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Let the time of a block not count: loading code is not part of planning."""
        began = self._clock(), time.monotonic()
        try:
            yield
        finally:
            paused_s = self._clock() - began[0]
            self.paused_s += paused_s
            self.paused_wall_s += time.monotonic() - began[1]
            if self._deadline is not None:
                self._deadline += paused_s

    @property
    def left_s(self) -> float:
        """Return the time until the deadline; infinite: there is none."""
        return math.inf if self._deadline is None else self._deadline - self._clock()

    def take_node(self) -> None:
        """Count one node, or raise `BudgetSpentError` if none is left."""
        self.check_time()
        if self._max_nodes is not None and self.nodes >= self._max_nodes:
            raise BudgetSpentError
        self.nodes += 1

    def take_nodes(self, nodes: int) -> None:
        """Count examined nodes; raise `BudgetSpentError` at the deadline or the limit."""
        self.nodes += nodes
        self.check_time()
        if self._max_nodes is not None and self.nodes >= self._max_nodes:
            raise BudgetSpentError

    def nodes_left(self, s_per_node: float) -> int:
        """Return how many more nodes fit within the deadline and the node limit."""
        left = math.inf
        if self._max_nodes is not None:
            left = self._max_nodes - self.nodes
        left = min(left, self.left_s / max(s_per_node, 1e-6))
        return max(0, int(min(left, sys.maxsize)))
