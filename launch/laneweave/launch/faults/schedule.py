"""Schedule of the kills and pauses of a fault specification.

Each fault has separate random generators, so that adding a fault does not change the times of
the others.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterator
from itertools import count, islice
from operator import attrgetter

from attrs import field, frozen

from laneweave.launch.faults.fault_file import FaultSpec, Kill, Pause, RoleFault


@frozen
class FaultEvent:
    """One kill or pause of one role."""

    fault_name: str
    """Name of the fault in the file, such as `kill[0]`."""
    fault: RoleFault
    due_s: float
    """Road time at which it is due."""
    draw: random.Random = field(eq=False, repr=False)
    """Generator for choosing among several targets."""
    for_s: float | None = None
    """Length of a pause in wall-clock seconds."""
    restart_after_s: float | None = None
    """Wall-clock seconds between a kill and the restart; None: no restart."""
    repetition: int = 0
    """Number of the repetition, in which each coordinator is chosen at most once."""


class FaultSchedule:
    """All fault events of a run in chronological order; there may be infinitely many."""

    def __init__(self, specification: FaultSpec, seed: int) -> None:
        """Draw the events with the seed of the specification, or with `seed` if it has none."""
        seed = specification.seed_of_run(seed)
        self._specification = specification
        self._reached_s = 0.0
        self._skipped: dict[str, float] = {}
        """Faults of which events were dropped, and the road time then."""
        self._coming = heapq.merge(
            *(_events(seed, name, fault) for name, fault in specification.role_faults()),
            key=attrgetter("due_s"),
        )
        self._next = next(self._coming, None)

    def due(self, road_s: float) -> Iterator[FaultEvent]:
        """Yield the events that have become due since the last call."""
        self._reached_s = max(self._reached_s, road_s)
        while self._next is not None and self._next.due_s <= road_s:
            yield self._next
            self._next = next(self._coming, None)

    def skip(self, road_s: float) -> None:
        """Drop the events that were due before a road time."""
        while self._next is not None and self._next.due_s < road_s:
            self._skipped[self._next.fault_name] = road_s
            self._next = next(self._coming, None)

    @property
    def is_empty(self) -> bool:
        """Whether no events are left."""
        return self._next is None

    def unused_faults(self, applied: set[str]) -> list[str]:
        """Return a line for each fault that had no effect during the run.

        `applied` contains the names of the faults with at least one applied event.
        """
        lines = [
            f"{name}: {fault.target} was not {fault.verb} at {fault.from_s:g} s: the road was at "
            f"{self._skipped[name]:.1f} s already"
            if name in self._skipped
            else f"{name}: the run ended before {fault.target} was {fault.verb} "
            f"at {fault.from_s:g} s"
            for name, fault in self._specification.role_faults()
            if name not in applied
        ]
        lines += [
            f"{name}: the run ended before it came into force at {window.from_s:g} s"
            for name, window in self._specification.windows()
            if window.from_s > self._reached_s
        ]
        return lines


def _events(seed: int, name: str, fault: RoleFault) -> Iterator[FaultEvent]:
    """Yield the events of a fault in chronological order."""
    for number, due_s in enumerate(_times(seed, name, fault)):
        draw = random.Random(f"{seed}/{name}/{number}")  # noqa: S311 (no secrets)
        for_s = restart_after_s = None
        if isinstance(fault, Pause):
            for_s = draw.uniform(*fault.for_s) if isinstance(fault.for_s, tuple) else fault.for_s
        elif isinstance(fault, Kill):
            # Distribute restarts evenly, so that the share is right after any number of kills.
            before, after = (int(fault.restart_share * (number + n) + 1e-9) for n in (0, 1))
            if after > before:
                restart_after_s = fault.restart_after_s
        repetition = number // fault.count
        yield FaultEvent(name, fault, due_s, draw, for_s, restart_after_s, repetition)


def _times(seed: int, name: str, fault: RoleFault) -> Iterator[float]:
    """Yield the times of a fault in ascending order, repeating each one for every target."""
    if fault.between_s is not None:
        draw = random.Random(f"{seed}/{name}")  # noqa: S311 (no secrets)
        drawn = fault.count * (fault.times or 1)
        yield from sorted(draw.uniform(*fault.between_s) for _ in range(drawn))
        return
    repeats = islice(count(), 1 if fault.every_s is None else fault.times)
    for repeat in repeats:
        yield from [fault.from_s + repeat * (fault.every_s or 0.0)] * fault.count
