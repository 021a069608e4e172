"""The interface to the network.

`transports.zenoh` implements it over Zenoh, `transports.simulated` in virtual time. Both pass
`Delivery` values to one callable, may lose, duplicate and reorder messages, and pass the same
contract tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from attrs import frozen

from laneweave.protocol.quick_frozen import quick_frozen
from laneweave.protocol.wire.topics import Quality


@quick_frozen
class Received:
    """A payload arrived on a key."""

    key: str
    payload: bytes


@frozen
class Overflow:
    """Messages of a key were dropped, since too many of the same sender waited for this node."""

    key: str


@frozen
class TokenUp:
    """A liveliness token appeared: its process is connected."""

    key: str


@frozen
class TokenDown:
    """A liveliness token vanished: its process exited or hangs, or this node lost its connection.

    In the last case `LinkDown` is delivered at the same time, before or after this event.
    """

    key: str


@frozen
class LinkUp:
    """The connection to the network is established."""


@frozen
class LinkDown:
    """The connection to the network is lost; messages published until `LinkUp` are lost too."""


@frozen
class Query:
    """A query on a key that this node serves; `token` identifies it in the answer."""

    key: str
    payload: bytes
    token: int
    encoding: str = ""
    """MIME type of the payload; empty: unknown."""
    sender: str = ""
    """Key of a liveliness token that the querying process has declared; empty: unknown."""


@frozen
class Answer:
    """Answer to a query."""

    payload: bytes
    ok: bool
    """False for an error reply."""
    encoding: str = ""


def update_tokens(tokens: dict[str, None], event: TokenUp | TokenDown) -> bool:
    """Apply a token event to the visible tokens; return whether they changed."""
    known = event.key in tokens
    if isinstance(event, TokenUp):
        tokens[event.key] = None
        return not known
    tokens.pop(event.key, None)
    return known


def sender_name(key: str) -> str:
    """Return the name of a sender: the last part of its key.

    Other parts, which a sender may choose, do not matter.
    """
    return key.rpartition("/")[2]


Delivery = Received | Overflow | TokenUp | TokenDown | LinkUp | LinkDown | Query
Deliver = Callable[[Delivery], None]


class Transport(Protocol):
    """Network operations of a node; none blocks for long or raises if the link is lost."""

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        """Send a payload to all subscribers of a key, including this node."""

    def subscribe(self, key_expression: str) -> None:
        """Deliver messages on matching keys (`*`: one part; `**`: any number of parts)."""

    def unsubscribe(self, key_expression: str) -> None:
        """Cancel a subscription; unknown expressions are ignored."""

    def announce(self, key: str) -> None:
        """Declare a liveliness token, visible while this node is alive and connected."""

    def withdraw(self, key: str) -> None:
        """Withdraw a liveliness token; unknown keys are ignored."""

    def watch(self, key_expression: str) -> None:
        """Deliver an event for each token that exists, appears or vanishes.

        The node's own tokens are included. For each key, `TokenUp` and `TokenDown` alternate,
        beginning with `TokenUp`. A short-lived token of this node may appear and vanish twice,
        because the network also reports it. If several nodes declare a token on one key,
        the token vanishes when the last node withdraws it.
        """

    def serve(self, key: str) -> None:
        """Deliver queries on a key."""

    def answer(self, token: int, payload: bytes, *, ok: bool, encoding: str = "") -> None:
        """Answer a query; unknown tokens, or those of answered queries, are ignored."""

    def decline(self, token: int) -> None:
        """Leave a query to the other servers of its key; unknown tokens are ignored."""

    def close(self) -> None:
        """Leave the network. Idempotent; later calls of all methods have no effect."""
