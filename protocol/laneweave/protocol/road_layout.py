"""Lanes of a road: where each is open.

A lane consists of one or more *sections*, which are open without interruption. Lane 0 is the
rightmost; positions are distances from the start of the road. A section ends at an exit, by which
vehicles leave the road, or as a dead end: vehicles must change lanes before it. Each lane that
reaches the end of the road has its own exit there; other exits have names.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from attrs import evolve, frozen

LONGEST_ROAD_M = 60_000.0
"""Upper bound on positions on the road: the sum of those of its three segments."""
ANY_LANE = -1
"""Preferred lane of vehicles that may leave the road in every lane that reaches its end."""
END_OF_ROAD = "end"
"""Destination of vehicles that leave at the end of the road."""
ClosedPart = tuple[int, float, float]
"""(lane, from, to) [m] of a closed part of a lane."""
LanePosition = tuple[int, float]
"""(lane, position [m])."""
LaneChange = tuple[int, int]
"""(from, to) of neighbouring lanes."""
_NO_EXITS: Mapping[LanePosition, str] = MappingProxyType({})
_NO_RAMPS: Mapping[LanePosition, float] = MappingProxyType({})


class TemporaryClosure(NamedTuple):
    """A part of a lane that is closed for a time."""

    lane: int
    from_m: float
    to_m: float
    late_m: float = 0.0
    """Length of the queue of vehicles that could not stop at the stop line, before the part."""


class ClearedPart(NamedTuple):
    """A part of a lane that vehicles leave, and that none may enter; it may move."""

    lane: int
    from_m: float
    """Where it begins at road time `at_s` [m]."""
    to_m: float
    speed_mps: float = 0.0
    at_s: float = 0.0

    def at(self, t_s: float) -> tuple[float, float]:
        """Return where it begins and ends at a road time [m]."""
        moved_m = self.speed_mps * (t_s - self.at_s)
        return self.from_m + moved_m, self.to_m + moved_m


@frozen
class TemporaryParts:
    """Parts of lanes that are not open as always."""

    closed: tuple[TemporaryClosure, ...] = ()
    """They begin with a dead end: vehicles stop before them."""
    cleared: tuple[ClearedPart, ...] = ()

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self.closed or self.cleared)


NO_PARTS = TemporaryParts()


@frozen
class LaneSection:
    """A part of a lane that is open from one position to another [m]."""

    lane: int
    from_m: float = -math.inf
    """Where the section begins; -inf: before the start of the road."""
    to_m: float = math.inf
    exit: str = ""
    """Name of the exit at its end; empty: a dead end."""
    moves_from_m: float = -math.inf
    """Where moves may begin in the section: before, it is a ramp, separate from the road."""

    def serves(self, preferred_lane: int, destination: str = END_OF_ROAD) -> bool:
        """Return whether a vehicle may leave the road by the end of the section.

        Args:
            preferred_lane: lane in which it wants to leave, or `ANY_LANE`.
            destination: name of the exit, or `END_OF_ROAD`.
        """
        if destination != END_OF_ROAD:
            return self.exit == destination
        return self.exit == end_exit(self.lane) and preferred_lane in (self.lane, ANY_LANE)


def end_exit(lane: int) -> str:
    """Return the name of the exit of a lane at the end of the road."""
    return f"lane-{lane}"


def open_sections(
    lanes: int,
    length_m: float,
    closed: Collection[ClosedPart] = (),
    exits: Mapping[LanePosition, str] = _NO_EXITS,
    ramps: Mapping[LanePosition, float] = _NO_RAMPS,
) -> tuple[LaneSection, ...]:
    """Return the sections of all lanes, by lane and position.

    Each lane that reaches the end of the road has its own exit there.

    Args:
        lanes: number of lanes.
        length_m: end of the road.
        closed: closed parts; those of one lane do not overlap.
        exits: names of exits by the ends of sections.
        ramps: where ramps join the road [m], by their beginnings.
    """
    return tuple(
        section
        for lane in range(lanes)
        for section in _sections_of(lane, length_m, closed, exits, ramps)
    )


def _sections_of(
    lane: int,
    length_m: float,
    closed: Collection[ClosedPart],
    exits: Mapping[LanePosition, str],
    ramps: Mapping[LanePosition, float],
) -> Iterator[LaneSection]:
    from_m = -math.inf

    def section(to_m: float, name: str) -> LaneSection:
        return LaneSection(lane, from_m, to_m, name, ramps.get((lane, from_m), -math.inf))

    for closed_lane, closed_m, open_m in sorted(closed):
        if closed_lane == lane:
            if closed_m > 0.0:
                yield section(closed_m, exits.get((lane, closed_m), ""))
            from_m = open_m
    if from_m < length_m:
        yield section(length_m, end_exit(lane))


def cut(
    sections: Sequence[LaneSection], closed: Iterable[TemporaryClosure]
) -> tuple[LaneSection, ...]:
    """Return the sections of a road of which parts are closed for a time.

    The last piece of a section keeps its number and its exit, since vehicles leave by numbers; a
    piece before a closed part is a dead end, and is appended. Other parts are ignored.
    """
    pieces = list(sections)
    for lane, from_m, to_m, _ in sorted(closed):
        for number, section in enumerate(tuple(pieces)):
            inside = section.from_m < to_m < section.to_m and from_m < to_m
            if section.lane != lane or not inside:
                continue
            if from_m > section.from_m:
                pieces.append(evolve(section, to_m=from_m, exit=""))
            pieces[number] = evolve(section, from_m=to_m)
    return tuple(pieces)


def sections_for(
    sections: Sequence[LaneSection], preferred_lane: int, destination: str = END_OF_ROAD
) -> frozenset[int]:
    """Return the numbers of the sections that serve a vehicle (`LaneSection.serves`)."""
    return frozenset(
        number
        for number, section in enumerate(sections)
        if section.serves(preferred_lane, destination)
    )


class Exits:
    """The exits of a road: which vehicles have left it."""

    def __init__(self, sections: Sequence[LaneSection], length_m: float) -> None:
        """Read the sections of a road of this length."""
        lanes = 1 + max(section.lane for section in sections)
        self._by_lane = tuple(
            tuple(section for section in sections if section.lane == lane) for lane in range(lanes)
        )
        self._length_m = length_m
        self._first_m = min(section.to_m for section in sections if section.exit)
        """Position before which no vehicle has left."""

    def left_by(self, lane: int, s_m: float) -> LaneSection | None:
        """Return the section by whose end a vehicle has left the road; None: it is on the road.

        Args:
            lane: the lane in which the centre of its body is.
            s_m: position of its front.
        """
        if s_m < self._first_m:
            return None
        found = self.section_at(lane, s_m)
        if found is not None and found.exit and s_m >= found.to_m:
            return found
        return None if s_m < self._length_m else LaneSection(lane, to_m=self._length_m)

    def section_at(self, lane: int, s_m: float) -> LaneSection | None:
        """Return the section in which a position is, or which it has passed; None: there is none.

        Arguments as those of `left_by`.
        """
        found = None
        for section in self._by_lane[lane] if 0 <= lane < len(self._by_lane) else ():
            if section.from_m <= s_m:
                found = section
        return found
