"""Parts of lanes that were closed for a time in a recorded run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from attrs import define, field, frozen

from laneweave.launch.recordings.events import Event, read_events
from laneweave.launch.recordings.files import EVENTS_FILE, reading
from laneweave.protocol.wire.events import PART_CLOSED, PART_OPENED
from laneweave.protocol.wire.obstacle_messages import PASSING


@define
class RecordedClosure:
    """A part of a lane that was closed for a time, or a vehicle of another system there."""

    first: Event
    """The event `part-closed` with which it began."""
    newest: Event
    """The newest event of the part; its `to_m` replaces that of `first`."""
    until_s: float = math.inf
    """Infinite: it was not opened again."""

    @property
    def since_s(self) -> float:
        """Road time at which it was closed."""
        return float(self.first["t_s"])

    def meets(self, since_s: float, until_s: float) -> bool:
        """Return whether it was closed at some time from one road time to another."""
        return self.since_s <= until_s and since_s <= self.until_s


@define
class RecordedClosures:
    """All parts of a run, in the order in which they began."""

    parts: list[RecordedClosure] = field(factory=list)

    @property
    def active(self) -> Iterator[RecordedClosure]:
        """Those that are closed when the events end."""
        return (one for one in self.parts if math.isinf(one.until_s))

    def add(self, event: Event) -> bool:
        """Add an event `part-closed` or `part-opened`; return whether a part begins or ends."""
        known = next((one for one in self.active if _key(one.first) == _key(event)), None)
        opens: bool = event["kind"] == PART_OPENED
        if known is not None:
            known.newest = event
            if opens:
                known.until_s = float(event["t_s"])
            return opens
        if not opens:
            self.parts.append(RecordedClosure(event, event))
        return not opens


def _key(event: Event) -> tuple[object, ...]:
    """Return what identifies a part while it is closed."""
    return tuple(event.get(key) for key in ("lane", "cause", "vehicle", "from_m"))


@frozen
class ClosedForATime:
    """A part of a lane that was closed for a time."""

    lane: int
    from_m: float
    to_m: float
    since_s: float
    until_s: float
    """Infinite: it was not opened again."""


def closed_for_a_time(folder: Path) -> list[ClosedForATime]:
    """Return the parts of lanes that were closed for a time, except by vehicles of other systems.

    Raises:
        BadInputError: the events cannot be read.
    """
    closed = RecordedClosures()
    with reading(folder, EVENTS_FILE):
        for event in read_events(folder, PART_CLOSED, PART_OPENED):
            if event.get("cause") != PASSING:
                closed.add(event)
        return [
            ClosedForATime(
                int(one.first["lane"]),
                float(one.first["from_m"]),
                float(one.newest["to_m"]),
                one.since_s,
                one.until_s,
            )
            for one in closed.parts
        ]
