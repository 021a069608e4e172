"""Leader election among coordinator candidates (rule L1).

A candidate leads when it has heard no better-ranked one for the election time and is itself at
least that old. Candidates are ranked by name. Election gives progress, never safety: two leaders
at once are harmless, because vehicles promise one ballot at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from attrs import define, field

from laneweave.protocol.wire.messages import Heartbeat, Name

NEWCOMER_FACTOR = 1.5
"""A leader waits this many election times for a better-ranked newcomer to lead."""
MAX_TERM = 2**62
"""Higher terms are ignored: following one would leave no room to count on."""


@define
class _Peer:
    incarnation: int
    heard_s: float
    since_s: float
    """When this process was first heard."""
    leading: bool = False


@define
class Election:
    """What one candidate knows of the others."""

    name: Name
    incarnation: int
    election_s: float
    started_s: float
    term: int = 0
    """Highest term seen; the own term while leading."""
    leading: bool = False
    link_up: bool = True
    won: int = 0
    """How often it has begun to lead."""
    _peers: dict[str, _Peer] = field(factory=dict)
    _dead: set[tuple[str, int]] = field(factory=set)

    def on_heartbeat(self, heartbeat: Heartbeat, now_s: float) -> None:
        """Record that a candidate is alive, unless its process is known to be gone.

        A heartbeat that was still in flight when its sender's connection closed must not revive it.
        """
        if heartbeat.coordinator == self.name:
            return
        self.see_term(heartbeat.term)
        if (heartbeat.coordinator, heartbeat.incarnation) in self._dead:
            return
        known = self._peers.get(heartbeat.coordinator)
        if known is not None and known.incarnation > heartbeat.incarnation:
            return
        self._hear(heartbeat.coordinator, heartbeat.incarnation, now_s).leading = heartbeat.leading

    def on_token_up(self, coordinator: str, incarnation: int, now_s: float) -> None:
        """Record that a process has connected, or has woken up from a pause."""
        if coordinator == self.name:
            return
        self._dead.discard((coordinator, incarnation))
        known = self._peers.get(coordinator)
        if known is None or known.incarnation <= incarnation:
            self._hear(coordinator, incarnation, now_s)

    def _hear(self, coordinator: str, incarnation: int, now_s: float) -> _Peer:
        peer = self._peers.get(coordinator)
        if (
            peer is None
            or peer.incarnation != incarnation
            or now_s >= peer.heard_s + self.election_s
        ):
            peer = self._peers[coordinator] = _Peer(incarnation, now_s, now_s)
        peer.heard_s = now_s
        return peer

    def on_token_down(self, coordinator: str, incarnation: int) -> None:
        """Forget a process that is gone.

        When this candidate loses its own connection, every token vanishes, before or after the
        news of it. While it knows that it is disconnected it concludes nothing; in the moment
        before, two leaders are harmless.
        """
        if not self.link_up or coordinator == self.name:
            return
        self._dead.add((coordinator, incarnation))
        known = self._peers.get(coordinator)
        if known is not None and known.incarnation <= incarnation:
            del self._peers[coordinator]

    def on_link(self, *, up: bool, now_s: float) -> None:
        """Count the own age anew: the own connection was lost or has come back."""
        self.link_up = up
        self.started_s = now_s

    def see_term(self, term: int) -> None:
        """Remember the highest term seen."""
        if self.term < term <= MAX_TERM:
            # A leader that was paused while another one led must not go on below its term.
            self.term = term + 1 if self.leading else term

    def update(self, now_s: float) -> bool:
        """Decide whether to lead now; return whether this has changed."""
        rival = any(
            name < self.name
            and now_s < peer.heard_s + self.election_s
            and (not self.leading or peer.leading or now_s >= self._patience_s(peer))
            for name, peer in self._peers.items()
        )
        lead = self.link_up and not rival and now_s >= self.started_s + self.election_s
        if lead == self.leading:
            return False
        self.leading = lead
        if lead:
            self.term += 1
            self.won += 1
        return True

    def raise_term(self, above: int) -> None:
        """Take a term above one that was seen on a vehicle (L3)."""
        self.term = max(self.term, above + 1)

    def living(self, now_s: float) -> Iterator[str]:
        """Yield the other candidates heard within the election time."""
        for name, peer in self._peers.items():
            if now_s < peer.heard_s + self.election_s:
                yield name

    def _patience_s(self, peer: _Peer) -> float:
        """Return until when a leader waits for a better-ranked newcomer to lead.

        A newcomer may not lead before it is old enough; stepping down at once would leave no
        leader.
        """
        return peer.since_s + NEWCOMER_FACTOR * self.election_s

    def next_change_s(self, now_s: float) -> float:
        """Return when the next decision after `now_s` may be due without any message."""
        times = [
            time_s
            for name, peer in self._peers.items()
            if name < self.name
            for time_s in (peer.heard_s + self.election_s, self._patience_s(peer))
            if time_s > now_s
        ]
        return min(times, default=math.inf)
