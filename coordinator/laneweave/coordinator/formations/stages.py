"""Stages of a road for formations: where lanes change, and which lanes vehicles need.

Before S3, the structures of the scenario are the stages (paper, Section 2.2). From the start of S3
on, a stage ends wherever lanes end, begin or leave the road. On a road whose lanes are the same
from end to end there is one such stage, lane sorting (paper, Section 5.2.1).

Before the end of a stage, each vehicle should be in one of its goal lanes: those that lead to its
destination. If none of them is open yet, it needs the nearest lane that goes on behind the stage.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from itertools import pairwise

from attrs import frozen

from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, LaneSection
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import DrivingStructure
from laneweave.protocol.vehicle.lane_ends import sections_to_lines


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
    """All sections of the road."""
    lines_m: tuple[float, ...] = ()
    """Where moves must have ended in each of them."""

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

    def goal_lanes(self, preferred_lane: int, destination: str = END_OF_ROAD) -> frozenset[int]:
        """Return the lanes in one of which a vehicle should be at the end of the stage.

        A vehicle that can no longer change to the lane of its exit drives to the end of the road,
        unless it is in that lane.
        """
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


@lru_cache(maxsize=16)
def stages(scenario: Scenario) -> tuple[Stage, ...]:
    """Return the stages of formations, from the start of the road to its end."""
    road, structures = scenario.road, scenario.formation.structures
    lines_m = tuple(one.to_m for one in sections_to_lines(scenario))
    start_m, end_m = road.sorting_start_m, road.length_m
    changes_m = {
        position_m
        for one, line_m in zip(scenario.geometry.sections, lines_m, strict=True)
        for position_m in (max(one.from_m, one.moves_from_m), line_m)
        if start_m < position_m < end_m
    }
    ends_m, shortest_m = {*lines_m, end_m}, scenario.formation.longest_m + scenario.types.step_m
    parts_m, from_m = [*pairwise([*(one.from_m for one in structures), start_m])], start_m
    for position_m in sorted({*changes_m, end_m}):
        known_m = max(from_m, *scenario.geometry.entry_m)
        # Before a lane that begins, a stage is left out that is too short for a formation.
        if position_m in ends_m or position_m >= known_m + shortest_m:
            parts_m.append((from_m, position_m))
        from_m = position_m
    return tuple(
        Stage(
            begins_m,
            to_m,
            structures[number] if number < len(structures) else None,
            scenario.geometry.sections,
            lines_m,
        )
        for number, (begins_m, to_m) in enumerate(parts_m)
    )
