"""Vehicles of other systems: each drives in one lane at a speed of its own.

Around a slow one, a part of its lane is closed, which jumps ahead once in a slot: vehicles leave
the lane, or stop at the stop line of the part as it was then, and start again when the vehicle is
far ahead. Before a fast one, the lane is cleared: vehicles leave it, and none enters it. Each
brakes for what is ahead of it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping

from attrs import Factory, define, field

from laneweave.protocol.road_layout import TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import RoadEvent
from laneweave.protocol.vehicle.lane_ends import HEEDED_BRAKING_MPS2
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.vehicle.sudden_stops import stops_before
from laneweave.protocol.wire.events import PART_CLOSED, PART_OPENED
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.obstacle_messages import PASSING, Cleared, Obstacle
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Size
from laneweave.sim_bridge.bodies.stop_lines import STANDING_MPS
from laneweave.sim_bridge.road.vehicles_in_part import (
    BodyOnRoad,
    cleared_before_m,
    vehicles_in_part,
)

CLEARED_BEHIND_M = 20.0
"""Length of the lane behind a fast vehicle that none may enter."""
WAITING = 0.95
"""Share of the speed of the lattice below which a fast vehicle is as slow as others, since it waits
behind them."""
AHEAD_M = 1.0
"""How far a closed part reaches beyond the front of a slow vehicle."""
TOUCH_M = 0.1
"""Minimum distance from its front to the end of the part."""
BLOCKED_M = 30.0
"""Distance to the front of a vehicle that keeps one behind it from driving."""
MIN_GAP_M = 2.0
"""Gap behind a vehicle that stands."""
ACCEL_MPS2, BRAKING_MPS2, HARDEST_MPS2 = 1.5, 4.0, 6.0
"""Acceleration; deceleration with which it plans to stop; maximum deceleration. It has no lag:
the stopping distance is at least that of 10 m/s2 with the lag that followers assume."""
REACTION_S = 1.0
PREDICTED_M, PREDICTED_MPS = 5.0, 2.0
"""Errors of the published motion from which a new one is published."""


@define
class PassingVehicle:
    """A vehicle of another system on the road."""

    name: Name
    passage: RoadEvent
    since_s: float
    s_m: float
    """Position of its front."""
    y_m: float
    width_m: float
    speed_mps: float
    accel_mps2: float = 0.0
    lowest_mps: float = Factory(lambda self: self.speed_mps, takes_self=True)
    """Lowest speed so far."""
    cleared: Cleared | None = None
    """The part of its lane that is cleared for it."""
    closed: TemporaryClosure | None = None
    """The part of its lane that is closed around it."""
    blocked: bool = False
    """Whether it stands behind a vehicle that waits for a lane to be open again."""

    @property
    def length_m(self) -> float:
        """Length of the vehicle: that of the part of the lane in which it enters."""
        return self.passage.to_m - self.passage.from_m

    @property
    def state(self) -> State:
        """(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""
        return (self.s_m, self.speed_mps, self.accel_mps2, self.y_m, 0.0, 0.0)

    @property
    def size(self) -> Size:
        """Length and width [m]."""
        return (self.length_m, self.width_m)

    @property
    def lanes_used(self) -> set[int]:
        """Its lane."""
        return {self.passage.lane}

    @property
    def stops_m(self) -> float:
        """Position at which it stops if it begins to brake after its reaction time."""
        reacts_m = self.speed_mps * REACTION_S
        return self.s_m + MIN_GAP_M + reacts_m + self.speed_mps**2 / (2.0 * HARDEST_MPS2)

    @property
    def has_cell(self) -> bool:
        """Whether it has a cell, or needs none: always."""
        return True

    @property
    def waits(self) -> bool:
        """Whether it waits for a lane to be open again: never."""
        return False

    @property
    def re_enters(self) -> bool:
        """Whether it drives back into a cell: never, since it needs none."""
        return False

    @property
    def rear_m(self) -> float:
        """Position of its rear."""
        return self.s_m - self.length_m

    @property
    def recorded(self) -> Obstacle:
        """The vehicle as it is recorded: where it has entered, and its lowest speed."""
        passage = self.passage
        return Obstacle(
            lane=passage.lane,
            from_m=passage.from_m,
            to_m=passage.to_m,
            cause=PASSING,
            since_s=self.since_s,
            vehicle=self.name,
            speed_mps=self.lowest_mps,
        )

    def step(self, gap_m: float, lead_mps: float, tick_s: float) -> None:
        """Drive one tick behind a vehicle ahead, if any: an infinite gap.

        Krauß, Wagner and Gawron, "Metastable states in a microscopic model of traffic flow",
        Physical Review E 55, 1997, without random deviations.
        """
        speed_mps = min(self.speed_mps + ACCEL_MPS2 * tick_s, self.passage.speed_mps)
        if gap_m < math.inf:
            reacts_mps = BRAKING_MPS2 * REACTION_S
            room = max(gap_m - MIN_GAP_M, 0.0)
            safe_mps = math.sqrt(reacts_mps**2 + lead_mps**2 + 2.0 * BRAKING_MPS2 * room)
            speed_mps = min(speed_mps, safe_mps - reacts_mps)
        speed_mps = max(speed_mps, self.speed_mps - HARDEST_MPS2 * tick_s, 0.0)
        self.accel_mps2 = (speed_mps - self.speed_mps) / tick_s
        self.s_m += 0.5 * (self.speed_mps + speed_mps) * tick_s
        self.speed_mps = speed_mps
        self.lowest_mps = min(self.lowest_mps, speed_mps)


@define
class PassingVehicles:
    """All vehicles of other systems on a road."""

    _scenario: Scenario
    _pending: list[RoadEvent]
    on_road: list[PassingVehicle] = field(factory=list)
    _count: int = 0
    _announced: dict[int, Cleared] = field(factory=dict)
    """What is cleared for vehicles that wait for room to enter, by the id of the passage."""
    _slot: int = -1
    _changes: list[tuple[str, Obstacle]] = field(factory=list)

    def __bool__(self) -> bool:
        """Return whether there are vehicles, or will be."""
        return bool(self._pending or self.on_road)

    @property
    def cleared(self) -> tuple[Cleared, ...]:
        """The parts of lanes that are cleared now."""
        own = (one.cleared for one in self.on_road)
        return (*(each for each in own if each is not None), *self._announced.values())

    @property
    def states(self) -> dict[str, State]:
        """State of each vehicle: (s, v, a, y, v_y, a_y)."""
        return {one.name: one.state for one in self.on_road}

    @property
    def sizes(self) -> dict[str, Size]:
        """Length and width of each vehicle [m]."""
        return {one.name: one.size for one in self.on_road}

    def is_fast(self, passage: RoadEvent) -> bool:
        """Return whether a vehicle comes from behind: it is at least as fast as the lattice."""
        return passage.speed_mps >= self._scenario.lattice.speed_mps

    def update(
        self,
        vehicles: Mapping[Name, BodyOnRoad],
        closed: Collection[TemporaryClosure],
        t_s: float,
    ) -> None:
        """Let vehicles enter and leave, and update what is closed and cleared for them.

        Args:
            vehicles: those of this system.
            closed: parts in which no vehicle may be.
            t_s: road time.
        """
        end_m = self._scenario.road.length_m
        for one in list(self.on_road):
            if one.s_m >= end_m or t_s >= one.passage.ends_s(one.since_s):
                self.on_road.remove(one)
                self._changes.append((PART_OPENED, one.recorded))
        for passage in [one for one in self._pending if t_s >= one.at_s]:
            if passage.until_s is not None and t_s >= passage.until_s:
                self._pending.remove(passage)  # it has found no room
                self._announced.pop(id(passage), None)
                continue
            if id(passage) not in self._announced:
                self._announced[id(passage)] = self._cleared_before(passage, t_s)
            if self._has_room(passage, vehicles, closed, t_s):
                self._pending.remove(passage)
                self._announced.pop(id(passage), None)
                self._count += 1
                entered = PassingVehicle(
                    Name(f"other-{self._count}"),
                    passage,
                    since_s=t_s,
                    s_m=passage.to_m,
                    y_m=self._scenario.lattice.cell_y_m(passage.lane),
                    width_m=self._scenario.vehicle.width_m,
                    speed_mps=passage.speed_mps,
                )
                self.on_road.append(entered)
                self._changes.append((PART_CLOSED, entered.recorded))
        slot = math.floor(t_s / self._scenario.timing.cycles_s[0] + 1e-9)
        for one in self.on_road:
            fast = self.is_fast(one.passage)
            if fast:
                one.cleared = self._cleared_for(one, t_s)
            if fast and one.speed_mps >= WAITING * self._scenario.lattice.speed_mps:
                one.closed = None
            elif one.closed is None or slot != self._slot or one.s_m >= one.closed.to_m:
                one.closed = self._closed_around(one, vehicles.values())
            one.blocked = one.speed_mps < STANDING_MPS and any(
                vehicle.waits
                and one.passage.lane in vehicle.lanes_used
                and 0.0 < vehicle.state[0] - one.s_m < BLOCKED_M
                for vehicle in vehicles.values()
            )
        self._slot = slot

    def step(
        self,
        vehicles: Iterable[BodyOnRoad],
        closed: Iterable[TemporaryClosure],
        tick_s: float,
    ) -> None:
        """Move all vehicles by a tick; they stop before parts that are `closed`."""
        if not self.on_road:
            return
        bodies = [
            (lane, one.state[0], one.state[0] - one.size[0], one.state[1])
            for one in (*vehicles, *self.on_road)
            for lane in one.lanes_used
        ]
        bodies += [(part.lane, part.to_m, part.from_m, 0.0) for part in closed]
        for one in self.on_road:
            ahead = [
                (rear_m - one.s_m, speed_mps)
                for lane, front_m, rear_m, speed_mps in bodies
                if lane == one.passage.lane and front_m > one.s_m
            ]
            one.step(*min(ahead, default=(math.inf, 0.0)), tick_s)

    def _has_room(
        self,
        passage: RoadEvent,
        vehicles: Mapping[Name, BodyOnRoad],
        closed: Iterable[TemporaryClosure],
        t_s: float,
    ) -> bool:
        """Return whether a vehicle can enter so that neither it nor others have to brake hard.

        Not even if the vehicle ahead stops suddenly.
        """
        lane, from_m, to_m = passage.lane, passage.from_m, passage.to_m
        waits = t_s < passage.at_s + passage.clear_s
        if not self._has_room_between_others(passage) or any(
            part.lane == lane
            and part.to_m > from_m
            and not _follows(part.from_m, to_m, passage.speed_mps, 0.0)
            for part in closed
        ):
            return False
        lattice_mps, fast = self._scenario.lattice.speed_mps, self.is_fast(passage)
        if not fast:
            found = vehicles_in_part(self._scenario, lane, from_m, to_m, vehicles.values())
            if not found.allow_closing(waits=waits):
                return False
        slots = self._scenario.formation.traits.clearing_slots
        free_m = to_m + (self._cleared_ahead_m(passage, slots) if waits and fast else 0.0)
        for vehicle in vehicles.values():
            s_m, speed_mps = vehicle.state[:2]
            if lane not in vehicle.lanes_used:
                continue
            rear_m = s_m - vehicle.size[0]
            if s_m <= from_m:
                if fast and not _follows(from_m, s_m, speed_mps, passage.speed_mps):
                    return False
            elif rear_m < free_m or not _follows(
                rear_m, to_m, passage.speed_mps, min(speed_mps, lattice_mps)
            ):
                return False
        return True

    def _has_room_between_others(self, passage: RoadEvent) -> bool:
        """Return whether a vehicle can enter before and behind those of other systems."""
        from_m, to_m = passage.from_m, passage.to_m
        return all(
            _follows(from_m, one.s_m, one.speed_mps, passage.speed_mps)
            if one.s_m <= from_m
            else one.rear_m >= to_m + gap_needed_m(passage.speed_mps, one.speed_mps)
            for one in self.on_road
            if one.passage.lane == passage.lane
        )

    def _cleared_before(self, passage: RoadEvent, t_s: float) -> Cleared:
        """Return what is cleared for a vehicle that waits for room to enter."""
        from_m, to_m = passage.from_m, passage.to_m
        if self.is_fast(passage):
            # A slot shorter than the room that it needs: farther ahead, vehicles may change lanes.
            slots = self._scenario.formation.traits.clearing_slots - 1
            to_m += self._cleared_ahead_m(passage, slots)
        else:
            from_m -= cleared_before_m(self._scenario)
        return Cleared(passage.lane, from_m, to_m, 0.0, t_s, PASSING)

    def _cleared_ahead_m(self, passage: RoadEvent, slots: int) -> float:
        """Return how far ahead of a fast vehicle its lane must be free, so that it keeps its speed.

        Vehicles there have some slots of time to leave the lane.
        """
        lattice_mps, slot_s = self._scenario.lattice.speed_mps, self._scenario.timing.cycles_s[0]
        gained_mps = passage.speed_mps - lattice_mps
        return gap_needed_m(passage.speed_mps, lattice_mps) + slots * slot_s * gained_mps

    def _cleared_for(self, one: PassingVehicle, t_s: float) -> Cleared:
        """Return what is cleared for a fast vehicle: as before, while it moves as predicted."""
        before = one.cleared
        if before is not None and abs(before.speed_mps - one.speed_mps) < PREDICTED_MPS:
            predicted_m = before.front_m + before.speed_mps * (t_s - before.at_s)
            if abs(predicted_m - one.s_m) < PREDICTED_M:
                return before
        return Cleared(
            one.passage.lane,
            one.rear_m - CLEARED_BEHIND_M,
            one.s_m + self._cleared_ahead_m(one.passage, 1),
            one.speed_mps,
            t_s,
            PASSING,
            one.name,
            one.s_m,
            one.length_m,
        )

    def _closed_around(
        self, one: PassingVehicle, vehicles: Iterable[BodyOnRoad]
    ) -> TemporaryClosure:
        """Return the part of a lane in which a slow vehicle is up to the end of the next slot.

        It ends behind the next vehicle ahead: those ahead are not concerned.
        """
        speed_mps = min(one.passage.speed_mps, self._scenario.lattice.speed_mps)
        ahead_m = 2.0 * self._scenario.timing.cycles_s[0] * speed_mps + AHEAD_M
        rears_m = [
            vehicle.state[0] - vehicle.size[0]
            for vehicle in vehicles
            if one.passage.lane in vehicle.lanes_used and vehicle.state[0] > one.s_m
        ]
        last_m = self._scenario.road.length_m - TOUCH_M
        to_m = min([one.s_m + ahead_m, last_m, *rears_m])
        return TemporaryClosure(one.passage.lane, one.rear_m, max(to_m, one.s_m + TOUCH_M))

    def is_blocked(self, name: Name) -> bool:
        """Return whether a vehicle stands behind one that waits for a lane to be open again."""
        return any(one.name == name and one.blocked for one in self.on_road)

    def pop_changes(self) -> list[tuple[str, Obstacle]]:
        """Return the vehicles that have entered or left since the last call."""
        changes, self._changes = self._changes, []
        return changes


def gap_needed_m(speed_mps: float, lead_mps: float) -> float:
    """Return the gap from which a vehicle does not brake for the one ahead; see `step`."""
    reacts_mps = BRAKING_MPS2 * REACTION_S
    room = (speed_mps + reacts_mps) ** 2 - reacts_mps**2 - lead_mps**2
    return MIN_GAP_M + max(room, 0.0) / (2.0 * BRAKING_MPS2)


def _follows(rear_m: float, front_m: float, speed_mps: float, lead_mps: float) -> bool:
    """Return whether a vehicle can stop behind one ahead that brakes hard."""
    return stops_before(rear_m + lead_mps**2 / (2.0 * HEEDED_BRAKING_MPS2), front_m, speed_mps)
