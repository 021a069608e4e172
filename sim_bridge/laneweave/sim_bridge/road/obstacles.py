"""Parts of lanes that are closed for a time.

A part is closed around a vehicle that has broken down, for an event of the scenario, by an
operator, or around a slow vehicle of another system. Its beginning is a dead end (`LaneEnds`):
vehicles change lanes before it, or stop before it and re-enter the lattice.

A part that is to be closed is cleared first, while vehicles are in it or could not stop before it:
vehicles leave it, and none enters it. A part stays closed until its cause is over and no vehicle
waits there any more. Vehicles that wait then start in their own lane, which no other vehicle uses.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from attrs import define, frozen

from laneweave.protocol.road_layout import LanePosition, TemporaryClosure, TemporaryParts
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import RoadEvent
from laneweave.protocol.vehicle.lane_ends import LaneEnds, stop_line_m
from laneweave.protocol.vehicle.re_entry import re_entry
from laneweave.protocol.vehicle.sudden_stops import (
    begins_m,
    queue_pitch_m,
    room_before_part_m,
    stops_before,
)
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.obstacle_messages import (
    BREAKDOWN,
    CLOSED,
    PASSING,
    Cleared,
    Obstacle,
)
from laneweave.protocol.wire.obstacle_messages import Obstacles as ObstaclesMessage
from laneweave.sim_bridge.bodies.stop_lines import STANDING_MPS
from laneweave.sim_bridge.road.passing_vehicles import PassingVehicles
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from laneweave.sim_bridge.road.vehicles_in_part import (
    BodyOnRoad,
    VehiclesInPart,
    cleared_before_m,
    vehicles_in_part,
)

AHEAD_M = 1.0
"""How far a closed part reaches beyond the front of a vehicle that has broken down."""
SPARE_M = 5.0
"""Room for vehicles that do not stop as close to each other as they could."""
BEFORE_END_M = 0.1
"""Distance before the end of a section at which closed parts in it end at the latest."""


@frozen
class Breakdown:
    """A vehicle that breaks down: it slows down in its lane, and stands there."""

    at_s: float
    """Road time from which it may break down; a vehicle that moves or settles ends that first."""
    vehicle: Name | None = None
    """Its name; None: one that fits the following fields."""
    lane: int | None = None
    """None: any lane."""
    at_m: float | None = None
    """The vehicle is the first one beyond this position; None: it is drawn."""
    draw: float = 0.0
    """Number from 0 to below 1 that selects one of all possible vehicles."""
    decel_mps2: float = 3.0
    for_s: float = math.inf
    """Time for which it stands; infinite: for ever."""


@define
class ActiveObstacle:
    """A part of a lane that is closed now."""

    kind: str
    """`BREAKDOWN`, `CLOSED` or `PASSING`."""
    part: TemporaryClosure
    since_s: float
    until_s: float = math.inf
    """When the cause is over; infinite: not known."""
    breakdown: Breakdown | None = None
    """What keeps its vehicle from driving, as long as it does."""
    event: RoadEvent | None = None
    """The cause of a part that is closed without a vehicle."""
    vehicle: Name | None = None
    """The vehicle that has broken down or is passing, if any."""
    stands: bool = False
    """Whether it has stopped."""

    def is_over(self, t_s: float) -> bool:
        """Return whether the cause of the obstacle is over."""
        return t_s >= self.until_s

    @property
    def begins_at(self) -> LanePosition:
        """Lane and position at which the part begins; they identify its dead end."""
        return self.part[:2]

    @property
    def message(self) -> Obstacle:
        """The obstacle as it is published."""
        until_s = None if math.isinf(self.until_s) else self.until_s
        return Obstacle(*self.part, self.kind, self.since_s, until_s, self.vehicle)


class Obstacles:
    """All obstacles of a road."""

    def __init__(self, scenario: Scenario, breakdowns: Iterable[Breakdown] = ()) -> None:
        """Begin with the events of the scenario, and with breakdowns that are to happen."""
        self._scenario = scenario
        self._always = LaneEnds(scenario)
        self._queue_m = queue_pitch_m(scenario)
        events = scenario.road.events
        self._pending: list[Breakdown | RoadEvent] = [one for one in events if not one.speed_mps]
        self._pending += breakdowns
        self.passing = PassingVehicles(scenario, [one for one in events if one.speed_mps])
        self.active: list[ActiveObstacle] = []
        self._clearing: list[RoadEvent] = []

    def __bool__(self) -> bool:
        """Return whether there are obstacles, or will be."""
        return bool(self._pending or self.active or self.passing or self._clearing)

    @property
    def parts(self) -> tuple[Obstacle, ...]:
        """The parts of lanes that are closed now, as they are published."""
        return tuple(one.message for one in self.active)

    @property
    def cleared(self) -> tuple[Cleared, ...]:
        """The parts of lanes that are cleared now, as they are published."""
        before_m = cleared_before_m(self._scenario) if self._clearing else 0.0
        clearing = (
            Cleared(one.lane, one.from_m - before_m, one.to_m, 0.0, one.at_s)
            for one in self._clearing
        )
        return *self.passing.cleared, *clearing

    @property
    def temporary(self) -> TemporaryParts:
        """The parts of lanes that are not open as always."""
        return ObstaclesMessage(0.0, self.parts, cleared=self.cleared).temporary

    @property
    def at_rest(self) -> tuple[Obstacle, ...]:
        """The closed parts without those around vehicles of other systems."""
        return tuple(one.message for one in self.active if one.kind != PASSING)

    def without_vehicles(self, t_s: float) -> list[TemporaryClosure]:
        """Return the parts in which no vehicle may be."""
        return [one.part for one in self.active if one.kind == CLOSED and not one.is_over(t_s)]

    def still_closed(self, t_s: float) -> list[TemporaryClosure]:
        """Return the parts whose cause is not over, before which vehicles have to wait.

        One around a vehicle of another system that stands behind one that waits is none of them,
        since it waits for that one.
        """
        return [
            one.part
            for one in self.active
            if not one.is_over(t_s)
            and not (one.vehicle is not None and self.passing.is_blocked(one.vehicle))
        ]

    def update(
        self, vehicles: Mapping[Name, RoadVehicle], t_s: float, in_use: Collection[LanePosition]
    ) -> Iterator[RoadVehicle]:
        """Begin and end obstacles; yield the vehicles that break down now.

        Args:
            vehicles: the vehicles on the road.
            t_s: road time.
            in_use: dead ends at which vehicles wait, or from which they re-enter.
        """
        for one in list(self.active):
            self._follow(one, vehicles, t_s)
            if one.is_over(t_s) and one.begins_at not in in_use:
                self.active.remove(one)
        self.passing.update(vehicles, self.without_vehicles(t_s), t_s)
        self._follow_passing(vehicles, t_s)
        self._clearing = []
        for cause in [one for one in self._pending if t_s >= one.at_s]:
            if isinstance(cause, RoadEvent):
                waits = t_s < cause.at_s + cause.clear_s
                part = TemporaryClosure(cause.lane, cause.from_m, cause.to_m)
                if t_s >= cause.ends_s(t_s):
                    self._pending.remove(cause)
                elif self.in_the_way(part, vehicles).allow_closing(waits=waits):
                    self._pending.remove(cause)
                    part = self._with_room(part, vehicles)
                    closed = ActiveObstacle(CLOSED, part, t_s, cause.ends_s(t_s), event=cause)
                    self.active.append(closed)
                else:
                    self._clearing.append(cause)
            elif (vehicle := self._found(cause, vehicles, t_s)) is not None:
                self._pending.remove(cause)
                others = {name: one for name, one in vehicles.items() if one is not vehicle}
                part = self._with_room(self._part_of(vehicle, cause.decel_mps2, others), others)
                obstacle = ActiveObstacle(
                    BREAKDOWN, part, t_s, breakdown=cause, vehicle=vehicle.name
                )
                self.active.append(obstacle)
                vehicle.controller.broken_mps2 = cause.decel_mps2
                yield vehicle

    def step(self, vehicles: Iterable[RoadVehicle], t_s: float) -> None:
        """Move the vehicles of other systems by a tick, from road time `t_s` on."""
        closed = self.without_vehicles(t_s) if self.passing else ()
        self.passing.step(vehicles, closed, self._scenario.runtime.tick_s)

    def request(self, event: RoadEvent) -> None:
        """Close a part of a lane as soon as it has been cleared."""
        self._pending.append(event)

    def is_pending(self, event: RoadEvent) -> bool:
        """Return whether a part is still to be closed."""
        return any(one is event for one in self._pending)

    def withdraw(self, event: RoadEvent) -> None:
        """Do not close a part that is still to be closed."""
        self._pending = [one for one in self._pending if one is not event]

    def closed_for(self, event: RoadEvent) -> ActiveObstacle | None:
        """Return the part that was closed for an event, if it is closed."""
        return next((one for one in self.active if one.event is event), None)

    def in_the_way(
        self, part: TemporaryClosure, vehicles: Mapping[Name, RoadVehicle]
    ) -> VehiclesInPart:
        """Return the vehicles in the way of a part that is to be closed."""
        bodies: list[BodyOnRoad] = [*vehicles.values(), *self.passing.on_road]
        return vehicles_in_part(self._scenario, *part[:3], bodies)

    def _follow_passing(self, vehicles: Mapping[Name, RoadVehicle], t_s: float) -> None:
        """Close the parts in which slow vehicles of other systems are now; end earlier ones."""
        current = {one.name: one.closed for one in self.passing.on_road if one.closed is not None}
        for one in self.active:
            if one.kind != PASSING or one.vehicle is None or one.until_s < math.inf:
                continue
            part = current.get(one.vehicle)
            if part is not None and part[:3] == one.part[:3]:
                del current[one.vehicle]
            else:
                one.until_s = t_s
        for name, part in current.items():
            with_room = self._with_room(part, vehicles)
            self.active.append(ActiveObstacle(PASSING, with_room, t_s, vehicle=name))

    def _follow(
        self, one: ActiveObstacle, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> None:
        """Note that a vehicle that breaks down has stopped, is repaired, or has left the road."""
        if one.breakdown is None or one.vehicle is None:
            return
        vehicle = vehicles.get(one.vehicle)
        if vehicle is None:
            one.until_s = min(one.until_s, t_s)
        elif one.is_over(t_s):
            # From now on it waits, and does not keep vehicles behind it from driving.
            one.breakdown, vehicle.controller.broken_mps2 = None, None
        elif not one.stands and vehicle.state[1] < STANDING_MPS:
            one.stands, one.until_s = True, t_s + one.breakdown.for_s
            to_m = self._end_m(one.part.lane, vehicle.state[0])
            one.part = one.part._replace(to_m=to_m)
        elif not one.stands and vehicle.state[0] > one.part.to_m - AHEAD_M:
            to_m = self._stops_m(vehicle, one.breakdown.decel_mps2, vehicles)
            one.part = one.part._replace(to_m=max(to_m, one.part.to_m))

    def _part_of(
        self, vehicle: RoadVehicle, decel_mps2: float, vehicles: Mapping[Name, RoadVehicle]
    ) -> TemporaryClosure:
        """Return the part of a lane that a vehicle blocks while it slows down.

        It begins where the front is now, or where the rear will be if the vehicle brakes in less
        than its length, and ends where the front will be, or before vehicles ahead until they have
        driven on (`_follow`).
        """
        s_m, speed_mps = vehicle.state[:2]
        brakes_m = speed_mps**2 / (2.0 * decel_mps2)
        from_m = s_m + min(0.0, brakes_m - vehicle.size[0])
        to_m = self._stops_m(vehicle, decel_mps2, vehicles)
        return TemporaryClosure(vehicle.cell[1], from_m, to_m)

    def _stops_m(
        self, vehicle: RoadVehicle, decel_mps2: float, vehicles: Mapping[Name, RoadVehicle]
    ) -> float:
        """Return where the part of a vehicle ends that slows down, before vehicles ahead."""
        (s_m, speed_mps), lane = vehicle.state[:2], vehicle.cell[1]
        rears_m = (
            one.state[0] - one.size[0] - 2.0 * AHEAD_M
            for one in vehicles.values()
            if lane in one.lanes_used and one.state[0] > s_m
        )
        stops_m = min([s_m + speed_mps**2 / (2.0 * decel_mps2), *rears_m])
        return self._end_m(lane, max(s_m, stops_m))

    def _with_room(
        self, part: TemporaryClosure, vehicles: Mapping[Name, RoadVehicle]
    ) -> TemporaryClosure:
        """Return a part with room for the vehicles that cannot stop at the stop line before it.

        They stop before the part, and those at the line have room to start all the same.
        """
        late, most_m = 0, max(0.0, self._room_ahead_m(part.lane, part.from_m))
        behind = [
            vehicle.state[:2]
            for vehicle in vehicles.values()
            if part.lane in vehicle.lanes_used and vehicle.state[0] < part.from_m
        ]
        while True:
            late_m = min(late * self._queue_m + (SPARE_M if late else 0.0), most_m)
            with_room = part._replace(late_m=late_m)
            line_m = stop_line_m(with_room, self._scenario)
            found = sum(not stops_before(line_m, *each) for each in behind)
            if found <= late:
                return with_room
            late = found

    def _room_ahead_m(self, lane: int, from_m: float) -> float:
        """Return the room that vehicles that enter the lane do not need to stop before a part.

        Negative: they could not.
        """
        needed_m = room_before_part_m(self._scenario, re_entry(self._scenario).room_m)
        return from_m - needed_m - begins_m(self._scenario, lane, from_m)

    def _end_m(self, lane: int, front_m: float) -> float:
        """Return where a part ends in front of a vehicle: before the end of its section."""
        sections = self._scenario.geometry.sections
        ends_m = [each.to_m for each in sections if each.lane == lane]
        end_m = min((each for each in ends_m if each > front_m), default=max(ends_m))
        return min(front_m + AHEAD_M, end_m - BEFORE_END_M)

    def _found(
        self, breakdown: Breakdown, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> RoadVehicle | None:
        """Return the vehicle that breaks down now: one that is settled in its cell.

        Those behind it can stop, and it will stand before the stop line of its lane.
        """
        possible: Sequence[RoadVehicle] = [
            vehicle
            for vehicle in vehicles.values()
            if breakdown.vehicle in (None, vehicle.name)
            and breakdown.lane in (None, vehicle.cell[1])
            and (breakdown.at_m is None or vehicle.state[0] >= breakdown.at_m)
            and vehicle.has_cell
            and vehicle.controller.broken_mps2 is None
            and vehicle.controller.has_settled(t_s)
            and self._may_stand(vehicle, breakdown.decel_mps2)
        ]
        if breakdown.at_m is not None:
            return min(possible, key=lambda vehicle: vehicle.state[0], default=None)
        return possible[int(breakdown.draw * len(possible))] if possible else None

    def _may_stand(self, vehicle: RoadVehicle, decel_mps2: float) -> bool:
        s_m, speed_mps = vehicle.state[:2]
        lane, brakes_m = vehicle.cell[1], speed_mps**2 / (2.0 * decel_mps2)
        end = self._always.ahead(lane, s_m)
        stands_m = s_m + brakes_m + vehicle.size[0]
        return self._room_ahead_m(lane, s_m) >= 0.0 and (end is None or stands_m < end.line_m)
