"""Lanes of a road: where each is open.

A lane consists of one or more *sections*, which are open without interruption. Lane 0 is the
rightmost; positions are distances from the start of the road. A section ends at an exit, by which
vehicles leave the road, or as a dead end: vehicles must change lanes before it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence

from attrs import frozen

ANY_LANE = -1
"""Preferred lane of vehicles that may leave the road in every lane that reaches its end."""
ClosedPart = tuple[int, float, float]
"""(lane, from, to) [m] of a closed part of a lane."""


@frozen
class LaneSection:
    """A part of a lane that is open from one position to another [m]."""

    lane: int
    from_m: float = -math.inf
    """Where the section begins; -inf: before the start of the road."""
    to_m: float = math.inf
    exit: str = ""
    """Name of the exit at its end; empty: a dead end."""


def open_sections(
    lanes: int, length_m: float, closed: Collection[ClosedPart] = ()
) -> tuple[LaneSection, ...]:
    """Return the sections of all lanes, by lane and position; each lane has its own exit.

    Args:
        lanes: number of lanes.
        length_m: end of the road.
        closed: closed parts; those of one lane do not overlap.
    """
    return tuple(
        section for lane in range(lanes) for section in _sections_of(lane, length_m, closed)
    )


def _sections_of(
    lane: int, length_m: float, closed: Collection[ClosedPart]
) -> Iterator[LaneSection]:
    from_m = -math.inf
    for closed_lane, closed_m, open_m in sorted(closed):
        if closed_lane == lane:
            yield LaneSection(lane, from_m, closed_m)
            from_m = open_m
    if from_m < length_m:
        yield LaneSection(lane, from_m, length_m, exit=f"lane-{lane}")


def sections_for(sections: Sequence[LaneSection], preferred_lane: int) -> frozenset[int]:
    """Return the numbers of the sections by whose ends a vehicle may leave the road."""
    return frozenset(
        number
        for number, section in enumerate(sections)
        if section.exit and preferred_lane in (section.lane, ANY_LANE)
    )
