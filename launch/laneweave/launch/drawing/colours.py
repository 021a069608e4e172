"""Colours and names of lanes: the same in pictures, in reports and on the live page."""

from __future__ import annotations

_THREE_LANES = ("#2f6fc4", "#3f9b4f", "#cf3f3a")
"""Right to left: blue, green, red, the paper's colours."""
_MORE_LANES = (
    "#2f6fc4",
    "#e08b27",
    "#3f9b4f",
    "#8a5bb5",
    "#cf3f3a",
    "#7a5c4d",
    "#d46fae",
    "#808080",
)
SPEED_SPAN_MPS = 5.0
"""Speeds this far below or above the lattice's have the darkest and lightest shade."""
SHADE_STRENGTH = 0.45


def lane_colours(lanes: int) -> tuple[str, ...]:
    """Return one colour for each lane, from the right."""
    if lanes <= 3:
        return _THREE_LANES[:1] + _THREE_LANES[3 - lanes + 1 :]
    return tuple(_MORE_LANES[lane % len(_MORE_LANES)] for lane in range(lanes))


def lane_names(lanes: int) -> tuple[str, ...]:
    """Return what people call the lanes, from the right."""
    if lanes == 1:
        return ("the lane",)
    if lanes == 2:
        return ("right", "left")
    if lanes == 3:
        return ("right", "middle", "left")
    return tuple(f"lane {lane}" for lane in range(lanes))
