"""The seam to the network: one small interface, two peers behind it.

`zenoh_transport` implements it over Zenoh, `simulated_network` in virtual time. Both hand over
`Delivery` values through one callable, may lose, duplicate and reorder what they carry (the
simulated one does all of it on purpose), and pass the same contract tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from attrs import frozen

from laneweave.protocol.wire.topics import Quality


@frozen
class Received:
    """A payload that somebody published on a key."""

    key: str
    payload: bytes


@frozen
class TokenUp:
    """A liveliness token appeared: its process is there and connected."""

    key: str


@frozen
class TokenDown:
    """A liveliness token vanished: its process ended, fell silent, or *we* lost the network.

    In the last case a `LinkDown` comes with it, at the same time, before it or after it.
    """

    key: str


@frozen
class LinkUp:
    """The connection to the network came up."""


@frozen
class LinkDown:
    """The connection to the network is gone; what is published now is lost."""


@frozen
class Question:
    """A query on a key that this node answers; `token` goes back with the answer."""

    key: str
    payload: bytes
    token: int
    encoding: str = ""
    """MIME type of the payload; empty: not told."""


@frozen
class Answer:
    """What a question was answered."""

    payload: bytes
    ok: bool
    """False: an error reply."""
    encoding: str = ""


def learn(seen: dict[str, None], news: TokenUp | TokenDown) -> bool:
    """Note in the keys that are seen what became of a token; false when that is nothing new."""
    known = news.key in seen
    if isinstance(news, TokenUp):
        seen[news.key] = None
        return not known
    seen.pop(news.key, None)
    return known


Delivery = Received | TokenUp | TokenDown | LinkUp | LinkDown | Question
Deliver = Callable[[Delivery], None]


class Transport(Protocol):
    """What a node may ask of the network. No call blocks for long; none raises on a lost link."""

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        """Send a payload to all who subscribed to the key, this node included."""

    def subscribe(self, key_expression: str) -> None:
        """Deliver from now on what is published on matching keys (`*` is one part, `**` any)."""

    def unsubscribe(self, key_expression: str) -> None:
        """Undo `subscribe`; unknown expressions are ignored."""

    def announce(self, key: str) -> None:
        """Show a liveliness token on this key for as long as this node lives and is connected."""

    def withdraw(self, key: str) -> None:
        """Take a liveliness token back; unknown ones are ignored."""

    def watch(self, key_expression: str) -> None:
        """Deliver tokens that appear or vanish, beginning with those that are there.

        This node's own are among them. News of one key come by turns, first that it is there: what
        is known already is not delivered again. A token of its own that it shows only for a moment
        may come and go twice, for the network tells of it too, later. Several nodes may show a
        token on one key: it has vanished when the last of them has taken it back.
        """

    def serve(self, key: str) -> None:
        """Deliver questions that are asked on this key."""

    def answer(self, token: int, payload: bytes, *, ok: bool, encoding: str = "") -> None:
        """Answer a question once; unknown tokens are ignored."""

    def decline(self, token: int) -> None:
        """Leave a question to the others who serve its key; unknown tokens are ignored."""

    def close(self) -> None:
        """Leave the network. Idempotent; whatever is called after it does nothing."""
