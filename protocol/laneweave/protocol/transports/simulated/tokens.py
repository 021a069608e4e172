"""Liveliness in the simulated network: who sees which token appear and vanish, and when.

Several nodes may show a token on one key: it appears with the first and vanishes with the last.
News of tokens are never lost and stay in order, as Zenoh's declarations do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from laneweave.protocol.runtime.transport import TokenDown, TokenUp
from laneweave.protocol.transports.simulated.members import Member
from laneweave.protocol.transports.simulated.virtual_time import Simulation
from laneweave.protocol.wire.topics import matches_any


class Tokens:
    """Tells watchers of tokens."""

    def __init__(self, simulation: Simulation, members: Mapping[str, Member]) -> None:
        """Serve all who are in `members` at the time of each call."""
        self._simulation = simulation
        self._members = members

    def appeared(self, owner: Member, key: str) -> None:
        """Tell all watchers of a token that its owner has just shown."""
        if owner.visible and not self._shown(key, owner):
            self._tell_watchers(TokenUp(key))

    def vanished(self, owner: Member, key: str) -> None:
        """Tell all watchers that a token is gone that its owner has just taken back."""
        if owner.visible and not self._shown(key, owner):
            self._tell_watchers(TokenDown(key))

    def introduce(self, watcher: Member, expressions: Iterable[str]) -> None:
        """Tell a watcher of the tokens that are there."""
        keys = (
            key
            for member in self._members.values()
            if member.visible
            for key in member.transport.tokens
            if matches_any(expressions, key)
        )
        for key in dict.fromkeys(keys):
            self._tell(watcher, TokenUp(key))

    def show_all(self, owner: Member, but: Member | None = None) -> None:
        """Tell all watchers but one of the tokens of a node that has become visible."""
        if owner.visible:
            for key in owner.transport.tokens:
                if not self._shown(key, owner):
                    self._tell_watchers(TokenUp(key), but)

    def hide_all(self, owner: Member) -> None:
        """Tell all watchers but the owner that the tokens of a visible node are gone."""
        if owner.visible:
            for key in owner.transport.tokens:
                if not self._shown(key, owner):
                    self._tell_watchers(TokenDown(key), owner)

    def _shown(self, key: str, owner: Member) -> bool:
        """Tell whether somebody else shows a token on this key."""
        return any(
            member is not owner and member.visible and key in member.transport.tokens
            for member in self._members.values()
        )

    def _tell_watchers(self, news: TokenUp | TokenDown, but: Member | None = None) -> None:
        for member in self._members.values():
            if (
                member is not but
                and member.connected
                and matches_any(member.transport.watched, news.key)
            ):
                self._tell(member, news)

    def _tell(self, watcher: Member, news: TokenUp | TokenDown) -> None:
        simulation = self._simulation
        watcher.news_s = max(watcher.news_s, simulation.now_s + simulation.delay_s())
        simulation.at(watcher.news_s, watcher.arrive, watcher.connection, news)
