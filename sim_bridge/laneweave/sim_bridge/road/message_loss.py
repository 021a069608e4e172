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
_LATE_TICKS = 10
"""Number of ticks for which answers to a SENSE may arrive."""
_MEMORY = 0.95
"""Multiplier of the numbers of earlier SENSE messages and answers at each tick."""


@define
class MessageLoss:
    """Numbers of SENSE messages and answers, from which loss is estimated."""

    asked: Counter[Name] = field(factory=Counter)
    """SENSE messages to each awaited agent since the current tick started."""
    received: Counter[Name] = field(factory=Counter)
    """Answers to any tick from each agent since the current tick started."""
    _tick: int = 0
    _asked_in: dict[Name, int] = field(factory=dict)
    """Tick in which each agent was asked last, for `_LATE_TICKS`."""
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
        # Vehicles that hold undisturbed get a SENSE now and then, and may answer it ticks later.
        oldest = self._tick - _LATE_TICKS
        self._asked_in = {name: tick for name, tick in self._asked_in.items() if tick > oldest}
        self._asked_in |= dict.fromkeys(self.asked, self._tick)
        self._tick += 1
        received = sum(self.received[name] for name in self.received.keys() & self._asked_in.keys())
        self._asked_before = _MEMORY * self._asked_before + self._asked_last
        self._received_before = _MEMORY * self._received_before + received
        self._asked_last = sum(self.asked[name] for name in self.received)
        self.asked.clear()
        self.received.clear()
