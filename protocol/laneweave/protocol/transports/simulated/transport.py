"""One node's side of the simulated network: the peer of `zenoh_transport.ZenohTransport`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from laneweave.protocol.runtime.transport import Answer
from laneweave.protocol.wire.topics import Quality

if TYPE_CHECKING:
    from laneweave.protocol.transports.simulated.network import SimulatedNetwork


class SimulatedTransport:
    """One node's view of the simulated network; made by `SimulatedNetwork.add`."""

    def __init__(self, network: SimulatedNetwork, name: str) -> None:
        """Attach a named node to a network."""
        self._network = network
        self.name = name
        self.subscriptions: dict[str, None] = {}
        self.watched: dict[str, None] = {}
        self.tokens: dict[str, None] = {}
        self.served: set[str] = set()
        self.closed = False

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        """Send to all subscribers, each with its own fate."""
        del quality
        if not self.closed:
            self._network.carry(self.name, key, payload)

    def subscribe(self, key_expression: str) -> None:
        """Subscribe."""
        self.subscriptions[key_expression] = None
        self._network.reroute(self.name, (key_expression,))

    def unsubscribe(self, key_expression: str) -> None:
        """Undo `subscribe`."""
        self.subscriptions.pop(key_expression, None)
        self._network.reroute(self.name, (key_expression,))

    def announce(self, key: str) -> None:
        """Show a token."""
        if key not in self.tokens and not self.closed:
            self.tokens[key] = None
            self._network.show_token(self.name, key)

    def withdraw(self, key: str) -> None:
        """Take a token back."""
        if key in self.tokens and not self.closed:
            del self.tokens[key]
            self._network.hide_token(self.name, key)

    def watch(self, key_expression: str) -> None:
        """Watch tokens once, beginning with those that are there."""
        if key_expression not in self.watched and not self.closed:
            self.watched[key_expression] = None
            self._network.show_all_tokens(self.name, key_expression)

    def serve(self, key: str) -> None:
        """Answer questions on a key."""
        self.served.add(key)

    def answer(self, token: int, payload: bytes, *, ok: bool, encoding: str = "") -> None:
        """Answer a question once."""
        if not self.closed:
            self._network.take_answer(self.name, token, Answer(payload, ok, encoding))

    def decline(self, token: int) -> None:
        """Leave a question to others."""
        if not self.closed:
            self._network.take_answer(self.name, token, None)

    def close(self) -> None:
        """Leave the network."""
        if not self.closed:
            self._network.remove(self.name)
