"""When each kill and pause of a faults file is due: times drawn from the seed.

Every strike draws from generators of its own, so that a fault that is added to a file leaves the
times of the others as they are.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterator
from itertools import count, islice
from operator import attrgetter

from attrs import field, frozen

from laneweave.launch.faults.specification import Faults, Kill, Pause, Strike


@frozen
class Blow:
    """One process that is to be struck once."""

    strike_name: str
    """Its strike's name in the file, such as `kill[0]`."""
    strike: Strike
    due_s: float
    """Road time."""
    draw: random.Random = field(eq=False, repr=False)
    """For the choice among several targets."""
    for_s: float | None = None
    """A pause: how long, in wall-clock seconds."""
    restart_after_s: float | None = None
    """A kill: after how many wall-clock seconds the process is started again; none: never."""

    @property
    def verb(self) -> str:
        """What happens to the target."""
        return "paused" if isinstance(self.strike, Pause) else "killed"


class FaultSchedule:
    """All blows of a run, in the order of their times; some strikes never end."""

    def __init__(self, faults: Faults, seed: int) -> None:
        """Draw; `seed` counts where the faults bring none of their own."""
        seed = seed if faults.seed is None else faults.seed
        self._strikes = dict(faults.strikes())
        self._windows = tuple(faults.windows())
        self._reached_s = 0.0
        self._coming = heapq.merge(
            *(_blows(seed, name, strike) for name, strike in self._strikes.items()),
            key=attrgetter("due_s"),
        )
        self._next = next(self._coming, None)

    def due(self, road_s: float) -> Iterator[Blow]:
        """Yield the blows that have become due since the last call."""
        self._reached_s = max(self._reached_s, road_s)
        while self._next is not None and self._next.due_s <= road_s:
            yield self._next
            self._next = next(self._coming, None)

    def never_happened(self, struck: set[str]) -> list[str]:
        """Return a line for each fault of which nothing has happened when a run has ended.

        `struck` names the strikes of which at least one blow has found its target.
        """
        lines = []
        for name, strike in self._strikes.items():
            if name not in struck:
                verb = "killed" if isinstance(strike, Kill) else "paused"
                lines.append(
                    f"the run ended before {strike.target} was {verb} at {strike.from_s:g} s"
                )
        lines += [
            f"the run ended before {name} came into force at {from_s:g} s"
            for name, from_s in self._windows
            if from_s > self._reached_s
        ]
        return lines


def _blows(seed: int, name: str, strike: Strike) -> Iterator[Blow]:
    """Yield the blows of one strike by time."""
    for number, due_s in enumerate(_times(seed, name, strike)):
        draw = random.Random(f"{seed}/{name}/{number}")  # noqa: S311 (no secrets)
        for_s = restart_after_s = None
        if isinstance(strike, Pause):
            span = strike.for_s
            for_s = draw.uniform(*span) if isinstance(span, tuple) else span
        elif isinstance(strike, Kill):
            # Evenly spread, so that the share holds however many there are in the end.
            before, after = (int(strike.restart_share * (number + n) + 1e-9) for n in (0, 1))
            if after > before:
                restart_after_s = strike.restart_after_s
        yield Blow(name, strike, due_s, draw, for_s, restart_after_s)


def _times(seed: int, name: str, strike: Strike) -> Iterator[float]:
    """Yield a strike's times in order, each as often as it has targets."""
    if strike.between_s is not None:
        draw = random.Random(f"{seed}/{name}")  # noqa: S311 (no secrets)
        drawn = strike.count * (strike.times or 1)
        yield from sorted(draw.uniform(*strike.between_s) for _ in range(drawn))
        return
    first_s = strike.from_s
    if strike.every_s is None:
        repeats: Iterator[int] = iter((0,))
    else:
        repeats = islice(count(), strike.times)
    for repeat in repeats:
        yield from [first_s + repeat * (strike.every_s or 0.0)] * strike.count
