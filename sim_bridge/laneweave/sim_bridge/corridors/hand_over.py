"""Where SUMO takes vehicles back: before the queue of a lane that leads out of a corridor.

A vehicle would have to brake for what SUMO drives ahead of it: vehicles behind its exit or the end
of the road, and those that were given back before. As long as it can still brake comfortably, it
is given back, with its speed; the next one behind it follows when that one brakes, and so on. So
the line at which vehicles are given back moves with the queue, lane by lane. Plans end before it,
and no vehicle that departs at the start enters a lane whose line is not on the road.

A vehicle that cannot reach the lane that it prefers before the line of this lane, or the lane of
its exit in time, is given back where it is, as soon as this is certain; SUMO decides on its further
lane changes. So is one that cannot leave a ramp that is too short for re-entry
(`LaneEnd.taken_back`). docs/SAFETY.md says why others may go on with their plans meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD, Exits, LanePosition, LaneSection
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import LATE_S, dead_ends, exit_lanes
from laneweave.protocol.wire.messages import OffLattice
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.corridors.corridor import braking_m
from laneweave.sim_bridge.corridors.exit_room import SPACE_M
from laneweave.sim_bridge.road.demand_queue import OnRoad, OnRoadT

REACTION_S = 0.5
"""Time in which a vehicle that is given back keeps its speed."""
AS_FAST_MPS = 0.5
"""Maximum difference to v_F at which others need not brake for a vehicle."""
STANDING_MPS, STANDING_M = 1.0, 8.0
"""Speed below which a vehicle stands, and its distance from another one of the same queue."""
STUCK_MPS = 0.1
"""Speed below which a vehicle that has stopped in a lane change stands."""
PLANS_END_M = 15.0
"""Distance by which a queue may grow before a move that is planned now has ended."""


class HandOver:
    """Decides which vehicles SUMO takes back before their exits."""

    def __init__(self, scenario: Scenario) -> None:
        """Read the exits of a road."""
        sections = scenario.geometry.sections
        self._exits = Exits(sections, scenario.road.length_m)
        self._sections = {(one.lane, one.to_m): one for one in sections if one.exit}
        """Sections that end at an exit, by lane and end."""
        self._speed_mps = speed_mps = scenario.lattice.speed_mps
        self._late_m = LATE_S * speed_mps + scenario.types.room_ahead_m
        self._lattice = scenario.lattice
        self._touch_m = 0.5 * (scenario.road.lane_width_m + scenario.types.widest_body_m)
        """Distance from the middle of a lane within which bodies touch it."""
        self._move_m = scenario.timing.cycles_s[0] * speed_mps
        """Distance that a vehicle drives in one lane change."""
        exits = exit_lanes(scenario)
        self._short = [end for end in dead_ends(scenario) if end.taken_back]
        """Dead ends without re-entry."""
        self._lines_m = {(end.lane, end.end_m): end.line_m for end in (*exits, *self._short)}
        """Lines of exits, and of dead ends without re-entry, by lane and end."""
        self._exit_places: dict[str, list[LanePosition]] = {}
        """The exits before the end of the road, by name."""
        for end in exits:
            place = end.lane, end.end_m
            self._exit_places.setdefault(self._sections[place].exit, []).append(place)
        self._braking_m = SPACE_M + braking_m(speed_mps, REACTION_S)
        """Distance in which a vehicle at v_F stops comfortably behind another one."""

    def lines_m(self, others: Iterable[OtherBody]) -> dict[LaneSection, float]:
        """Return where vehicles at v_F have to brake, by section, if slower ones are ahead."""
        lines_m: dict[LaneSection, float] = {}
        for other in others:
            section = self._sections.get((other.lane, other.exit_m))
            if section is not None and other.speed_mps < self._speed_mps - AS_FAST_MPS:
                line_m = other.rear_m + braking_m(other.speed_mps, 0.0) - self._braking_m
                lines_m[section] = min(lines_m.get(section, math.inf), line_m)
        return lines_m

    def last_lines_m(self, others: Iterable[OtherBody]) -> dict[int, float]:
        """Return these lines by lane, for lanes to the end of the road; at the latest, they end."""
        lines_m = self.lines_m(others)
        return {
            one.lane: min(lines_m.get(one, one.to_m), one.to_m)
            for one in self._sections.values()
            if one.serves(ANY_LANE)
        }

    def moves_m(self, lanes: int) -> float:
        """Return the distance in which a vehicle changes a number of lanes."""
        return lanes * self._move_m

    def plans_end(self, others: Iterable[OtherBody]) -> tuple[OffLattice, ...]:
        """Return lanes with positions beyond which no plan may use them.

        Only lanes to the end of the road: a vehicle beyond could not leave its lane.
        """
        ends = [
            OffLattice(section.lane, max(line_m - PLANS_END_M, section.from_m, 0.0))
            for section, line_m in self.lines_m(others).items()
            if section.serves(ANY_LANE) and line_m - PLANS_END_M < section.to_m
        ]
        return tuple(ends)

    def full_lanes(self, others: Iterable[OtherBody]) -> set[int]:
        """Return the lanes at whose start vehicles would have to brake at once."""
        lines_m = self.lines_m(others)
        return {one.lane for one, line_m in lines_m.items() if line_m < 0.0 >= one.from_m}

    def given_back(
        self, vehicles: Iterable[OnRoadT], others: Sequence[OtherBody]
    ) -> Iterator[OnRoadT]:
        """Yield the vehicles that SUMO takes back now."""
        ends_m = {one.lane: one.rear_m for one in self.plans_end(others)}
        for vehicle in vehicles:
            section = self._section_of(vehicle)
            if not vehicle.keeps_lane:
                due = self._is_stuck(vehicle)
            elif section is None:
                due = self._misses_way_out(vehicle)
            else:
                due = self._misses_lane(vehicle, section, others, ends_m) or self._has_to_brake(
                    vehicle, section, others
                )
            if due:
                yield vehicle

    def _is_stuck(self, vehicle: OnRoad) -> bool:
        """Return whether a vehicle has stopped in a lane change without the room to complete it."""
        s_m, speed_mps, _, y_m = vehicle.state[:4]
        return speed_mps < STUCK_MPS and any(
            end.line_m - self._move_m < s_m <= end.end_m
            and abs(y_m - self._lattice.cell_y_m(end.lane)) < self._touch_m
            for end in self._short
        )

    def _misses_way_out(self, vehicle: OnRoad) -> bool:
        """Return whether a vehicle can no longer leave its lane in time, or reach its exit."""
        s_m, lane = vehicle.state[0], vehicle.body_lane
        # A vehicle that settles may be ahead of its cell, which counts for its plans.
        begins_m = s_m - self._late_m
        here = self._exits.section_at(lane, s_m)
        if here is not None:
            line_m = self._lines_m.get((lane, here.to_m), math.inf)
            if begins_m + self._move_m > line_m:
                return True
        rooms_m = [
            self._lines_m[place] - begins_m - self.moves_m(abs(place[0] - lane))
            for place in self._exit_places.get(vehicle.arrival.destination, ())
            if s_m < place[1]
        ]
        return max(rooms_m, default=0.0) < 0.0

    def _misses_lane(
        self,
        vehicle: OnRoad,
        section: LaneSection,
        others: Sequence[OtherBody],
        ends_m: Mapping[int, float],
    ) -> bool:
        """Return whether it is too late for a vehicle to reach its lane before the line there.

        It is, too, if its own lane has ended for plans, by lane in `ends_m`.
        """
        arrival, lane = vehicle.arrival, section.lane
        wanted = arrival.preferred_lane
        is_right = wanted in (lane, ANY_LANE) or lane in arrival.right_lanes
        if is_right or not section.serves(ANY_LANE):
            return False
        s_m = vehicle.state[0]
        if s_m + self._move_m > ends_m.get(lane, math.inf):
            return True
        ahead = [other for other in others if other.front_m > s_m]
        line_m = self.last_lines_m(ahead).get(wanted, -math.inf)
        return s_m + self.moves_m(abs(wanted - lane)) > line_m

    def _section_of(self, vehicle: OnRoad) -> LaneSection | None:
        """Return the section in which a vehicle is, if it may leave the road by its end."""
        s_m, destination = vehicle.state[0], vehicle.arrival.destination
        places = self._exit_places.get(destination, ())
        if max((end_m for _, end_m in places), default=-math.inf) < s_m:
            destination = END_OF_ROAD  # it has passed its exit
        section = self._exits.section_at(vehicle.body_lane, s_m)
        leaves = section is not None and section.serves(ANY_LANE, destination)
        return section if leaves else None

    def _has_to_brake(
        self, vehicle: OnRoad, section: LaneSection, others: Iterable[OtherBody]
    ) -> bool:
        """Return whether a vehicle has to brake comfortably for another one ahead."""
        s_m, speed_mps = vehicle.state[:2]
        for other in others:
            closing_mps = speed_mps - other.speed_mps
            if (
                (other.lane, other.exit_m) == (section.lane, section.to_m)
                and other.front_m > s_m
                and (closing_mps > 0.0 or speed_mps < STANDING_MPS)
            ):
                brakes_m = braking_m(speed_mps, 0.0) - braking_m(other.speed_mps, 0.0)
                needed_m = SPACE_M + REACTION_S * closing_mps + brakes_m
                if other.rear_m - s_m <= (STANDING_M if speed_mps < STANDING_MPS else needed_m):
                    return True
        return False
