"""Leader election among coordinator candidates (rule L1).

A candidate leads when it has run for an election timeout (`network.election_s`) and has had no
contact with a higher-ranked candidate for that long. Candidates are ranked by name. The election
ensures progress, not safety: two leaders at once are harmless, because vehicles promise one ballot
at a time.

On a link that loses packets, heartbeats are delayed. A candidate whose heartbeats came late counts
as present for longer, up to twice the election timeout, so that such delays do not change the
leader again and again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from attrs import define, field

from laneweave.protocol.wire.bounds import max_election_term
from laneweave.protocol.wire.messages import Heartbeat, Name

NEWCOMER_FACTOR = 1.5
"""Number of election timeouts that a leader waits for a higher-ranked new candidate to lead."""
MAX_SILENCE_FACTOR = 2.0
"""Maximum number of election timeouts for which a silent candidate counts as present."""
SILENCE_MARGIN = 1.5
"""Ratio of the silence after which a candidate counts as absent to its longest recent one."""
SILENCE_DECAY = 0.99
"""Factor by which each contact reduces the remembered silence."""


@define
class _Peer:
    incarnation: int
    last_contact_s: float
    """Time of the last heartbeat or token from this process."""
    since_s: float
    """Time of the first contact, or of the first one after an election timeout of silence."""
    leading: bool = False
    longest_silence_s: float = 0.0
    """Longest recent time between two contacts."""


@define
class Election:
    """One candidate's view of the others, and whether it leads."""

    name: Name
    incarnation: int
    election_s: float
    started_s: float
    term: int = 0
    """Highest term seen; the candidate's own term while it leads."""
    max_term: int = max_election_term(0.0)
    """Higher terms are not adopted; grows with road time."""
    leading: bool = False
    link_up: bool = True
    retired: bool = False
    """Whether this candidate is about to exit, so that it leads no more."""
    won: int = 0
    """Number of times that this candidate has become leader."""
    _peers: dict[str, _Peer] = field(factory=dict)
    _dead: set[tuple[str, int]] = field(factory=set)

    def on_heartbeat(self, heartbeat: Heartbeat, now_s: float) -> None:
        """Record that a candidate is alive, unless its process is known to have exited.

        A heartbeat still in flight when its sender's connection closed must not revive the sender.
        """
        if heartbeat.coordinator == self.name:
            return
        self.see_term(heartbeat.term)
        if (heartbeat.coordinator, heartbeat.incarnation) in self._dead:
            return
        known = self._peers.get(heartbeat.coordinator)
        if (
            known is not None
            and known.incarnation > heartbeat.incarnation
            and now_s < self._present_until_s(known)
        ):
            return
        peer = self._on_contact(heartbeat.coordinator, heartbeat.incarnation, now_s)
        peer.leading = heartbeat.leading

    def on_messages_dropped(self, now_s: float) -> None:
        """Record that silence of candidates proves nothing: messages are dropped on their way.

        A candidate whose token has vanished, or that was silent before, stays removed.
        """
        for name in list(self.living(now_s)):
            self._peers[name].last_contact_s = now_s

    def on_token_up(self, coordinator: str, incarnation: int, now_s: float) -> None:
        """Record that a process has connected, or resumed after a pause."""
        if coordinator == self.name:
            return
        self._dead.discard((coordinator, incarnation))
        known = self._peers.get(coordinator)
        if known is None or known.incarnation <= incarnation:
            self._on_contact(coordinator, incarnation, now_s)

    def _on_contact(self, coordinator: str, incarnation: int, now_s: float) -> _Peer:
        peer = self._peers.get(coordinator)
        if peer is None or peer.incarnation != incarnation:
            peer = self._peers[coordinator] = _Peer(incarnation, now_s, now_s)
        elif now_s >= self._present_until_s(peer):
            peer.since_s, peer.leading = now_s, False
        silence_s = max(now_s - peer.last_contact_s, SILENCE_DECAY * peer.longest_silence_s)
        limit_s = MAX_SILENCE_FACTOR / SILENCE_MARGIN * self.election_s
        peer.longest_silence_s = min(silence_s, limit_s)
        peer.last_contact_s = now_s
        return peer

    def _present_until_s(self, peer: _Peer) -> float:
        """Return the time until which a candidate counts as present without another contact."""
        return peer.last_contact_s + max(self.election_s, SILENCE_MARGIN * peer.longest_silence_s)

    def on_token_down(self, coordinator: str, incarnation: int) -> None:
        """Remove a process that has exited.

        When this candidate loses its own connection, all tokens vanish, shortly before or after it
        notices the loss. While disconnected, it ignores vanishing tokens; until it notices, two
        leaders are harmless.
        """
        if not self.link_up or coordinator == self.name:
            return
        self._dead.add((coordinator, incarnation))
        known = self._peers.get(coordinator)
        if known is not None and known.incarnation <= incarnation:
            del self._peers[coordinator]

    def on_link(self, *, up: bool, now_s: float) -> None:
        """Restart this candidate's election timeout: its connection was lost or restored."""
        self.link_up = up
        self.started_s = now_s

    def see_term(self, term: int) -> None:
        """Adopt a higher term; a leader continues one term above it."""
        if self.term < term <= self.max_term:
            # A leader that was paused while another led must not continue below the other's term.
            self.term = term + 1 if self.leading else term

    def limit_term(self, max_term: int) -> None:
        """Set the maximum term, and continue with it after a term that is no longer possible."""
        self.max_term = max_term
        self.term = min(self.term, max_term)

    def update(self, now_s: float) -> bool:
        """Decide whether to lead; return whether the decision has changed."""
        rival = any(
            name < self.name
            and now_s < self._present_until_s(peer)
            and (not self.leading or peer.leading or now_s >= self._patience_s(peer))
            for name, peer in self._peers.items()
        )
        eligible = self.link_up and not self.retired
        lead = eligible and not rival and now_s >= self.started_s + self.election_s
        if lead == self.leading:
            return False
        self.leading = lead
        if lead:
            self.term += 1
            self.won += 1
        return True

    def living(self, now_s: float) -> Iterator[str]:
        """Yield the other candidates that count as present."""
        for name, peer in self._peers.items():
            if now_s < self._present_until_s(peer):
                yield name

    def _patience_s(self, peer: _Peer) -> float:
        """Return the time until which a leader waits for a higher-ranked new candidate to lead.

        A new candidate does not lead immediately; stepping down earlier would leave no leader.
        """
        return peer.since_s + NEWCOMER_FACTOR * self.election_s

    def next_change_s(self, now_s: float) -> float:
        """Return when the next wait for a higher-ranked candidate ends, or infinity."""
        times = [
            time_s
            for name, peer in self._peers.items()
            if name < self.name
            for time_s in (self._present_until_s(peer), self._patience_s(peer))
            if time_s > now_s
        ]
        return min(times, default=math.inf)
