"""Refusals because of overload, at a limited rate for each client, so that floods become slow.

A flooding client sends the next request when the last one is refused. If refusals are prompt, they
take more CPU time from router and coordinators than plans do.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import count

from attrs import define, field, frozen

from laneweave.coordinator.service.pending import OpenQuery
from laneweave.protocol.runtime.node import Reply
from laneweave.protocol.runtime.queries import OVERLOADED, Refusal

PROMPT = 64
"""Number of refusals that a client gets at once, before their rate is limited."""
RATE_PER_S = 64.0
"""Rate of further refusals to one client."""
_PROMPT_S = (PROMPT - 1) / RATE_PER_S
"""Time in which the refusals that are sent at once would be sent at the rate."""
MAX_HELD = 1024
"""Upper bound on the refusals that are held back, since their queries count as open ones."""
MIN_RETRY_S, MAX_RETRY_S = 0.05, 5.0
"""Range of the time after which a client should send a refused request again; refusals are held
back for at most `MAX_RETRY_S`."""


@frozen(order=True)
class _HeldRefusal:
    """A refusal that waits for its time."""

    due_s: float
    number: int
    """Order of arrival."""
    query: OpenQuery = field(order=False)
    reason: str = field(order=False)
    retry_at_s: float = field(order=False)
    """Time at which the client should send its request again, on the node clock."""

    def reply(self, now_s: float) -> Reply:
        """Return the effect that refuses the request."""
        retry_after_s = round(min(max(MIN_RETRY_S, self.retry_at_s - now_s), MAX_RETRY_S), 2)
        text = f"{self.reason}; try again in {retry_after_s:g} s"
        return self.query.form.reply(self.query.token, Refusal(OVERLOADED, text, "", retry_after_s))


@define
class PacedRefusals:
    """Refusals of all clients; pure, the caller passes the node clock."""

    _used_until_s: dict[str, float] = field(factory=dict)
    """Time by client until which its refusals so far use up the rate."""
    _held: list[_HeldRefusal] = field(factory=list)
    """Heap: the one that is due first comes first."""
    _numbers: Iterator[int] = field(factory=count)

    @property
    def wakeup_s(self) -> float | None:
        """Time at which a refusal is due."""
        return self._held[0].due_s if self._held else None

    def refuse(
        self, query: OpenQuery, reason: str, retry_after_s: float, now_s: float
    ) -> Iterator[Reply]:
        """Refuse a request now, or hold the refusal back if its client has had many.

        Args:
            query: query of the request.
            reason: field, value and what is allowed.
            retry_after_s: time after which the client should send the request again.
            now_s: node clock.
        """
        client = query.session.client
        # Forget clients whose rate is free again.
        used = self._used_until_s.items()
        self._used_until_s = {name: until_s for name, until_s in used if until_s > now_s}
        used_s = self._used_until_s.get(client, now_s)
        due_s = min(max(now_s, used_s - _PROMPT_S), now_s + MAX_RETRY_S)
        self._used_until_s[client] = min(used_s, now_s + _PROMPT_S + MAX_RETRY_S) + 1 / RATE_PER_S
        held = _HeldRefusal(due_s, next(self._numbers), query, reason, now_s + retry_after_s)
        heapq.heappush(self._held, held)
        if len(self._held) > MAX_HELD:
            yield heapq.heappop(self._held).reply(now_s)
        yield from self.release(now_s)

    def withdraw(self) -> list[OpenQuery]:
        """Remove and return the queries whose refusals are held back."""
        queries = [held.query for held in self._held]
        self._held.clear()
        return queries

    def release(self, now_s: float) -> Iterator[Reply]:
        """Send the refusals that are due."""
        while self._held and self._held[0].due_s <= now_s:
            yield heapq.heappop(self._held).reply(now_s)
