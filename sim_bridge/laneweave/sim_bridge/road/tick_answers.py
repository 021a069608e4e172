"""Lockstep answers: the agents that a tick waits for, its deadline, and silent agents.

A tick waits until its deadline for every agent with a token. If messages are lost, the next tick
waits for the agent again. An agent that has not answered for `agent_silent_s` is *silent*: ticks no
longer wait for it. If no agent has answered for that long, ticks do not wait for new agents either.

Answers after the deadline indicate a slow machine rather than lost messages. Ticks then get more
time, and SENSE is repeated less often, so that the road slows down and agents keep up. When answers
arrive in time again, the extra time slowly shrinks.

While messages are lost (`message_loss`), SENSE is repeated as soon as no more answers arrive, in
several copies, and a tick lasts no longer than in real time.

Times are on the node's clock. Each tick counts for at most its deadline; other waits of the road
(pace, starting agents) do not count as silence.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from attrs import define, field

from laneweave.protocol.scenario.deployment_fields import Runtime
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.message_loss import MessageLoss

MAX_SLOWDOWN = 8.0
"""Maximum factor of `tick_deadline_s`."""
_SLOW_DOWN, _RELAX = 1.5, 0.98
"""Multipliers of the deadline's factor after ticks with too many late answers, and after others."""
_LATE_AGENTS = 0.05
"""Fraction of the agents that a tick awaits that may be late before the deadline is increased."""
_LATE_AGENTS_LOSSY = 1.0 / 3.0
"""The same while messages are lost: ticks then end while answers to repeated SENSE are under way,
so some agents are late on a fast machine, too."""
LATE_SHARE = 2.0
"""Multiple of `agent_silent_s` after which an agent that always answers late is replaced."""
LOSSY_TICK = 0.6
"""Deadline of a tick while messages are lost, as a multiple of `tick_s`."""
LOSSY_ROUNDS = 6
"""Minimum number of rounds of SENSE for which that deadline has time, on slow networks."""
COPIES = 3
"""Maximum number of copies of a repeated SENSE while messages are lost."""
FEW = 50
"""Number of messages that a round may have even if the tick began with fewer."""
_FLOOR = 0.1
"""Minimum wait for further answers, as a multiple of `tick_resend_s`."""
_ROUND_TRIPS = 1.5
"""The same, as a multiple of the shortest round trip."""
_FORGET = 1.1
"""Multiplier of the round-trip time at each tick, to detect that it has increased."""
_ROUNDING_S = 1e-6
"""Tolerance for comparing sums of deadlines with `agent_silent_s`."""


@define
class Answers:
    """Answers from agents to the bridge's ticks."""

    runtime: Runtime
    up: set[Name] = field(factory=set)
    """Agents with a token."""
    silent: set[Name] = field(factory=set)
    awaited: set[Name] = field(factory=set)
    """Agents whose answers the current tick awaits."""
    resend_s: float = math.inf
    """Time at which SENSE is repeated to awaited agents."""
    deadline_s: float = math.inf
    """Time at which the current tick proceeds without awaited agents."""
    _sent_s: float = 0.0
    _without_message: set[Name] = field(factory=set)
    """Present agents that have sent no message since the tick started."""
    _silence_s: dict[Name, float] = field(factory=dict)
    """Total duration of ticks since the last message from each agent."""
    _late_s: dict[Name, float] = field(factory=dict)
    """Total duration of ticks since each agent last answered in time."""
    _without_answer: set[Name] = field(factory=set)
    """Present agents that have not answered the current tick."""
    _late: set[Name] = field(factory=set)
    """Agents that have answered an earlier tick since the current tick started."""
    _slowdown: float = 1.0
    _asked: int = 0
    """Number of agents whose answers the last tick awaited."""
    _all_sensed: bool = True
    """Whether all vehicles on the road have got a SENSE in the current tick."""
    _any_message: bool = False
    _all_silent_s: float = 0.0
    """Total duration of ticks since the last message from any agent."""
    _missing: set[Name] = field(factory=set)
    """Agents whose answers the last tick awaited in vain."""
    _loss: MessageLoss = field(factory=MessageLoss)
    _round_s: float | None = None
    """Time at which the last round of SENSE was sent; None: it is being sent."""
    _first_round_s: float | None = None
    """Time at which the first SENSE messages of the tick were sent; None: they are being sent."""
    _round_trip_s: float = math.inf
    """Shortest recent time from sending a tick to the first answer."""

    @property
    def all_silent(self) -> bool:
        """Whether no agent has sent a message for `agent_silent_s`."""
        return self._too_long(self._all_silent_s)

    @property
    def lossy(self) -> bool:
        """Whether messages are lost."""
        return self._loss.lossy

    def agent_up(self, name: Name) -> None:
        """Register an agent's token and reset its counters."""
        self.up.add(name)
        self._reset(name)

    def agent_down(self, name: Name) -> None:
        """Remove an agent whose token has vanished."""
        self.up.discard(name)
        self.remove(name)

    def remove(self, name: Name) -> None:
        """Remove a vehicle that has left the road; its agent may still be present."""
        self.awaited.discard(name)
        self._reset(name)

    def on_message(self, name: Name) -> None:
        """Register an answer to any tick as a sign of life."""
        self._reset_silence(name)
        self._any_message = True
        self._all_silent_s = 0.0

    def received(self, name: Name, now_s: float, *, current: bool) -> None:
        """Register the arrival of an answer, which may be a duplicate.

        Args:
            name: the agent.
            now_s: the node's clock.
            current: whether it answers the current tick.
        """
        first = not self._loss.received
        self._loss.received[name] += 1
        if self._first_round_s is not None and current and first:
            self._round_trip_s = min(self._round_trip_s, now_s - self._first_round_s)
        if self.lossy and self._round_s is not None:
            self.resend_s = max(self.resend_s, now_s + 0.5 * self._quiet_s)

    def late(self, name: Name) -> None:
        """Register an answer to an earlier tick, unless another one had arrived in time."""
        if name in self._missing:
            self._late.add(name)

    def in_time(self, name: Name) -> None:
        """Register an answer to the current tick."""
        self.awaited.discard(name)
        self._without_answer.discard(name)
        self._late_s.pop(name, None)

    def link_down(self) -> None:
        """Register that the bridge has lost its connection, so that no agent can answer."""
        self._without_message.clear()
        self._without_answer.clear()

    def update_durations(self, now_s: float) -> list[Name]:
        """Update all durations after a tick; return the agents that have become silent."""
        lasted_s = min(now_s - self._sent_s, self._slowdown * self.runtime.tick_deadline_s)
        for name in self._without_answer & self.up:
            self._late_s[name] = self._late_s.get(name, 0.0) + lasted_s
        fallen_silent = []
        for name in sorted(self._without_message):
            self._silence_s[name] = self._silence_s.get(name, 0.0) + lasted_s
            if name not in self.silent and self._too_long(self._silence_s[name]):
                self.silent.add(name)
                fallen_silent.append(name)
        if self._without_message and not self._any_message and self._all_sensed:
            self._all_silent_s += lasted_s
        self._without_message.clear()
        return fallen_silent

    def start_tick(
        self, sensed: Iterable[Name], now_s: float, *, link_up: bool, all_sensed: bool = True
    ) -> None:
        """Start a tick.

        Args:
            sensed: the vehicles that get a SENSE in this tick.
            now_s: the node's clock.
            link_up: whether the bridge is connected; otherwise no agent can answer.
            all_sensed: whether these are all vehicles on the road; the others hold undisturbed.
        """
        self._all_sensed = all_sensed
        self._without_message = {name for name in sensed if name in self.up} if link_up else set()
        self._without_answer = set(self._without_message)
        self._any_message = False
        self.awaited = set() if self.all_silent else self._without_message - self.silent
        share = _LATE_AGENTS_LOSSY if self.lossy else _LATE_AGENTS
        slow = len(self._late) > share * self._asked
        self._asked = len(self.awaited)
        self._slowdown *= _SLOW_DOWN if slow else _RELAX
        self._slowdown = min(max(self._slowdown, 1.0), MAX_SLOWDOWN)
        self._late.clear()
        self._loss.start_tick()
        self._round_trip_s *= _FORGET
        self._sent_s, self._first_round_s = now_s, None
        self._begin_round(now_s, self.awaited)
        self.deadline_s = now_s + self._slowdown * self._patience_s

    def _begin_round(self, now_s: float, names: Iterable[Name]) -> None:
        """Register that a SENSE is being sent to agents."""
        self._loss.on_sent(names)
        if self.lossy:
            # Sending takes time: the wait for answers begins with the next event.
            self._round_s, self.resend_s = None, now_s
        else:
            self._round_s = now_s
            self._first_round_s = self._first_round_s or now_s
            self.resend_s = now_s + self._slowdown * self.runtime.tick_resend_s

    @property
    def _quiet_s(self) -> float:
        """Time without any answer after which SENSE is repeated while messages are lost.

        Half of it after an answer, since those of other agents follow shortly.
        """
        longest_s = self.runtime.tick_resend_s
        needed_s = max(_FLOOR * longest_s, _ROUND_TRIPS * self._round_trip_s)
        return self._slowdown * min(longest_s, needed_s)

    @property
    def _patience_s(self) -> float:
        """Deadline of a tick, from its start."""
        runtime = self.runtime
        if not self.lossy:
            return runtime.tick_deadline_s
        rounds_s = LOSSY_ROUNDS * self._quiet_s / self._slowdown
        return min(runtime.tick_deadline_s, max(LOSSY_TICK * runtime.tick_s, rounds_s))

    def due_resends(self, now_s: float) -> list[Name]:
        """Return the agents to which SENSE must be repeated now, each as often as it must be sent.

        While messages are lost, a tick without time for another round ends here.
        """
        if now_s < self.resend_s:
            return []
        if self._round_s is None:
            self._round_s, self.resend_s = now_s, now_s + self._quiet_s
            self._first_round_s = self._first_round_s or now_s
            return []
        if self.lossy and now_s + self._quiet_s > self.deadline_s:
            self.deadline_s = now_s
            return []
        copies = 1
        if self.lossy:
            # Many messages keep the processors busy, but few rounds of few messages save time.
            budget = max(FEW, len(self._loss.asked))
            copies = min(COPIES, max(1, budget // max(1, len(self.awaited))))
        again = [name for name in sorted(self.awaited) for _ in range(copies)]
        self._begin_round(now_s, again)
        return again

    def complete(self, now_s: float) -> bool:
        """Return whether the tick may proceed."""
        return not self.awaited or now_s >= self.deadline_s

    def close(self) -> int:
        """Close the tick; return the number of missing answers."""
        self._missing = set(self.awaited)
        self.awaited.clear()
        return len(self._missing)

    def always_late(self, name: Name) -> bool:
        """Return whether all answers from an agent have been late for too long."""
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
