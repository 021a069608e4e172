"""Bursts of losses: the Gilbert-Elliott model in continuous time."""

from __future__ import annotations

import math
import random
from collections.abc import Hashable

MAX_LINKS = 20_000
"""Maximum number of links with a stored state; beyond it, that of the least recently used one is
dropped."""


class BurstLosses:
    """Links that change between a good state and a bad one, in which they lose every message.

    Each link is a Markov chain in continuous time (E. N. Gilbert, "Capacity of a Burst-Noise
    Channel", Bell System Technical Journal 39(5), 1960). With the share b of time in the bad state
    and its mean duration T, the probability of the bad state a time t after a known state is
    b + (s - b) exp(-t / ((1 - b) T)), where s is 1 after the bad state and 0 after the good one.
    """

    def __init__(self, share: float, duration_s: float, generator: random.Random) -> None:
        """Begin with unknown states.

        Args:
            share: share of time in the bad state, less than 1.
            duration_s: mean duration of the bad state.
            generator: source of the draws.
        """
        self._share = share
        self._time_s = (1.0 - share) * duration_s
        self._draw = generator.random
        self._states: dict[Hashable, tuple[bool, float]] = {}
        """Whether each link was bad, and when; the link used last at the end."""

    def is_bad(self, link: Hashable, now_s: float) -> bool:
        """Return whether a link is in the bad state now; `now_s` must not decrease for a link."""
        if not self._share:
            return False
        chance = self._share
        known = self._states.pop(link, None)
        if known is not None:
            was_bad, at_s = known
            chance += (was_bad - chance) * math.exp(-max(now_s - at_s, 0.0) / self._time_s)
        elif len(self._states) >= MAX_LINKS:
            del self._states[next(iter(self._states))]
        bad = self._draw() < chance
        self._states[link] = bad, now_s
        return bad
