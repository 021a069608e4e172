"""The roadside at the entrances: lets vehicles enter, and publishes clock and census."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial

from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import NO_PARTS, TemporaryClosure, TemporaryParts, cut
from laneweave.protocol.runtime.node import Effect
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import EmergencyBrake
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.wire.events import MOVE_TAKEN_BACK, PART_CLOSED, PART_OPENED
from laneweave.protocol.wire.messages import ClosedFormation, Name, Neighbour
from laneweave.protocol.wire.obstacle_messages import Obstacle
from laneweave.sim_bridge.road.allocation import NO_VEHICLES, Allocation, allocation_of
from laneweave.sim_bridge.road.census import CensusPublisher
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.demand_queue import NO_OUTSIDE_TRAFFIC, DemandQueue, OutsideTraffic
from laneweave.sim_bridge.road.entry import Admission, EntryMeter, Goals
from laneweave.sim_bridge.road.lane_end_control import LaneEndChange, LaneEndControl
from laneweave.sim_bridge.road.obstacles import Breakdown, Obstacles
from laneweave.sim_bridge.road.passing_vehicles import PassingVehicle
from laneweave.sim_bridge.road.vehicle import RoadVehicle

QUEUE_ROOM_M = 20.0
"""Spare distance behind a slow vehicle near the entrance, beyond that for the hardest braking."""
MOVING_MPS = 0.1
"""Speed above which a vehicle does not stand."""


class EntranceRoom:
    """Knows the entry points that are full."""

    def __init__(self, scenario: Scenario) -> None:
        """Read the entrances of a road."""
        self._lattice = lattice = scenario.lattice
        weakest = scenario.types.weakest_braking
        self._brake = EmergencyBrake(weakest, scenario.braking, scenario.runtime.tick_s)
        longest_m = scenario.types.longest_body_m
        stopping_m = lattice.speed_mps**2 / -weakest.min_accel_mps2
        self._room_m = longest_m + stopping_m + lattice.speed_mps + QUEUE_ROOM_M
        """Distance from an entrance within which bodies may keep others from entering."""
        merge_m = {one.name: one.merge_m for one in scenario.entrance}
        points = scenario.geometry.entry_points
        self._points = [
            (
                number,
                point.lane,
                point.at_m,
                merge_m.get(point.entrance, -math.inf) + scenario.types.step_m,
            )
            for number, point in enumerate(points)
        ]
        """(number, lane, position, where a queue on its ramp leaves room for merging)."""
        self._near_m = max(
            max(at_m + self._room_m, merging_m + longest_m)
            for _, _, at_m, merging_m in self._points
        )
        """Position up to which bodies may keep others from entering."""

    def full_points(self, vehicles: Iterable[RoadVehicle]) -> set[int]:
        """Return the entry points at which a body leaves too little room to brake.

        A ramp is full, too, while a queue at its end leaves no room for merging.
        """
        lattice = self._lattice
        full = set[int]()
        for vehicle in vehicles:
            s_m, speed_mps, accel_mps2, y_m, _, _ = vehicle.state
            if s_m > self._near_m:
                continue
            length_m, width_m = vehicle.size
            first, last = lattice.lanes_touched(y_m, width_m)
            goal = vehicle.cell[1]
            waits = not vehicle.has_cell
            for number, lane, at_m, merging_m in self._points:
                beyond_m = s_m - at_m
                if number in full or beyond_m < 0.0:
                    continue
                if not first <= lane <= last and lane != goal:
                    continue
                if waits and s_m - length_m < merging_m:
                    full.add(number)
                    continue
                if beyond_m > self._room_m:
                    continue
                if self._is_near(Neighbour(0, beyond_m - length_m, speed_mps, accel_mps2)):
                    full.add(number)
        return full

    def closed_points(
        self, passing: Iterable[PassingVehicle], temporary: TemporaryParts, t_s: float
    ) -> set[int]:
        """Return the entry points that are closed to vehicles.

        A vehicle of another system is near ahead, or the lane is cleared there.

        Args:
            passing: vehicles of other systems on the road.
            temporary: parts of lanes that are not open as always.
            t_s: road time.
        """
        cleared = [(one.lane, *one.at(t_s)) for one in temporary.cleared]
        return {
            number
            for number, lane, at_m, _ in self._points
            if any(lane == own and from_m <= at_m <= to_m for own, from_m, to_m in cleared)
            or any(
                lane == one.passage.lane
                and 0.0 <= one.s_m - at_m <= self._room_m
                and self._is_near(Neighbour(0, one.rear_m - at_m, one.speed_mps, one.accel_mps2))
                for one in passing
            )
        }

    def _is_near(self, body: Neighbour) -> bool:
        """Return whether a body leaves too little room for a vehicle that enters behind it."""
        speed_mps = self._lattice.speed_mps
        entering = (0.0, speed_mps, 0.0, 0.0, 0.0, 0.0)
        spare_m = self._brake.spare_m(entering, 0.0, (0.0, 0.0), [body])
        return spare_m < (QUEUE_ROOM_M if body.speed_mps < 0.5 * speed_mps else 0.0)


class Roadside:
    """Connects the parts at the entrances: demand, metering, allocation, lane ends and census."""

    def __init__(
        self,
        scenario: Scenario,
        stream: Sequence[Arrival],
        bridge: int = 0,
        outside_traffic: OutsideTraffic = NO_OUTSIDE_TRAFFIC,
        allocation: Allocation | None = None,
        breakdowns: Iterable[Breakdown] = (),
    ) -> None:
        """Begin without vehicles.

        Args:
            scenario: road, formations.
            stream: the arrivals, by time.
            bridge: incarnation of the bridge.
            outside_traffic: further vehicles, which a simulator drives to entrances.
            allocation: what vehicles get besides their cells; None: that of the operation.
            breakdowns: vehicles that break down.
        """
        self.outside = outside_traffic
        self._allocation = allocation or allocation_of(scenario, self.is_kept_free)
        self._meter = EntryMeter(
            scenario.lattice,
            scenario.formation.entry_spread_s,
            self._allocation.builder,
            interlaced=scenario.formation.interlaced,
            entry_points=scenario.geometry.entry_points,
            column_bound=[name for name, one in scenario.types.items() if not one.changes_columns],
            goals_of=partial(_goals, scenario),
            shared_lanes=scenario.geometry.shared_lanes,
            is_free=self._allocation.is_free,
        )
        self._scenario = scenario
        self.obstacles = Obstacles(scenario, breakdowns)
        self._lane_ends = LaneEndControl(scenario, self._meter, self.obstacles)
        self._temporary = NO_PARTS
        self._reported: tuple[Obstacle, ...] = ()
        """Obstacles of which events have been logged."""
        self.lane_ends = LaneEnds(scenario)
        """Ends of lanes now, which motion controllers know."""
        self._room = EntranceRoom(scenario)
        self.demand = DemandQueue(scenario, stream, self._meter, outside_traffic)
        self.publisher = CensusPublisher(
            bridge, self.demand, self._lane_ends.bodies, outside_traffic, self._allocation.closed_to
        )

    def admit(
        self, t_s: float, vehicles: Mapping[Name, RoadVehicle] = NO_VEHICLES
    ) -> list[Admission]:
        """Return the vehicles that have entered since the last call.

        No vehicle enters a lane where it would have to brake hard for a queue at the entrance.

        Args:
            t_s: road time.
            vehicles: the vehicles on the road.
        """
        self._allocation.begin_tick(vehicles)
        self.demand.queue(t_s, (one.arrival for one in vehicles.values()))
        full = self._room.full_points(vehicles.values()) | self.outside.full_lanes(t_s)
        if self.obstacles:
            full |= self._room.closed_points(self.obstacles.passing.on_road, self._temporary, t_s)
        admissions = self._meter.admit(t_s, full)
        occupied = (one.controller.hold_cell for one in vehicles.values())
        admissions += self.outside.admit(t_s, self._meter, occupied)
        if admissions:
            self.publisher.on_changed(entered=len(admissions))
        return self._allocation.admit(admissions)

    def control_lane_ends(
        self, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> list[LaneEndChange]:
        """Take vehicles off the lattice whose lanes end, and bring them back.

        Must be called before `assign_empty_cells`, from which gaps are excluded.
        """
        changes = [] if not self.obstacles else list(self._close_parts(vehicles, t_s))
        changes += self._lane_ends.update(vehicles, t_s)
        if changes:
            self.publisher.on_changed()
        return changes

    def _close_parts(
        self, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> Iterator[LaneEndChange]:
        """Close parts of lanes for a time, and open them again."""
        obstacles, control = self.obstacles, self._lane_ends
        broken = list(obstacles.update(vehicles, t_s, control.in_use))
        temporary = obstacles.temporary
        if temporary != self._temporary:
            self._temporary, closed = temporary, temporary.closed
            self.lane_ends = LaneEnds(self._scenario, temporary)
            self.publisher.on_changed()
            self._meter.most_in_column = self._lanes_past(closed)
            for vehicle in vehicles.values():
                if vehicle.close(self.lane_ends, t_s):
                    yield LaneEndChange(vehicle.name, MOVE_TAKEN_BACK, vehicle.cell[1])
            control.close(self.lane_ends)
        self.publisher.obstacles, self.publisher.cleared = obstacles.parts, obstacles.cleared
        for vehicle in broken:
            yield control.take_off(vehicle.name, vehicle)

    def pop_obstacle_changes(self) -> Iterator[tuple[str, Obstacle]]:
        """Yield what has changed since the last call: kinds of events, and obstacles."""
        yield from self.obstacles.passing.pop_changes()
        before, self._reported = self._reported, self.obstacles.at_rest
        if self._reported != before:
            yield from ((PART_CLOSED, one) for one in self._reported if one not in before)
            now = {one.identity for one in self._reported}
            gone = (one for one in before if one.identity not in now)
            yield from ((PART_OPENED, one) for one in gone)

    def _lanes_past(self, closed: Sequence[TemporaryClosure]) -> int | None:
        """Return the number of lanes in which vehicles can pass closed parts; None: there are none.

        Lanes that are closed beside each other count at each place.
        """
        sections = cut(self._scenario.geometry.sections, closed)
        return min(
            (
                len({each.lane for each in sections if each.from_m <= one.from_m < each.to_m})
                for one in closed
            ),
            default=None,
        )

    def close_formations(self, t_s: float) -> list[ClosedFormation]:
        """Return the formations closed since the last call.

        Must be called after `admit` and `control_lane_ends`, which determine their members.
        """
        closed = self._allocation.close_formations(t_s, self._lane_ends.pop_entered_gaps())
        self.publisher.on_closed(closed, self._allocation.closed_to)
        return closed

    def assign_empty_cells(self, vehicles: Mapping[Name, RoadVehicle]) -> None:
        """Assign empty cells at the entrance to vehicles near them (rolling operation)."""
        # A vehicle from upstream may touch one column more. At the start, the numbers of entry
        # points are those of their lanes.
        upstream = self.outside.start_lanes
        closed = [
            column + (point in upstream)
            for point, column in enumerate(self._meter.closed_columns())
        ]
        self._allocation.assign_empty_cells(vehicles, closed)

    def on_left(
        self,
        vehicle: RoadVehicle,
        vehicles: Mapping[Name, RoadVehicle],
        t_s: float,
        still_in: int | None = None,
    ) -> None:
        """Count a vehicle that has left the road, and pass its cells on to those on the road.

        `still_in`: lane in which a simulator drives it on; its cells there are not passed on.
        """
        self.publisher.on_changed(left=1)
        self._allocation.on_left(vehicle, vehicles, t_s, still_in)

    def publish(
        self, tick: int, t_s: float, on_road: Collection[RoadVehicle], *, ended: bool = False
    ) -> Iterator[Effect]:
        """Publish clock and census; see `CensusPublisher`."""
        return self.publisher.publish(tick, t_s, on_road, ended=ended)

    def is_over(self, t_s: float, vehicles: Mapping[Name, RoadVehicle]) -> bool:
        """Return whether the road will not change any more."""
        moving = any(one.state[1] > MOVING_MPS for one in vehicles.values())
        stuck = self.outside.is_stuck(t_s, moving=moving)
        return stuck or (not vehicles and self.demand.exhausted(t_s))

    def is_kept_free(self, cell: Cell) -> bool:
        """Return whether a cell belongs to a gap for a vehicle at the end of its lane."""
        return self._lane_ends.is_kept_free(cell)


def _goals(scenario: Scenario, arrival: Arrival) -> Goals:
    """Return where a vehicle may leave the road."""
    numbers = scenario.geometry.goal_sections(
        arrival.preferred_lane, arrival.destination, arrival.vehicle_type
    )
    sections = [scenario.geometry.sections[number] for number in numbers]
    lanes = {section.lane for section in sections}
    return Goals(tuple(sorted(lanes)), max(section.to_m for section in sections))
