"""Virtual time: one event queue, one seeded generator, and what a whole simulation shares."""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from itertools import count
from typing import Any

from laneweave.protocol.runtime.node import Computed, Started, Stopping, Wakeup
from laneweave.protocol.runtime.transport import Delivery
from laneweave.protocol.transports.simulated.conditions import Conditions

Item = Delivery | Computed | Started | Stopping | Wakeup
"""What a node is handed."""
Trace = Callable[[float, str, Item], None]
"""Is told the virtual time, a node's name and what it is handed, in order."""
Action = Callable[..., None]


class Simulation:
    """The virtual clock, and the queue of all that is still to happen."""

    def __init__(self, seed: int, conditions: Conditions | None = None) -> None:
        """Begin at time 0 with an empty queue."""
        self.now_s = 0.0
        self.conditions = conditions or Conditions()
        """May be replaced at any time; what is under way keeps its fate."""
        self.trace: Trace | None = None
        """Is told all that nodes are handed; None costs nothing."""
        self.dropped = 0
        """Messages that did not reach a receiver, counted for each receiver."""
        self.delivered = 0
        """Deliveries that nodes were handed."""
        self.random = random.Random(seed)  # noqa: S311 (simulation, not secrets)
        """The one source of chance."""
        self.queue: list[tuple[float, int, Action, tuple[Any, ...]]] = []
        """Time, order among equal times, action and its arguments."""
        self.order = count()

    def at(self, time_s: float, action: Action, *arguments: object) -> None:
        """Do something at a virtual time, e.g. inject a fault; what is past is done now."""
        at_s = max(time_s, self.now_s)
        heapq.heappush(self.queue, (at_s, next(self.order), action, arguments))

    def step(self) -> bool:
        """Process the next event; false when there is none."""
        if not self.queue:
            return False
        self.now_s, _, action, arguments = heapq.heappop(self.queue)
        action(*arguments)
        return True

    def run(self, until_s: float, stop: Callable[[], bool] | None = None) -> None:
        """Process events up to a virtual time, or until `stop` says so."""
        queue = self.queue
        while queue and queue[0][0] <= until_s:
            if stop is not None and stop():
                return
            self.now_s, _, action, arguments = heapq.heappop(queue)
            action(*arguments)
        if stop is None or not stop():
            self.now_s = max(self.now_s, until_s)

    def delay_s(self) -> float:
        """Draw how long a message is under way."""
        return self.conditions.delay_s + self.conditions.jitter_s * self.random.random()
