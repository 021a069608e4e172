"""The end of a lane; see `lane_ends`."""

from __future__ import annotations

import math

from attrs import frozen


@frozen
class LaneEnd:
    """The end of a section of a lane before the end of the road: a dead end or an exit."""

    lane: int
    from_m: float
    """Where the section begins; -inf: before the start of the road."""
    line_m: float
    """Dead end: the stop line. Exit: where lane changes into and out of the section have ended."""
    stop_m: float
    """Dead end: where vehicles stop. Exit: where bodies stop that are partly in its lane. It is the
    line, or the end of an exit, but for sections that are `taken_back`."""
    end_m: float
    """Where the lane ends; at an exit, where vehicles leave the road."""
    reopens_m: float
    """Where the lane is open again; inf: nowhere."""
    moves_from_m: float = -math.inf
    """Where moves may begin in the section; -inf: everywhere."""
    taken_back: bool = False
    """Whether SUMO takes back vehicles that do not change lanes; there is no re-entry."""
    sudden: bool = False
    """Whether it is the beginning of a part that is closed for a time."""
