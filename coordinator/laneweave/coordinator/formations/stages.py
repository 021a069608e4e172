"""Stages of a road for formations: where lanes change, and which lanes vehicles need.

Before S3, the structures of the scenario are the stages (paper, Section 2.2). From the start of S3
on, a stage ends wherever lanes end, begin or leave the road. On a road whose lanes are the same
from end to end there is one such stage, lane sorting (paper, Section 5.2.1).

Before the end of a stage, each vehicle should be in one of its goal lanes: those that lead to its
destination. If none of them is open yet, it needs the nearest lane that goes on behind the stage.

Parts of lanes that are closed for a time add stages in which vehicles leave these lanes
(docs/adr/0065), and so do fast vehicles that overtake a formation (docs/adr/0064).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import pairwise
from operator import itemgetter
from typing import NamedTuple

from attrs import evolve, field, frozen

from laneweave.protocol.road_layout import (
    ANY_LANE,
    END_OF_ROAD,
    ClearedPart,
    LaneSection,
    TemporaryClosure,
    cut,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import DrivingStructure
from laneweave.protocol.vehicle.lane_ends import sections_to_lines, stop_line_m
from laneweave.protocol.wire.messages import Census, OffLattice

SORTING_M = 300.0
"""Length of road behind the line of a closed part in which a formation can sort its lanes."""
QUEUE_M = 10.0
"""Queue lengths at stop lines are rounded up to multiples of this."""
MAX_OVERTAKING_S = 25.0
"""Maximum time for which a formation leaves a lane to others; slower ones drive behind it."""
MAX_GOALS = 256
"""Maximum number of pairs of a lane and a destination whose goal lanes a stage keeps."""
LEFT_M = 1.0
"""Length of a lane that is left behind the last part that a formation leaves to others, and minimum
length of such a part."""


class Overtaking(NamedTuple):
    """Where a faster vehicle of another system overtakes a formation, which leaves its lane."""

    lane: int
    from_m: float
    """Where the front of the formation is at `until_s`."""
    to_m: float
    """Where the rear of the formation is when the vehicle has passed its front."""
    until_s: float
    """Road time by which all members have left the lane."""

    @property
    def closure(self) -> TemporaryClosure:
        """The part of the lane that the formation does not use."""
        return TemporaryClosure(self.lane, self.from_m, self.to_m)


@frozen
class Stage:
    """A part of the road in which a formation forms a structure or sorts its lanes."""

    from_m: float
    """A formation begins once its rear has passed this position."""
    to_m: float
    """Where the plan should be complete: in lanes that end there, before each vehicle passes it."""
    structure: DrivingStructure | None = None
    """Structure to form, with any vehicle in any place; None: sort by goal lanes."""
    road: tuple[LaneSection, ...] = ()
    """Sections of the road that do not end before the stage begins."""
    lines_m: tuple[float, ...] = ()
    """Where moves must have ended in each of them."""
    number: int = field(default=0, eq=False)
    """Index among the stages of the road."""
    is_last: bool = field(default=True, eq=False)
    sorted_before: bool = field(default=False, eq=False)
    """Whether lanes are sorted in an earlier stage."""
    avoids: bool = False
    """Whether any lane that goes on will do, since vehicles sort in a later stage."""
    until_s: float = math.inf
    """Road time by which moves must have ended, since a vehicle overtakes the formation then."""

    @cached_property
    def open_sections(self) -> list[tuple[LaneSection, float]]:
        """Sections in which vehicles may move throughout the stage, with their lines."""
        return [
            (section, line_m)
            for section, line_m in zip(self.road, self.lines_m, strict=True)
            if max(section.from_m, section.moves_from_m) <= self.from_m and self.to_m <= line_m
        ]

    @cached_property
    def lanes(self) -> frozenset[int]:
        """Lanes whose cells plans may use."""
        return frozenset(section.lane for section, _ in self.open_sections)

    @cached_property
    def through_lanes(self) -> frozenset[int]:
        """Open lanes that continue beyond the stage; all open lanes, if none does."""
        through = {one.lane for one, line_m in self.open_sections if line_m > self.to_m}
        return frozenset(through) or self.lanes

    @property
    def ending_lanes(self) -> frozenset[int]:
        """Open lanes that end with the stage while others continue."""
        return self.lanes - self.through_lanes

    def needs_same_moves(self, other: Stage) -> bool:
        """Return whether both stages leave a formation the same lanes, and the same time."""
        return self._open_until == other._open_until

    @property
    def _open_until(self) -> tuple[object, ...]:
        return self.to_m, self.is_last, self.structure, self.lanes, self.through_lanes

    @cached_property
    def _goals(self) -> dict[tuple[int, str], frozenset[int]]:
        """Goal lanes that have been determined, by preferred lane and destination."""
        return {}

    def goal_lanes(self, preferred_lane: int, destination: str = END_OF_ROAD) -> frozenset[int]:
        """Return the lanes in one of which a vehicle should be at the end of the stage.

        A vehicle that can no longer change to the lane of its exit drives to the end of the road,
        unless it is in that lane.
        """
        known = self._goals.get((preferred_lane, destination))
        if known is None:
            if len(self._goals) >= MAX_GOALS:
                self._goals.clear()
            known = self._goals[preferred_lane, destination] = self._goal_lanes(
                preferred_lane, destination
            )
        return known

    def _goal_lanes(self, preferred_lane: int, destination: str) -> frozenset[int]:
        if self.avoids:
            return self.through_lanes
        serving = self._serving(preferred_lane, destination)
        wanted = [one for one, line_m in serving if line_m > self.from_m]
        if not wanted:
            leaving = frozenset(one.lane for one, _ in serving)
            others = self.through_lanes if destination == END_OF_ROAD else self.goal_lanes(ANY_LANE)
            return leaving | others
        here = frozenset(one.lane for one, _ in self.open_sections if one in wanted)
        if here:
            return here
        distance = {
            lane: min(abs(lane - one.lane) for one in wanted) for lane in self.through_lanes
        }
        nearest = min(distance.values())
        return frozenset(lane for lane, lanes in distance.items() if lanes == nearest)

    def is_last_for(self, preferred_lane: int, destination: str = END_OF_ROAD) -> bool:
        """Return whether a vehicle cannot reach its destination in a later stage any more."""
        return all(line_m <= self.to_m for _, line_m in self._serving(preferred_lane, destination))

    def _serving(self, preferred_lane: int, destination: str) -> list[tuple[LaneSection, float]]:
        """Return the sections ahead that lead to a destination, with their lines."""
        return [
            (one, line_m)
            for one, line_m in zip(self.road, self.lines_m, strict=True)
            if one.to_m > self.from_m and one.serves(preferred_lane, destination)
        ]


WHOLE_ROAD = Stage(0.0, math.inf)
"""The stage of a formation for which none has been chosen."""


@lru_cache(maxsize=256)
def stages(
    scenario: Scenario,
    closed: tuple[TemporaryClosure, ...] = (),
    overtaken: tuple[Overtaking, ...] = (),
) -> tuple[Stage, ...]:
    """Return the stages of formations, from the start of the road to its end.

    Before a part that is closed for a time, vehicles change lanes from the start of the road on:
    into any lane that goes on, or, if less than `SORTING_M` is left from there on, to sort.
    Structures are formed only behind all of these parts.

    Args:
        scenario: road, structures.
        closed: parts that are closed for a time (`with_queues`).
        overtaken: where others overtake the formation (`where_overtaken`). It may change lanes up
            to their beginning: no vehicle stops there.
    """
    start_m, road_m = scenario.road.sorting_start_m, scenario.road.length_m
    avoided = (*closed, *(one.closure for one in overtaken))
    until_s = {one.from_m: one.until_s for one in overtaken}
    passed_m = max((one.to_m for one in avoided), default=0.0)
    structures = [one for one in scenario.formation.structures if one.from_m >= passed_m]
    formed_m = pairwise([*(one.from_m for one in structures), start_m])
    sections = cut(scenario.geometry.sections, avoided)
    # Where others overtake, no vehicle stops, but for a closed part in the same place.
    last_m = {(one.lane, one.from_m): _last_m(one, closed, scenario) for one in overtaken}
    lines_m = [
        last_m.get((one.lane, one.to_m), to_line.to_m)
        for one, to_line in zip(sections, sections_to_lines(scenario, avoided), strict=True)
    ]
    parts = [
        *((*each_m, one, False) for each_m, one in zip(formed_m, structures, strict=True)),
        *(
            (from_m, to_m, None, sudden and to_m <= max(start_m, road_m - SORTING_M))
            for from_m, to_m, sudden in _sorting_stages(scenario, avoided, sections, lines_m)
        ),
    ]
    parts.sort(key=itemgetter(0))
    made = list[Stage]()
    for from_m, to_m, structure, avoids in parts:
        # What lies behind a formation does not change its stage.
        ahead = [
            (_begun(one, from_m), line_m)
            for one, line_m in zip(sections, lines_m, strict=True)
            if one.to_m > from_m
        ]
        road, ends_m = zip(*ahead, strict=True)
        ends_s = until_s.get(to_m, math.inf)
        made.append(Stage(from_m, to_m, structure, road, ends_m, avoids=avoids, until_s=ends_s))
    made = [stage for stage in made if stage.lanes]
    first = next(number for number, stage in enumerate(made) if stage.structure is None)
    return tuple(
        evolve(stage, number=number, is_last=number == len(made) - 1, sorted_before=number > first)
        for number, stage in enumerate(made)
    )


def _last_m(
    overtaking: Overtaking, closed: Sequence[TemporaryClosure], scenario: Scenario
) -> float:
    """Return where moves must have ended in a lane in which others overtake."""
    lines_m = (
        stop_line_m(part, scenario)
        for part in closed
        if part.lane == overtaking.lane and overtaking.from_m <= part.from_m <= overtaking.to_m
    )
    return min([overtaking.from_m, *lines_m])


def _begun(section: LaneSection, from_m: float) -> LaneSection:
    begins_m, moves_from_m = max(section.from_m, from_m), max(section.moves_from_m, from_m)
    return evolve(section, from_m=begins_m, moves_from_m=moves_from_m)


def _sorting_stages(
    scenario: Scenario,
    closed: Sequence[TemporaryClosure],
    sections: Sequence[LaneSection],
    lines_m: Sequence[float],
) -> Iterator[tuple[float, float, bool]]:
    """Yield each stage in which lanes are changed: its begin and end, and if a closed part ends it.

    Args:
        scenario: road.
        closed: parts that are closed for a time.
        sections: those of the road, cut at these parts.
        lines_m: their lines.
    """
    road, always = scenario.road, len(scenario.geometry.sections)
    ends_m, sudden_m = {*lines_m, road.length_m}, {*lines_m[always:]}
    begin_m = {max(one.from_m, one.moves_from_m) for one in sections}
    from_m = 0.0
    for position_m in sorted(ends_m | begin_m):
        if not 0.0 < position_m <= road.length_m:
            continue
        begins_m = from_m if position_m in sudden_m else max(from_m, road.sorting_start_m)
        known_m = max(begins_m, *scenario.geometry.entry_m)
        beside = any(one.from_m < position_m and begins_m < one.to_m for one in closed)
        # Before a lane that begins, a stage is left out that is too short for a formation, and
        # beside a part that is closed for a time, since vehicles have just left its lane.
        if begins_m < position_m and (
            position_m in ends_m or (position_m >= known_m + shortest_m(scenario) and not beside)
        ):
            yield begins_m, position_m, position_m in sudden_m
        from_m = position_m


def where_overtaken(
    cleared: Iterable[ClearedPart], columns: range, scenario: Scenario
) -> tuple[Overtaking, ...]:
    """Return where faster vehicles of other systems overtake a formation.

    Args:
        cleared: what is cleared for them, at their speeds. It is a slot longer than they need,
            which gives the rolling operation time to plan.
        columns: columns of the formation.
        scenario: lattice.
    """
    lattice, road_m, found = scenario.lattice, scenario.road.length_m, list[Overtaking]()
    front, rear = columns[-1], columns[0]
    for part in cleared:
        gained_mps = part.speed_mps - lattice.speed_mps
        if gained_mps <= 0.0:
            continue
        from_m, to_m = part.at(0.0)
        rear_m = lattice.cell_s_m(rear, 0.0) - scenario.types.longest_body_m
        until_s = (rear_m - to_m) / gained_mps + scenario.timing.cycles_s[0]
        overtaken_s = (lattice.cell_s_m(front, 0.0) - from_m) / gained_mps
        begins_m = lattice.cell_s_m(front, until_s)
        ends_m = max(lattice.cell_s_m(rear, overtaken_s), begins_m + LEFT_M)
        ends_m = min(ends_m, road_m - LEFT_M)
        if ends_m > max(begins_m, 0.0) and overtaken_s - until_s <= MAX_OVERTAKING_S:
            found.append(Overtaking(part.lane, begins_m, ends_m, until_s))
    return tuple(found)


def shortest_m(scenario: Scenario) -> float:
    """Return the length of the shortest stage in which a formation can move."""
    return scenario.formation.longest_m + scenario.types.step_m


def with_queues(
    closed: Sequence[TemporaryClosure], census: Census, scenario: Scenario
) -> tuple[TemporaryClosure, ...]:
    """Return parts that are closed for a time, so that their lines are before waiting vehicles.

    Those beyond the line do not move it. Parts of different lanes begin together if no formation
    can move between them. The lengths of queues are rounded, since every new one makes formations
    plan again.

    Args:
        closed: parts that are closed for a time.
        census: vehicles on the road.
        scenario: road.
    """
    if not closed:
        return ()  # as in nearly every tick
    parts = sorted(closed)
    waiting = [body for body in census.off_lattice if _goes_on(body, scenario)]
    with_their_queues = list[TemporaryClosure]()
    for part in parts:
        passed_m = [one.to_m for one in parts if one.lane == part.lane and one.to_m <= part.from_m]
        line_m = stop_line_m(part, scenario)
        queue_m = [
            line_m - body.rear_m
            for body in waiting
            if body.lane == part.lane and max(passed_m, default=-math.inf) <= body.rear_m < line_m
        ]
        before_m = part.late_m + QUEUE_M * math.ceil(max(queue_m, default=0.0) / QUEUE_M)
        known = part._replace(from_m=part.from_m - before_m, late_m=0.0) if queue_m else part
        with_their_queues.append(known)
    group_m, found = -math.inf, list[TemporaryClosure]()
    for part in sorted(with_their_queues, key=lambda part: part.from_m):
        if part.from_m >= group_m + shortest_m(scenario):
            group_m = part.from_m
        found.append(part._replace(from_m=group_m))
    return tuple(found)


def _goes_on(body: OffLattice, scenario: Scenario) -> bool:
    """Return whether the lane of a body goes on ahead of it while no part is closed for a time."""
    return any(
        one.lane == body.lane and one.from_m <= body.rear_m < one.to_m and one.exit
        for one in scenario.geometry.sections
    )
