"""The lanes of a road, divided into parts for the formats of maps."""

from __future__ import annotations

from itertools import pairwise

from attrs import frozen

from laneweave.protocol.scenario.fields import Scenario


@frozen
class RoadPart:
    """A part of an open lane along which its neighbours, and the lines beside it, are the same."""

    number: int
    """Number of the part, from 1."""
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
    changes_m = {at_m for one in sections for at_m in (one.from_m, one.moves_from_m, one.to_m)}
    changes_m |= {at_m for one in lines for at_m in (one.from_m, one.to_m)}
    inner_m = sorted(at_m for at_m in changes_m if 0.0 < at_m < end_m)
    bounds_m = [*pairwise([0.0, *inner_m, end_m])]
    opened = {
        (place, one.lane): one
        for place, (from_m, to_m) in enumerate(bounds_m)
        for one in sorted(sections, key=lambda section: section.lane)
        if one.from_m <= from_m and to_m <= one.to_m
    }
    numbers = {key: number for number, key in enumerate(opened, start=1)}

    def beside(place: int, lane: int, side: int) -> int | None:
        other, from_m = opened.get((place, lane + side)), bounds_m[place][0]
        if other is None or from_m < max(other.moves_from_m, opened[place, lane].moves_from_m):
            return None
        return numbers[place, lane + side]

    def may_cross(place: int, lane: int, side: int) -> bool:
        from_m, change = bounds_m[place][0], (lane, lane + side)
        forbidden = any(change in one.changes and one.from_m <= from_m < one.to_m for one in lines)
        return beside(place, lane, side) is not None and not forbidden

    return tuple(
        RoadPart(
            number=number,
            lane=lane,
            from_m=bounds_m[place][0],
            to_m=bounds_m[place][1],
            behind=numbers.get((place - 1, lane)),
            beside=(beside(place, lane, -1), beside(place, lane, 1)),
            may_cross=(may_cross(place, lane, -1), may_cross(place, lane, 1)),
        )
        for (place, lane), number in numbers.items()
    )
