"""A core wrapper between a node and its core that can lose, delay and duplicate messages.

`message_faults.FaultyCore` injects faults, `radio.radio_core.RadioCore` simulates a radio channel.
Only messages are affected: liveliness tokens, link events and queries are not.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from itertools import count

from laneweave.protocol.runtime.metrics import MetricsSnapshot
from laneweave.protocol.runtime.node import (
    Arrived,
    Core,
    Effect,
    Event,
    Wakeup,
    core_metrics,
)

MAX_HELD = 10_000
"""Maximum number of delayed messages; further ones are dropped."""


class DelayingCore(ABC):
    """A `Core` that decides which messages another core receives, and when."""

    def __init__(self, core: Core) -> None:
        """Wrap a core."""
        self.core = core
        self._held: list[tuple[float, int, Arrived]] = []
        self._order = count()

    @abstractmethod
    def _copies(self, arrived: Arrived, now_s: float) -> Iterable[tuple[float, Arrived]]:
        """Return the delay [s] and the content of each copy of a message; empty: it is lost."""

    @abstractmethod
    def _on_overflow(self, arrived: Arrived) -> None:
        """Count a message that is lost because too many are delayed."""

    def _passed(self, effect: Effect) -> Effect:
        """Return an effect of the core as the node receives it."""
        return effect

    @property
    def metrics(self) -> Iterable[MetricsSnapshot]:
        """Metrics of the wrapped core."""
        return core_metrics(self.core)

    @property
    def wakeup_s(self) -> float | None:
        """Time of the next delayed message or of the core's wakeup, whichever is earlier."""
        wakeup_s = self.core.wakeup_s
        if not self._held:
            return wakeup_s
        return self._held[0][0] if wakeup_s is None else min(wakeup_s, self._held[0][0])

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Handle an event; see `Core`."""
        match event:
            case Arrived():
                effects: Iterable[Effect] = self._on_arrived(event, now_s)
            case Wakeup():
                effects = self._on_wakeup(event, now_s)
            case _:
                effects = self.core.handle(event, now_s)
        for effect in effects:
            yield self._passed(effect)

    def _on_arrived(self, arrived: Arrived, now_s: float) -> Iterator[Effect]:
        for delay_s, copy in self._copies(arrived, now_s):
            if delay_s <= 0.0:
                yield from self.core.handle(copy, now_s)
            elif len(self._held) < MAX_HELD:
                heapq.heappush(self._held, (now_s + delay_s, next(self._order), copy))
            else:
                self._on_overflow(copy)

    def _on_wakeup(self, wakeup: Wakeup, now_s: float) -> Iterator[Effect]:
        while self._held and self._held[0][0] <= now_s:
            yield from self.core.handle(heapq.heappop(self._held)[2], now_s)
        wakeup_s = self.core.wakeup_s
        if wakeup_s is not None and wakeup_s <= now_s:
            yield from self.core.handle(wakeup, now_s)
