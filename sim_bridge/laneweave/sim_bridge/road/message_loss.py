"""Estimate of whether messages between the bridge and the agents are lost.

An agent answers every SENSE, also a repeated one. If agents answer fewer than they were sent,
messages are lost. An agent that answers no SENSE at all, because it hangs, is not evidence of loss.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from attrs import define, field

from laneweave.protocol.wire.messages import Name

LOSSY_SHARE = 0.9
"""Share of answered SENSE messages below which messages count as lost."""
_MEMORY = 0.95
"""Multiplier of the numbers of earlier SENSE messages and answers at each tick."""


@define
class MessageLoss:
    """Numbers of SENSE messages and answers, from which loss is estimated."""

    asked: Counter[Name] = field(factory=Counter)
    """SENSE messages to each awaited agent since the current tick started."""
    received: Counter[Name] = field(factory=Counter)
    """Answers to any tick from each agent since the current tick started."""
    _names_last: frozenset[Name] = frozenset()
    """Agents that were asked in the last tick: some get no SENSE in this one, but answer it now."""
    _asked_last: int = 0
    """SENSE messages in the last tick to agents that answered any."""
    _asked_before: float = 0.0
    """Weighted number of such messages in the ticks before: their answers have arrived or are
    lost."""
    _received_before: float = 0.0
    """Weighted number of answers until the last tick."""

    @property
    def lossy(self) -> bool:
        """Whether messages are lost: agents answer fewer SENSE messages than they are sent."""
        return self._received_before < LOSSY_SHARE * self._asked_before

    def on_sent(self, names: Iterable[Name]) -> None:
        """Register that a SENSE is being sent to agents."""
        self.asked.update(names)

    def start_tick(self) -> None:
        """Compare the answers with the SENSE messages of one tick before: some arrive late."""
        names = self._names_last | self.asked.keys()
        received = sum(count for name, count in self.received.items() if name in names)
        self._asked_before = _MEMORY * self._asked_before + self._asked_last
        self._received_before = _MEMORY * self._received_before + received
        self._names_last = frozenset(self.asked)
        self._asked_last = sum(self.asked[name] for name in self.received)
        self.asked.clear()
        self.received.clear()
