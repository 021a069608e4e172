"""Lanes of a road: where each is open.

A lane consists of one or more *stretches*, which are open without interruption. Lane 0 is the
rightmost; positions are distances from the start of the road. A stretch ends at an exit, by which
vehicles leave the road, or as a dead end, which they must have left before.
"""

from __future__ import annotations

import math

from attrs import frozen


@frozen
class LaneStretch:
    """A part of a lane that is open from one position to another [m]."""

    lane: int
    from_m: float = -math.inf
    """Where the stretch begins; -inf: before the start of the road."""
    to_m: float = math.inf
    exit: str = ""
    """Name of the exit at its end; empty: a dead end."""


def straight_lanes(lanes: int, length_m: float) -> tuple[LaneStretch, ...]:
    """Return one stretch for each lane, with an exit of its own at the end of the road."""
    return tuple(LaneStretch(lane, to_m=length_m, exit=f"lane-{lane}") for lane in range(lanes))
