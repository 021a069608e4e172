"""The geometry of a road: where lanes are open, where vehicles enter, leave and change lanes."""

from __future__ import annotations

from functools import cached_property

from attrs import frozen

from laneweave.protocol.road_layout import (
    ANY_LANE,
    END_OF_ROAD,
    LaneSection,
    open_sections,
    sections_for,
)
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.road_tables import Closure, Entrance, EntryPoint, Exit, Road


def first_moves_m(
    s1_m: float, s2_m: float, speed_mps: float, settle_s: float, *, in_s2: bool
) -> float:
    """Return the position [m] from which vehicles may move between cells.

    The start of S3; with `in_s2` the place in S2 that they reach 4 s after they have settled.
    """
    start_m = s1_m + s2_m
    return min(start_m, max(s1_m, speed_mps * (settle_s + 4.0))) if in_s2 else start_m


@frozen
class RoadGeometry:
    """Sections of lanes, entrances, exits, and times at v_F between them."""

    _road: Road
    _entrances: tuple[Entrance, ...]
    _exits: tuple[Exit, ...]
    _formation: FormationSettings

    @cached_property
    def sections(self) -> tuple[LaneSection, ...]:
        """The open sections of all lanes."""
        road = self._road
        return open_sections(
            road.lanes,
            road.length_m,
            [(one.lane, one.from_m, one.to_m) for one in road.closures],
            {(lane, one.at_m): one.name for one in self._exits for lane in one.lanes},
            {(one.lane, one.at_m): one.merge_m for one in self._entrances},
        )

    def goal_sections(
        self, preferred_lane: int, destination: str, vehicle_type: str
    ) -> frozenset[int]:
        """Return the numbers of the sections that serve a vehicle (`LaneSection.serves`).

        Where its type may not drive at their ends, those of other lanes to its destination; if
        there are none either, the type is ignored.
        """
        wanted = sections_for(self.sections, preferred_lane, destination)
        if not self._road.restrictions:
            return wanted
        for numbers in (wanted, sections_for(self.sections, ANY_LANE, destination)):
            permitted = frozenset(
                number
                for number in numbers
                if self._road.may_leave_by(self.sections[number], vehicle_type)
            )
            if permitted:
                return permitted
        return wanted

    @cached_property
    def entry_points(self) -> tuple[EntryPoint, ...]:
        """Where vehicles enter: the first entry point of each lane, then the later ones.

        Entry points 0 to lanes - 1 have the numbers of their lanes. A lane without an entrance has
        an entry point that no vehicle uses.
        """
        ramps = sorted(
            (EntryPoint(one.lane, one.at_m, one.name) for one in self._entrances),
            key=lambda point: point.at_m,
        )
        found = {lane: EntryPoint(lane) for lane in self._road.first_lanes}
        for point in ramps:
            found.setdefault(point.lane, point)
        first = [found.get(lane, EntryPoint(lane)) for lane in range(self._road.lanes)]
        return (*first, *(point for point in ramps if point not in first))

    @cached_property
    def entry_m(self) -> tuple[float, ...]:
        """Where the first vehicles enter each lane: at 0, or on a ramp."""
        return tuple(point.at_m for point in self.entry_points[: self._road.lanes])

    @cached_property
    def last_entry_m(self) -> tuple[float, ...]:
        """Where the last vehicles enter each lane."""
        at_m = {point.lane: point.at_m for point in self.entry_points}
        return tuple(at_m[lane] for lane in range(self._road.lanes))

    def entry_point_of(self, entrance: str) -> int:
        """Return the number of the entry point of a ramp."""
        names = [point.entrance for point in self.entry_points]
        return names.index(entrance)

    @cached_property
    def shared_lanes(self) -> frozenset[int]:
        """Lanes in which a ramp follows an exit or a dead end, as in most interchanges."""
        return frozenset(
            section.lane
            for section in self.sections
            if section.to_m <= self.last_entry_m[section.lane]
        )

    def closed_to_bodies(self, body_m: float, tick_m: float) -> tuple[Closure, ...]:
        """Return the closed parts of lanes that no body may touch.

        Vehicles enter a ramp with their rears before it, and leave by an exit up to a tick behind.

        Args:
            body_m: length of the longest body.
            tick_m: maximum distance that a vehicle drives in a tick.
        """
        entries = {(one.lane, one.at_m) for one in self._entrances}
        exits = {(lane, one.at_m) for one in self._exits for lane in one.lanes}
        parts = []
        for one in self._road.closures:
            from_m, to_m = one.from_m, one.to_m
            if (one.lane, from_m) in exits:
                from_m += tick_m
            if (one.lane, to_m) in entries:
                to_m -= body_m
            if from_m < to_m:
                parts.append(Closure(one.lane, from_m, to_m))
        return tuple(parts)

    def exit_lane(self, destination: str) -> int:
        """Return the lane of an exit; `ANY_LANE` if it has several, or for `END_OF_ROAD`."""
        lanes = next((one.lanes for one in self._exits if one.name == destination), ())
        return lanes[0] if len(lanes) == 1 else ANY_LANE

    @property
    def free_flow_s(self) -> float:
        """Time [s] in which a vehicle passes the whole road at v_F."""
        return self._road.length_m / self._formation.speed_mps

    def free_flow_trip_s(self, entry_point: int, destination: str = END_OF_ROAD) -> float:
        """Return the time [s] at v_F from an entry point to a destination."""
        return self.rest_s(self.entry_points[entry_point].at_m, destination)

    def rest_s(self, s_m: float, destination: str) -> float:
        """Return the time [s] at v_F from a position to a destination; negative if it is behind."""
        ends_m = {one.name: one.at_m for one in self._exits}
        to_m = ends_m.get(destination, self._road.length_m)
        return (to_m - s_m) / self._formation.speed_mps

    @property
    def moves_from_m(self) -> float:
        """Position [m] from which vehicles may move between cells: in S2, or the start of S3."""
        road, formation = self._road, self._formation
        return first_moves_m(
            road.s1_m,
            road.s2_m,
            formation.speed_mps,
            formation.settle_s,
            in_s2=formation.moves_in_s2,
        )
