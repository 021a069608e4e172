"""What the kinds of fault events share: the network, the random generator, the end of faults."""

from __future__ import annotations

import random
from collections.abc import Callable

from attrs import define, field

from laneweave.protocol.transports.simulated.network import SimulatedNetwork

ROAD = "road"
"""Name of the road's node."""
SHORT_S = (0.05, 2.5)
"""Range of times for which a process is dead, paused or disconnected."""
LONG_S = (0.3, 4.0)
"""Range of durations of network faults."""


@define(eq=False)
class FaultContext:
    """Network of a run, generator of the current event, and whether all faults have ended."""

    network: SimulatedNetwork
    log: Callable[[str], None]
    rng: random.Random = field(factory=random.Random)
    """Generator of the current event."""
    healed: bool = False

    def later(self, span_s: tuple[float, float], action: Callable[[], None], what: str) -> None:
        """Schedule the end of a fault; skipped if all faults have already ended."""
        time_s = self.network.now_s + self.rng.uniform(*span_s)
        self.network.at(time_s, self._undo, action, what)

    def _undo(self, action: Callable[[], None], what: str) -> None:
        if not self.healed:
            self.log(f"--- {what}")
            action()

    def new_rng(self) -> random.Random:
        """Return a generator for what happens later because of the current event."""
        return random.Random(self.rng.randrange(2**32))  # noqa: S311 (simulation, no secrets)
