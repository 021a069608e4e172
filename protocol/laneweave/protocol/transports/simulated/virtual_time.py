"""Virtual time: event queue, conditions and clocks of a simulation, and trace digests."""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable
from hashlib import blake2b
from itertools import count
from typing import Any

from attrs import field, frozen
from attrs.validators import and_, ge, gt, le, lt

from laneweave.protocol.runtime.node import Computed, Started, Stopping, Wakeup
from laneweave.protocol.runtime.transport import (
    Delivery,
    Query,
    Received,
    TokenDown,
    TokenUp,
)

Item = Delivery | Computed | Started | Stopping | Wakeup
"""Input of a node."""
Trace = Callable[[float, str, Item], None]
"""Called with the virtual time, node name and content of each input, in order."""
Action = Callable[..., None]

_SHARE = and_(ge(0.0), le(1.0))
_TIME = and_(ge(0.0), lt(math.inf))


@frozen
class Conditions:
    """Message faults, lease, and computation times."""

    delay_s: float = field(default=0.002, validator=_TIME)
    jitter_s: float = field(default=0.003, validator=_TIME)
    """The delay is uniform in [delay, delay + jitter], so messages may overtake each other."""
    loss: float = field(default=0.0, validator=_SHARE)
    """Probability that a receiver loses a message."""
    duplication: float = field(default=0.0, validator=_SHARE)
    """Probability that a receiver receives a message twice."""
    lease_s: float = field(default=0.5, validator=_TIME)
    """Time after which the tokens of a paused node vanish."""
    compute_s: float = field(default=0.05, validator=_TIME)
    """Minimum virtual duration of a computation."""
    compute_jitter_s: float = field(default=0.0, validator=_TIME)
    """The duration is uniform in [compute, compute + jitter]."""
    compute_failure: float = field(default=0.0, validator=_SHARE)
    """Probability that a computation fails."""


@frozen
class Clock:
    """A machine's clock, which reads `offset_s + rate * t` at virtual time t."""

    offset_s: float = field(validator=and_(gt(-math.inf), lt(math.inf)))
    rate: float = field(validator=and_(gt(0.0), lt(math.inf)))

    def local_s(self, virtual_s: float) -> float:
        """Return the reading of the clock at a virtual time."""
        return self.offset_s + self.rate * virtual_s

    def virtual_s(self, local_s: float) -> float:
        """Return the first virtual time, up to rounding, at which the clock reads `local_s`."""
        virtual_s = (local_s - self.offset_s) / self.rate
        # Round up: a wakeup must not be early on the node's clock.
        step_s = math.ulp(virtual_s)
        while self.local_s(virtual_s) < local_s:
            virtual_s += step_s
            step_s *= 2.0
        return virtual_s


class Simulation:
    """Virtual clock, queue of future events, and random generator."""

    def __init__(self, seed: int, conditions: Conditions | None) -> None:
        """Start at time 0 with an empty queue."""
        self.now_s = 0.0
        self.conditions = conditions or Conditions()
        """May be replaced at any time, without effect on messages in transit."""
        self.trace: Trace | None = None
        """Called with every input of every node; None: no trace."""
        self.dropped = 0
        """Number of lost messages, counted per receiver."""
        self.delivered = 0
        """Number of deliveries to nodes."""
        self.failed_jobs: list[tuple[float, str, str]] = []
        """Time, node and error of each computation that failed by itself, not by injection."""
        self.random = random.Random(seed)  # noqa: S311 (simulation, not secrets)
        self.queue: list[tuple[float, int, Action, tuple[Any, ...]]] = []
        """(time, tie-breaker, action, arguments) of each future event."""
        self.order = count()

    def at(self, time_s: float, action: Action, *arguments: object) -> None:
        """Schedule an action at a virtual time, or now if the time has passed."""
        at_s = max(time_s, self.now_s)
        heapq.heappush(self.queue, (at_s, next(self.order), action, arguments))

    def step(self) -> bool:
        """Process the next event; return whether there was one."""
        if not self.queue:
            return False
        self.now_s, _, action, arguments = heapq.heappop(self.queue)
        action(*arguments)
        return True

    def run(self, until_s: float, stop: Callable[[], bool] | None = None) -> None:
        """Process events up to a virtual time, or until `stop` returns True."""
        queue = self.queue
        while queue and queue[0][0] <= until_s:
            if stop is not None and stop():
                return
            self.now_s, _, action, arguments = heapq.heappop(queue)
            action(*arguments)
        if stop is None or not stop():
            self.now_s = max(self.now_s, until_s)

    def delay_s(self) -> float:
        """Draw the transit time of a message."""
        return self.conditions.delay_s + self.conditions.jitter_s * self.random.random()


class TraceDigest:
    """A trace that computes a hash of all inputs of all nodes, to compare two runs.

    Results of computations, which may be any object, are omitted; later messages reveal them.
    """

    def __init__(self) -> None:
        """Start with an empty trace."""
        self.events = 0
        self._hash = blake2b(digest_size=16)

    def __call__(self, now_s: float, name: str, item: Item) -> None:
        """Add one event."""
        self.events += 1
        about: tuple[object, ...] = ()
        payload = b""
        match item:
            case Received(key, payload):
                about = (key,)
            case TokenUp(key) | TokenDown(key):
                about = (key,)
            case Query(key, payload, token):
                about = (key, token)
            case Computed(job, _, error):
                about = (job, error)
            case _:
                pass
        # The length separates the payload from what follows it.
        line = repr((now_s, name, type(item).__name__, *about, len(payload)))
        self._hash.update(line.encode())
        self._hash.update(payload)

    def hexdigest(self) -> str:
        """Return the digest of all events so far: 32 hexadecimal digits."""
        return self._hash.hexdigest()
