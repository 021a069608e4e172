"""Lockstep bookkeeping: whose answer a tick waits for, for how long, and who has fallen silent.

A tick waits for every agent whose token is there, until its deadline. Somebody who misses a
deadline now and then has lost messages and is waited for at the next tick as well. Who has been
asked for `agent_silent_s` without any answer is *silent* and not waited for any more.

When nobody at all has answered for that long the network is *deaf*: no tick waits, so that
vehicles which come then do not cost the same wait one after the other.

Answers that come after their tick has been closed tell of a machine that is too slow rather than of
lost messages. Then ticks get more time, and SENSE is sent again less often, so that the road slows
down instead of leaving its vehicles behind; when none is late any more, that is taken back slowly.

Times are those of the node's clock. Each tick counts for at most its deadline: what the road waits
for otherwise (its pace, an agent that is to come up) is nobody's silence.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from attrs import define, field

from laneweave.protocol.scenario.tables import Runtime
from laneweave.protocol.wire.messages import Name

MOST_STRETCH = 8.0
"""Ticks get at most this many times `tick_deadline_s`."""
_STRETCH, _RELAX = 1.5, 0.98
"""Factors of the time for a tick, after one with late answers and after one without."""
_LATE_AGENTS = 0.05
"""Share of the agents whose answers may be late without ticks getting more time."""
LATE_SHARE = 2.0
"""An agent that answers, but always too late, is borne with for this many times as long."""
_ROUNDING_S = 1e-6
"""Sums of deadlines are compared with a time of which they may be a divisor."""


@define
class Answers:
    """Who answers the bridge's ticks."""

    runtime: Runtime
    up: set[Name] = field(factory=set)
    """Whose tokens are there."""
    silent: set[Name] = field(factory=set)
    awaited: set[Name] = field(factory=set)
    """Whose answer to the current tick is still to come."""
    resend_s: float = math.inf
    """When to ask those again."""
    deadline_s: float = math.inf
    """When the current tick goes on without them."""
    _asked_s: float = 0.0
    _unheard: set[Name] = field(factory=set)
    """Whose tokens were there when the current tick was sent, and who were not heard since."""
    _unheard_s: dict[Name, float] = field(factory=dict)
    """How long each has been asked since it was heard last."""
    _idle_s: dict[Name, float] = field(factory=dict)
    """How long each has been asked since an answer of it came in time."""
    _asked: set[Name] = field(factory=set)
    """Whose tokens were there when the current tick was sent, and who did not answer it in time."""
    _late: set[Name] = field(factory=set)
    """Who answered an earlier tick since the current one was sent."""
    _stretch: float = 1.0
    _heard_any: bool = False
    _deaf_s: float = 0.0
    """How long agents have been asked since anybody was heard."""

    @property
    def deaf(self) -> bool:
        """Nobody at all has answered for too long."""
        return self._too_long(self._deaf_s)

    def agent_up(self, name: Name) -> None:
        """An agent's token appeared: it gets all the time that it may take."""
        self.up.add(name)
        self._begin_anew(name)

    def agent_down(self, name: Name) -> None:
        """An agent's token vanished."""
        self.up.discard(name)
        self.awaited.discard(name)
        self._begin_anew(name)

    def forget(self, name: Name) -> None:
        """Forget a vehicle that left the road; its agent may still be up."""
        self.awaited.discard(name)
        self._begin_anew(name)

    def heard(self, name: Name) -> None:
        """An agent gave a sign of life: an answer to any tick."""
        self._forgive(name)
        self._heard_any = True
        self._deaf_s = 0.0

    def late(self, name: Name) -> None:
        """An answer came after its tick had been closed."""
        self._late.add(name)

    def effective(self, name: Name) -> None:
        """An answer came in time: the agent drives its vehicle."""
        self.awaited.discard(name)
        self._asked.discard(name)
        self._idle_s.pop(name, None)

    def link_down(self) -> None:
        """The bridge lost its own connection: whoever does not answer now is not to blame."""
        self._unheard.clear()
        self._asked.clear()

    def settle(self, now_s: float) -> list[Name]:
        """Account for the tick before; return who has become silent with it."""
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
        """A tick is sent to all vehicles on the road.

        Args:
            on_road: all of them.
            now_s: the node's clock.
            link_up: whether the bridge is connected; nobody can answer while it is not.
        """
        self._unheard = {name for name in on_road if name in self.up} if link_up else set()
        self._asked = set(self._unheard)
        self._heard_any = False
        self.awaited = set() if self.deaf else self._unheard - self.silent
        slow = len(self._late) > _LATE_AGENTS * len(self.up)
        self._stretch *= _STRETCH if slow else _RELAX
        self._stretch = min(max(self._stretch, 1.0), MOST_STRETCH)
        self._late.clear()
        self._asked_s = now_s
        self.resend_s = now_s + self._stretch * self.runtime.tick_resend_s
        self.deadline_s = now_s + self._stretch * self.runtime.tick_deadline_s

    def ask_again(self, now_s: float) -> list[Name]:
        """Return who is to be asked again now."""
        if now_s < self.resend_s:
            return []
        self.resend_s = now_s + self._stretch * self.runtime.tick_resend_s
        return sorted(self.awaited)

    def complete(self, now_s: float) -> bool:
        """Tell whether the tick may go on."""
        return not self.awaited or now_s >= self.deadline_s

    def close(self) -> int:
        """End the tick; return how many have missed it."""
        missed = len(self.awaited)
        self.awaited.clear()
        return missed

    def ineffective(self, name: Name) -> bool:
        """Tell whether no answer of an agent has come in time for too long, though it may live."""
        return self._too_long(self._idle_s.get(name, 0.0) / LATE_SHARE)

    def _begin_anew(self, name: Name) -> None:
        """Hold nothing against an agent that was so far."""
        self._forgive(name)
        self._asked.discard(name)
        self._idle_s.pop(name, None)

    def _forgive(self, name: Name) -> None:
        self.silent.discard(name)
        self._unheard.discard(name)
        self._unheard_s.pop(name, None)

    def _too_long(self, unheard_s: float) -> bool:
        return unheard_s >= self.runtime.agent_silent_s - _ROUNDING_S
