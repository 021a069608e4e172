"""Lanes of a road: where each is open.

A lane consists of one or more *sections*, which are open without interruption. Lane 0 is the
rightmost; positions are distances from the start of the road. A section ends at an exit, by which
vehicles leave the road, or as a dead end: vehicles must change lanes before it.
"""

from __future__ import annotations

import math

from attrs import frozen


@frozen
class LaneSection:
    """A part of a lane that is open from one position to another [m]."""

    lane: int
    from_m: float = -math.inf
    """Where the section begins; -inf: before the start of the road."""
    to_m: float = math.inf
    exit: str = ""
    """Name of the exit at its end; empty: a dead end."""


def straight_lanes(lanes: int, length_m: float) -> tuple[LaneSection, ...]:
    """Return one section for each lane over the whole road, each with its own exit."""
    return tuple(LaneSection(lane, to_m=length_m, exit=f"lane-{lane}") for lane in range(lanes))
