"""Lockstep answers: which agents a tick waits for, for how long, and which have fallen silent.

A tick waits for every agent with a token until its deadline. An agent that misses a deadline now
and then has lost messages, and the next tick waits for it again. An agent that has not answered for
`agent_silent_s` is *silent*: ticks no longer wait for it.

When no agent at all has answered for that long, the network is *deaf*: no tick waits, so that
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
    _asked_s: float = 0.0
    _unheard: set[Name] = field(factory=set)
    """Agents up when the current tick was sent that have sent nothing since."""
    _unheard_s: dict[Name, float] = field(factory=dict)
    """Duration of the ticks sent to each agent since it was heard."""
    _idle_s: dict[Name, float] = field(factory=dict)
    """Duration of the ticks sent to each agent since it answered in time."""
    _asked: set[Name] = field(factory=set)
    """Agents up when the current tick was sent that have not answered in time."""
    _late: set[Name] = field(factory=set)
    """Agents that answered an earlier tick since the current one was sent."""
    _stretch: float = 1.0
    _heard_any: bool = False
    _deaf_s: float = 0.0
    """Duration of the ticks since any agent was heard."""

    @property
    def deaf(self) -> bool:
        """Whether no agent at all has answered for too long."""
        return self._too_long(self._deaf_s)

    def agent_up(self, name: Name) -> None:
        """Register an agent's token; all its counters start again."""
        self.up.add(name)
        self._reset(name)

    def agent_down(self, name: Name) -> None:
        """Remove an agent whose token vanished."""
        self.up.discard(name)
        self.awaited.discard(name)
        self._reset(name)

    def forget(self, name: Name) -> None:
        """Forget a vehicle that left the road; its agent may still be up."""
        self.awaited.discard(name)
        self._reset(name)

    def heard(self, name: Name) -> None:
        """Register a sign of life: an answer to any tick."""
        self._reset_silence(name)
        self._heard_any = True
        self._deaf_s = 0.0

    def late(self, name: Name) -> None:
        """Register an answer that came after its tick was closed."""
        self._late.add(name)

    def effective(self, name: Name) -> None:
        """Register an answer that came in time."""
        self.awaited.discard(name)
        self._asked.discard(name)
        self._idle_s.pop(name, None)

    def link_down(self) -> None:
        """Register that the bridge lost its own connection: silence is no evidence then."""
        self._unheard.clear()
        self._asked.clear()

    def settle(self, now_s: float) -> list[Name]:
        """Account for the previous tick; return the agents that have become silent."""
        lasted_s = min(now_s - self._asked_s, self._stretch * self.runtime.tick_deadline_s)
        for name in self._asked & self.up:
            self._idle_s[name] = self._idle_s.get(name, 0.0) + lasted_s
        fallen_silent = []
        for name in sorted(self._unheard):
            self._unheard_s[name] = self._unheard_s.get(name, 0.0) + lasted_s
            if name not in self.silent and self._too_long(self._unheard_s[name]):
                self.silent.add(name)
                fallen_silent.append(name)
        if self._unheard and not self._heard_any:
            self._deaf_s += lasted_s
        self._unheard.clear()
        return fallen_silent

    def ask(self, on_road: Iterable[Name], now_s: float, *, link_up: bool) -> None:
        """Begin a tick that is sent to all vehicles on the road.

        Args:
            on_road: all of them.
            now_s: the node's clock.
            link_up: whether the bridge is connected; otherwise no agent can answer.
        """
        self._unheard = {name for name in on_road if name in self.up} if link_up else set()
        self._asked = set(self._unheard)
        self._heard_any = False
        self.awaited = set() if self.deaf else self._unheard - self.silent
        slow = len(self._late) > _LATE_AGENTS * len(self.up)
        self._stretch *= _STRETCH if slow else _RELAX
        self._stretch = min(max(self._stretch, 1.0), MAX_STRETCH)
        self._late.clear()
        self._asked_s = now_s
        self.resend_s = now_s + self._stretch * self.runtime.tick_resend_s
        self.deadline_s = now_s + self._stretch * self.runtime.tick_deadline_s

    def ask_again(self, now_s: float) -> list[Name]:
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

    def ineffective(self, name: Name) -> bool:
        """Return whether an agent that may be alive has not answered in time for too long."""
        return self._too_long(self._idle_s.get(name, 0.0) / LATE_SHARE)

    def _reset(self, name: Name) -> None:
        """Reset all counters of an agent."""
        self._reset_silence(name)
        self._asked.discard(name)
        self._idle_s.pop(name, None)

    def _reset_silence(self, name: Name) -> None:
        self.silent.discard(name)
        self._unheard.discard(name)
        self._unheard_s.pop(name, None)

    def _too_long(self, unheard_s: float) -> bool:
        return unheard_s >= self.runtime.agent_silent_s - _ROUNDING_S
