"""The interface to the network.

`transports.zenoh` implements it over Zenoh, `transports.simulated` in virtual time. Both pass
`Delivery` values to one callable, may lose, duplicate and reorder messages (the simulated one does
so on purpose), and pass the same contract tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from attrs import frozen

from laneweave.protocol.wire.topics import Quality


@frozen
class Received:
    """A payload published on a key."""

    key: str
    payload: bytes


@frozen
class TokenUp:
    """A liveliness token appeared: its process is connected."""

    key: str


@frozen
class TokenDown:
    """A liveliness token vanished: its process ended, fell silent, or this node lost the network.

    In the last case a `LinkDown` comes at the same time, before or after it.
    """

    key: str


@frozen
class LinkUp:
    """The connection to the network came up."""


@frozen
class LinkDown:
    """The connection to the network is lost; messages published now are lost."""


@frozen
class Query:
    """A query on a key that this node serves; the answer must carry its `token`."""

    key: str
    payload: bytes
    token: int
    encoding: str = ""
    """MIME type of the payload; empty: unknown."""


@frozen
class Answer:
    """Answer to a question."""

    payload: bytes
    ok: bool
    """False: an error reply."""
    encoding: str = ""


def update_tokens(seen: dict[str, None], news: TokenUp | TokenDown) -> bool:
    """Update the visible tokens; return False if the event repeats what is known."""
    known = news.key in seen
    if isinstance(news, TokenUp):
        seen[news.key] = None
        return not known
    seen.pop(news.key, None)
    return known


Delivery = Received | TokenUp | TokenDown | LinkUp | LinkDown | Query
Deliver = Callable[[Delivery], None]


class Transport(Protocol):
    """Network operations of a node. No call blocks for long; none raises on a lost link."""

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        """Send a payload to all subscribers of the key, this node included."""

    def subscribe(self, key_expression: str) -> None:
        """Deliver messages on matching keys from now on (`*` is one part, `**` any number)."""

    def unsubscribe(self, key_expression: str) -> None:
        """Undo `subscribe`; unknown expressions are ignored."""

    def announce(self, key: str) -> None:
        """Show a liveliness token on this key while this node is alive and connected."""

    def withdraw(self, key: str) -> None:
        """Withdraw a liveliness token; unknown ones are ignored."""

    def watch(self, key_expression: str) -> None:
        """Deliver tokens that appear or vanish, beginning with those that are there.

        This node's own tokens are included. For each key, appearances and disappearances alternate,
        beginning with an appearance; repeated reports are not delivered. A token of its own that it
        shows only briefly may appear and vanish twice, because the network reports it, too, later.
        Several nodes may show a token on one key: it vanishes when the last of them withdraws it.
        """

    def serve(self, key: str) -> None:
        """Deliver questions that are asked on this key."""

    def answer(self, token: int, payload: bytes, *, ok: bool, encoding: str = "") -> None:
        """Answer a question once; unknown tokens are ignored."""

    def decline(self, token: int) -> None:
        """Leave a question to the other servers of its key; unknown tokens are ignored."""

    def close(self) -> None:
        """Leave the network. Idempotent; all later calls do nothing."""
