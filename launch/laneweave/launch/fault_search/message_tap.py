"""A tap on a process: what its core says goes by a listener before the network has it."""

from __future__ import annotations

from collections.abc import Callable

from laneweave.protocol.runtime.node import Core, Effect, Event, Send

Listener = Callable[[str, Send], None]
"""Is told who says something, and what."""


class Tap:
    """A core that passes on what it is handed, and tells a listener of all that it sends."""

    def __init__(self, core: Core, name: str, listener: Listener) -> None:
        """Put a tap on the core of a process of this name."""
        self.core = core
        self._name = name
        self._listener = listener

    @property
    def wakeup_s(self) -> float | None:
        """When the core wants to be woken."""
        return self.core.wakeup_s

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Let the core handle an event."""
        effects = list(self.core.handle(event, now_s))
        for effect in effects:
            if type(effect) is Send:
                self._listener(self._name, effect)
        return effects
