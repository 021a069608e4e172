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


class Stopwatch:
    """The time that a plan takes, without that for loading code."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        """Start.

        Args:
            clock: returns the time for deadlines [s].
        """
        self._clock = clock
        self._began_s, self._began_wall_s = clock(), time.monotonic()

    @property
    def time_s(self) -> float:
        """Time so far, by the clock of deadlines [s]."""
        return self._clock() - self._began_s

    @property
    def wall_s(self) -> float:
        """Real time so far [s]."""
        return time.monotonic() - self._began_wall_s

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Leave out the time of a block; blocks must not be nested."""
        before_s, before_wall_s = self._clock(), time.monotonic()
        try:
            yield
        finally:
            self._began_s += self._clock() - before_s
            self._began_wall_s += time.monotonic() - before_wall_s


class Budget:
    """A deadline and limits on the nodes and on the memory of a search."""

    def __init__(
        self,
        *,
        deadline_s: float | None = None,
        max_nodes: int | None = None,
        max_memory_mb: float = DEFAULT_MEMORY_MB,
        compiled_only: bool = False,
        stopwatch: Stopwatch | None = None,
    ) -> None:
        """Set the limits.

        Args:
            deadline_s: time on the stopwatch at which the search must end [s].
            max_nodes: limit on nodes.
            max_memory_mb: limit on the arrays of a search.
            compiled_only: whether code that is not compiled yet must not be used.
            stopwatch: stopwatch of the plan; None: one is started.
        """
        self._deadline_s = deadline_s
        self._max_nodes = max_nodes
        self.stopwatch = stopwatch or Stopwatch()
        self.max_bytes = 1e6 * max_memory_mb
        self.compiled_only = compiled_only
        self.nodes = 0

    def check_time(self, ahead_s: float = 0.0) -> None:
        """Raise `BudgetSpentError` if the deadline has passed or is less than `ahead_s` away."""
        if self._deadline_s is None:
            return
        release_s = self.nodes * _RELEASE_S_PER_NODE
        if self.stopwatch.time_s + ahead_s + release_s >= self._deadline_s:
            raise BudgetSpentError

    @property
    def left_s(self) -> float:
        """Return the time until the deadline; infinite: there is none."""
        return math.inf if self._deadline_s is None else self._deadline_s - self.stopwatch.time_s

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
