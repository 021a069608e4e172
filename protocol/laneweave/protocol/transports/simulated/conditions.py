"""How a simulated network and its machines behave: delays, losses, clocks, computations."""

from __future__ import annotations

import math

from attrs import field, frozen
from attrs.validators import and_, ge, gt, le, lt

_SHARE = and_(ge(0.0), le(1.0))
_TIME = and_(ge(0.0), lt(math.inf))


@frozen
class Conditions:
    """How the network treats messages, and how long computations take."""

    delay_s: float = field(default=0.002, validator=_TIME)
    jitter_s: float = field(default=0.003, validator=_TIME)
    """Delay is drawn uniformly from [delay, delay + jitter]: messages overtake each other."""
    loss: float = field(default=0.0, validator=_SHARE)
    """Probability that a message does not reach a receiver."""
    duplication: float = field(default=0.0, validator=_SHARE)
    """Probability that a receiver gets a message twice."""
    lease_s: float = field(default=0.5, validator=_TIME)
    """A paused node is given up after this time."""
    compute_s: float = field(default=0.05, validator=_TIME)
    """Least virtual time that a computation takes."""
    compute_jitter_s: float = field(default=0.0, validator=_TIME)
    """Its time is drawn uniformly from [compute, compute + jitter]."""
    compute_failure: float = field(default=0.0, validator=_SHARE)
    """Probability that a computation fails instead of being done."""


@frozen
class Clock:
    """A machine's clock: it shows `offset + rate * t` at virtual time t."""

    offset_s: float = field(default=0.0, validator=and_(gt(-math.inf), lt(math.inf)))
    rate: float = field(default=1.0, validator=and_(gt(0.0), lt(math.inf)))

    def local_s(self, virtual_s: float) -> float:
        """Return what the clock shows at a virtual time."""
        return self.offset_s + self.rate * virtual_s

    def virtual_s(self, local_s: float) -> float:
        """Return a virtual time at which the clock shows `local_s` or hardly more."""
        virtual_s = (local_s - self.offset_s) / self.rate
        # Never before: who is woken by it must not find that it is too early by a rounding error.
        step_s = math.ulp(virtual_s)
        while self.local_s(virtual_s) < local_s:
            virtual_s += step_s
            step_s *= 2.0
        return virtual_s
