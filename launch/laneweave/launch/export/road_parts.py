"""The lanes of a road in parts, as formats for maps need them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

from attrs import frozen

from laneweave.protocol.road_layout import LaneSection
from laneweave.protocol.scenario.fields import Scenario


@frozen
class RoadPart:
    """A part of an open lane along which its neighbours, and the lines beside it, are the same."""

    number: int
    lane: int
    from_m: float
    to_m: float
    behind: int | None
    """Number of the part that leads to it; None: the lane begins."""
    beside: tuple[int | None, int | None]
    """Numbers of the parts to its right and to its left; None: there is no lane, or one of both is
    a ramp that has not joined the road yet."""
    may_cross: tuple[bool, bool]
    """Whether vehicles of all types may cross the line to the right, and to the left; restrictions
    of lanes do not count."""


def road_parts(scenario: Scenario) -> tuple[RoadPart, ...]:
    """Return the parts of all lanes, in the direction of travel, those of the right lane first.

    Parts that are closed for a time count as open.
    """
    sections, end_m = scenario.geometry.sections, scenario.road.length_m
    lines = scenario.road.solid_lines
    inner_m = {
        at_m
        for one in sections
        for at_m in (one.from_m, one.moves_from_m, one.to_m)
        if 0.0 < at_m < end_m
    } | {at_m for one in lines for at_m in (one.from_m, one.to_m) if 0.0 < at_m < end_m}
    bounds_m = [*pairwise([0.0, *sorted(inner_m), end_m])]
    opened = {
        (place, one.lane): one
        for place, (from_m, to_m) in enumerate(bounds_m)
        for one in sorted(sections, key=lambda section: section.lane)
        if one.from_m <= from_m and to_m <= one.to_m
    }
    numbers = {key: number for number, key in enumerate(opened)}

    def parts() -> Iterator[RoadPart]:
        for (place, lane), section in opened.items():
            from_m, to_m = bounds_m[place]
            beside, may_cross = list[int | None](), list[bool]()
            for side in (-1, 1):
                other = opened.get((place, lane + side))
                separate = other is None or _is_ramp(section, from_m) or _is_ramp(other, from_m)
                beside.append(None if separate else numbers[place, lane + side])
                forbidden = any(
                    one.lane == lane
                    and (one.to == "left") == (side == 1)
                    and one.from_m <= from_m < one.to_m
                    for one in lines
                )
                may_cross.append(not separate and not forbidden)
            yield RoadPart(
                number=numbers[place, lane],
                lane=lane,
                from_m=from_m,
                to_m=to_m,
                behind=numbers.get((place - 1, lane)),
                beside=(beside[0], beside[1]),
                may_cross=(may_cross[0], may_cross[1]),
            )

    return tuple(parts())


def _is_ramp(section: LaneSection, s_m: float) -> bool:
    return s_m < section.moves_from_m
