"""Lockstep answers: which agents a tick waits for, for how long, and which have fallen silent.

A tick waits for every agent with a token until its deadline. An agent that misses a deadline now
and then has lost messages, and the next tick waits for it again. An agent that has not answered for
`agent_silent_s` is *silent*: ticks no longer wait for it.

When no agent at all has answered for that long, the network is *all_silent*: no tick waits, so that
vehicles which enter then do not each cost the same wait.

Answers that come after their tick was closed indicate a slow machine rather than lost messages.
Then ticks get more time, and SENSE is repeated less often, so that the road slows down instead of
leaving its vehicles behind. When answers are in time again, this is undone slowly.

Times are those of the node's clock. Each tick counts for at most its deadline: other waits of the
road (its pace, an agent that is starting) do not count as silence.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from attrs import define, field

from laneweave.protocol.scenario.fields import Runtime
from laneweave.protocol.wire.messages import Name

MAX_STRETCH = 8.0
"""Ticks get at most this many times `tick_deadline_s`."""
_STRETCH, _RELAX = 1.5, 0.98
"""Factors of the time for a tick, after a tick with and without late answers."""
_LATE_AGENTS = 0.05
"""Share of agents whose late answers do not give ticks more time."""
LATE_SHARE = 2.0
"""An agent that always answers too late is tolerated this many times longer than a silent one."""
_ROUNDING_S = 1e-6
"""Tolerance when sums of deadlines are compared with a multiple of a deadline."""


@define
class Answers:
    """Which agents answer the bridge's ticks."""

    runtime: Runtime
    up: set[Name] = field(factory=set)
    """Agents with a token."""
    silent: set[Name] = field(factory=set)
    awaited: set[Name] = field(factory=set)
    """Agents whose answer to the current tick is awaited."""
    resend_s: float = math.inf
    """When SENSE is repeated to them."""
    deadline_s: float = math.inf
    """When the current tick proceeds without them."""
    _sent_s: float = 0.0
    _without_message: set[Name] = field(factory=set)
    """Agents up when the current tick was sent that have sent nothing since."""
    _silence_s: dict[Name, float] = field(factory=dict)
    """Duration of the ticks sent to each agent since it was heard."""
    _late_s: dict[Name, float] = field(factory=dict)
    """Duration of the ticks sent to each agent since it answered in time."""
    _without_answer: set[Name] = field(factory=set)
    """Agents up when the current tick was sent that have not answered in time."""
    _late: set[Name] = field(factory=set)
    """Agents that answered an earlier tick since the current one was sent."""
    _stretch: float = 1.0
    _any_message: bool = False
    _all_silent_s: float = 0.0
    """Duration of the ticks since any agent was heard."""

    @property
    def all_silent(self) -> bool:
        """Whether no agent at all has answered for too long."""
        return self._too_long(self._all_silent_s)

    def agent_up(self, name: Name) -> None:
        """Register an agent's token; all its counters start again."""
        self.up.add(name)
        self._reset(name)

    def agent_down(self, name: Name) -> None:
        """Remove an agent whose token vanished."""
        self.up.discard(name)
        self.awaited.discard(name)
        self._reset(name)

    def remove(self, name: Name) -> None:
        """Forget a vehicle that left the road; its agent may still be up."""
        self.awaited.discard(name)
        self._reset(name)

    def on_message(self, name: Name) -> None:
        """Register a sign of life: an answer to any tick."""
        self._reset_silence(name)
        self._any_message = True
        self._all_silent_s = 0.0

    def late(self, name: Name) -> None:
        """Register an answer that came after its tick was closed."""
        self._late.add(name)

    def in_time(self, name: Name) -> None:
        """Register an answer that came in time."""
        self.awaited.discard(name)
        self._without_answer.discard(name)
        self._late_s.pop(name, None)

    def link_down(self) -> None:
        """Register that the bridge lost its own connection: silence is no evidence then."""
        self._without_message.clear()
        self._without_answer.clear()

    def finish_tick(self, now_s: float) -> list[Name]:
        """Account for the previous tick; return the agents that have become silent."""
        lasted_s = min(now_s - self._sent_s, self._stretch * self.runtime.tick_deadline_s)
        for name in self._without_answer & self.up:
            self._late_s[name] = self._late_s.get(name, 0.0) + lasted_s
        fallen_silent = []
        for name in sorted(self._without_message):
            self._silence_s[name] = self._silence_s.get(name, 0.0) + lasted_s
            if name not in self.silent and self._too_long(self._silence_s[name]):
                self.silent.add(name)
                fallen_silent.append(name)
        if self._without_message and not self._any_message:
            self._all_silent_s += lasted_s
        self._without_message.clear()
        return fallen_silent

    def start_tick(self, on_road: Iterable[Name], now_s: float, *, link_up: bool) -> None:
        """Begin a tick that is sent to all vehicles on the road.

        Args:
            on_road: all of them.
            now_s: the node's clock.
            link_up: whether the bridge is connected; otherwise no agent can answer.
        """
        self._without_message = {name for name in on_road if name in self.up} if link_up else set()
        self._without_answer = set(self._without_message)
        self._any_message = False
        self.awaited = set() if self.all_silent else self._without_message - self.silent
        slow = len(self._late) > _LATE_AGENTS * len(self.up)
        self._stretch *= _STRETCH if slow else _RELAX
        self._stretch = min(max(self._stretch, 1.0), MAX_STRETCH)
        self._late.clear()
        self._sent_s = now_s
        self.resend_s = now_s + self._stretch * self.runtime.tick_resend_s
        self.deadline_s = now_s + self._stretch * self.runtime.tick_deadline_s

    def due_resends(self, now_s: float) -> list[Name]:
        """Return the agents to which SENSE is repeated now."""
        if now_s < self.resend_s:
            return []
        self.resend_s = now_s + self._stretch * self.runtime.tick_resend_s
        return sorted(self.awaited)

    def complete(self, now_s: float) -> bool:
        """Return whether the tick may proceed."""
        return not self.awaited or now_s >= self.deadline_s

    def close(self) -> int:
        """End the tick; return the number of missing answers."""
        missed = len(self.awaited)
        self.awaited.clear()
        return missed

    def always_late(self, name: Name) -> bool:
        """Return whether an agent that may be alive has not answered in time for too long."""
        return self._too_long(self._late_s.get(name, 0.0) / LATE_SHARE)

    def _reset(self, name: Name) -> None:
        """Reset all counters of an agent."""
        self._reset_silence(name)
        self._without_answer.discard(name)
        self._late_s.pop(name, None)

    def _reset_silence(self, name: Name) -> None:
        self.silent.discard(name)
        self._without_message.discard(name)
        self._silence_s.pop(name, None)

    def _too_long(self, duration_s: float) -> bool:
        return duration_s >= self.runtime.agent_silent_s - _ROUNDING_S
