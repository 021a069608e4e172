"""Parts of lanes that were closed for a time in a recorded run."""

from __future__ import annotations

import math
from pathlib import Path

from attrs import frozen

from laneweave.launch.recordings.formations import read_events
from laneweave.protocol.wire.events import PART_CLOSED, PART_OPENED
from laneweave.protocol.wire.obstacle_messages import PASSING


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
    """Return the parts of lanes that were closed for a time, but for those that moved.

    Raises:
        OSError, ValueError, KeyError, TypeError: the events cannot be read.
    """
    found: dict[tuple[int, float], ClosedForATime] = {}
    ended: list[ClosedForATime] = []
    for event in read_events(folder, PART_CLOSED, PART_OPENED):
        if event.get("cause") == PASSING:
            continue
        at, t_s = (int(event["lane"]), float(event["from_m"])), float(event["t_s"])
        before = found.pop(at, None)
        since_s = t_s if before is None else before.since_s
        until_s = t_s if event["kind"] == PART_OPENED else math.inf
        one = ClosedForATime(*at, float(event["to_m"]), since_s, until_s)
        if math.isinf(until_s):
            found[at] = one
        else:
            ended.append(one)
    return [*ended, *found.values()]
