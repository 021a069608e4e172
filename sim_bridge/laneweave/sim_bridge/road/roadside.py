"""The roadside at the entrances: admits vehicles, counts them, and publishes clock and census.

The census is complete, so coordinators know all rosters.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType

from attrs import evolve

from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.runtime.node import Effect, Send
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import EmergencyBrake
from laneweave.protocol.wire.messages import (
    Announcement,
    Census,
    CensusEntry,
    ClosedFormation,
    Name,
    Neighbour,
    RoadClock,
)
from laneweave.protocol.wire.topics import CENSUS, CLOCK
from laneweave.sim_bridge.road.demand import Arrival, arrivals, count_until
from laneweave.sim_bridge.road.entry import TIME_TOLERANCE_S, Admission, EntryMeter, Goals
from laneweave.sim_bridge.road.formation_building import formation_builder
from laneweave.sim_bridge.road.lane_end_control import LaneEndChange, LaneEndControl
from laneweave.sim_bridge.road.outside_traffic import OutsideTraffic
from laneweave.sim_bridge.road.vehicle import RoadVehicle

CENSUS_EVERY_TICKS = 10
NO_VEHICLES: Mapping[Name, RoadVehicle] = MappingProxyType({})
"""The empty road, as a default argument."""
QUEUE_ROOM_M = 20.0
"""Spare distance behind a slow vehicle near the entrance, beyond that for the hardest braking."""
HELD_ANNOUNCED = 4
"""Maximum number of vehicles for each exit that are announced while they are held back."""
MOVING_MPS = 0.1
"""Speed above which a vehicle does not stand."""
STANDING_S = 120.0
"""Time for which all vehicles stand in queues behind exits when a run ends, after all entries."""
MAX_EMPTY = 12
"""Maximum distance in columns between a vehicle and empty cells assigned to it; smaller if moves
begin near the entrance, since all cells must be assigned before a plan can transfer them."""


class Roadside:
    """Demand, entry metering and census."""

    def __init__(
        self,
        scenario: Scenario,
        bridge: int = 0,
        stream: tuple[Arrival, ...] | None = None,
        outside_traffic: OutsideTraffic | None = None,
    ) -> None:
        """Begin without vehicles.

        Args:
            scenario: road, demand, formations.
            bridge: incarnation of the bridge.
            stream: the arrivals, by time; None: drawn from the scenario's seed.
            outside_traffic: further vehicles, which a simulator drives to entrances; None: there
                are none.
        """
        self._bridge = bridge
        self._announce_s = scenario.runtime.announce_s
        self._tick_s = scenario.runtime.tick_s
        self._lanes = scenario.road.lanes
        lattice, formation = scenario.lattice, scenario.formation
        self._lattice = lattice
        limits = [one.limits for one in scenario.types.values()]
        weakest = min(limits, key=lambda one: -one.min_accel_mps2)
        self._brake = EmergencyBrake(weakest, scenario.braking, self._tick_s)
        longest_m = scenario.types.longest_body_m
        stopping_m = lattice.speed_mps**2 / -weakest.min_accel_mps2
        self._room_m = longest_m + stopping_m + lattice.speed_mps + QUEUE_ROOM_M
        """Distance from an entrance within which bodies may keep others from entering."""
        ahead_s = self._announce_s + self._tick_s
        self._announced_per_lane = math.ceil(ahead_s / formation.entry_spacing_s) + 1
        self._rolling = formation.rolling
        self._length_m = scenario.road.length_m
        self._builder = formation_builder(scenario)
        self._shared_lanes = scenario.geometry.shared_exit_lanes
        self._keep_columns = not formation.change_columns
        self._vehicles = NO_VEHICLES
        """The vehicles on the road."""
        self._lost = set[Cell]()
        """Cells of these lanes that may belong to a vehicle that nothing on the road knows yet."""
        self._owned: set[Cell] | None = None
        """Cells that somebody may own, and those in `_lost`; None: not determined yet."""
        self._meter = EntryMeter(
            lattice,
            formation.entry_spread_s,
            self._builder,
            interlaced=formation.interlaced,
            entry_m=scenario.geometry.entry_m,
            column_bound=[name for name, one in scenario.types.items() if not one.changes_columns],
            goals_of=partial(_goals, scenario),
            shared_lanes=self._shared_lanes,
            is_free=self._is_free,
        )
        self._lane_ends = LaneEndControl(scenario, self._meter)
        self._closed: list[ClosedFormation] = []
        """Closed formations with vehicles on the road."""
        self._closed_to = -1 if self._builder is None else self._builder.closed_to
        self._recent: list[tuple[int, int, Name]] = []
        """(column, lane, name) of recently entered vehicles."""
        self._next: list[list[tuple[int, Name]]] = [[] for _ in range(self._lanes)]
        """Vehicles that have entered since cells were last assigned, by lane, foremost first; empty
        with formations."""
        self._unassigned: list[Cell] = []
        """Empty cells without an owner."""
        self._entry_m = scenario.geometry.entry_m
        """Where the cells of each lane are assigned."""
        self._merging_m = {
            one.lane: one.merge_m + scenario.types.step_m for one in scenario.entrance
        }
        """Where a queue on a ramp leaves room for merging, by lane."""
        self._near_m = max(
            self._room_m + max(self._entry_m),
            longest_m + max(self._merging_m.values(), default=0.0),
        )
        """Position up to which bodies may keep others from entering."""
        self._assigned_to = [
            MAX_EMPTY + self._meter.closed_column(lane) for lane in range(self._lanes)
        ]
        """Last column of each lane whose cells have been processed."""
        self._ownerless_from = tuple(self._assigned_to)
        """First column of each lane that had passed its entrance before the road began."""
        self._ownerless = set[Cell]()
        """Cells that have never had an owner, since no vehicle was near them at the entrance."""
        self._given = set[Cell]()
        """Cells of these columns that have been assigned since."""
        columns = int(scenario.geometry.moves_from_m / lattice.pitch_m)
        self._max_empty = max(0, min(MAX_EMPTY, columns - 2))
        self._arrivals = arrivals(scenario) if stream is None else stream
        self._outside_traffic = outside_traffic
        self._demanded = 0
        """Arrivals so far, without those of `outside_traffic`."""
        self._others_demanded = 0
        self._held: list[Arrival] = []
        """Vehicles whose exits have no room."""
        self._was_held = Counter[str]()
        """Their number by exit, at the last tick."""
        self._queued = 0
        self._entered = 0
        self._left = 0
        self._moved_s = 0.0
        """When a vehicle moved the last time."""
        self._announced: tuple[Announcement, ...] = ()
        self._census_sent_tick = -CENSUS_EVERY_TICKS
        self._census_changed = True
        """Whether a vehicle has entered or left, or a block has closed, since the last census."""

    def newly_demanded(self, t_s: float) -> tuple[Arrival, ...]:
        """Return the arrivals since the last call."""
        first = self._demanded
        self._demanded = count_until(self._arrivals, t_s + TIME_TOLERANCE_S)
        others = () if self._outside_traffic is None else self._outside_traffic.demanded(t_s)
        self._others_demanded += len(others)
        return (*self._arrivals[first : self._demanded], *others)

    def admit(
        self, t_s: float, vehicles: Mapping[Name, RoadVehicle] = NO_VEHICLES
    ) -> list[Admission]:
        """Return the vehicles that have entered since the last call.

        No vehicle enters a lane where it would have to brake hard for a queue at the entrance.

        Args:
            t_s: road time.
            vehicles: the vehicles on the road.
        """
        # Also queue vehicles that arrive before the next tick, since cells pass between ticks.
        self._vehicles, self._owned = vehicles, None
        first, self._queued = self._queued, count_until(self._arrivals, t_s + self._tick_s)
        self._demand(self._arrivals[first : self._queued])
        full = self._full_lanes(vehicles)
        if self._outside_traffic is not None:
            full |= self._outside_traffic.full_lanes()
        admissions = self._meter.admit(t_s, full)
        if self._outside_traffic is not None:
            occupied = frozenset(one.controller.hold_cell for one in vehicles.values())
            admissions += self._outside_traffic.admit(t_s, self._meter, occupied)
        if self._rolling:
            admissions = [self._with_ownerless(admission) for admission in admissions]
            for admission in admissions:
                column, lane = admission.cell
                self._next[lane].append((column, Name(admission.arrival.vehicle)))
                self._given.update(admission.more_cells)
        self._entered += len(admissions)
        self._census_changed |= bool(admissions)
        return admissions

    def _demand(self, coming: Sequence[Arrival]) -> None:
        """Queue vehicles that have come to the start, and whose exits are not full."""
        outside, held = self._outside_traffic, [*self._held, *coming]
        if outside is None or not held:
            for arrival in held:
                self._meter.demand(arrival)
            return
        on_road = (one.arrival for one in self._vehicles.values())
        going = Counter(one.destination for one in (*self._meter.waiting, *on_road))
        self._held.clear()
        waiting = Counter[str]()
        for arrival in held:
            to = arrival.destination
            if not waiting[to] and outside.has_room(to, going[to], self._was_held[to]):
                going[to] += 1
                self._meter.demand(arrival)
            else:
                waiting[to] += 1
                self._held.append(arrival)
        self._was_held = waiting

    def _with_ownerless(self, admission: Admission) -> Admission:
        """Add cells beside a vehicle from a ramp that have never had an owner.

        Without an owner no vehicle could enter them. A vehicle that changes columns reaches others.
        """
        column, lane = admission.cell
        if self._entry_m[lane] <= 0.0 or not self._keep_columns:
            return admission
        beside = [(column, other) for other in range(self._lanes) if other != lane]
        free = [cell for cell in beside if self._is_ownerless(cell)]
        self._given.update(free)
        self._ownerless.difference_update(free)
        self._unassigned = [cell for cell in self._unassigned if cell not in self._given]
        return evolve(admission, more_cells=(*admission.more_cells, *free))

    def _is_ownerless(self, cell: Cell) -> bool:
        """Return whether a cell has never had an owner."""
        first = self._ownerless_from[cell[1]]
        return cell not in self._given and (
            cell[0] >= first or cell in self._ownerless or cell in self._unassigned
        )

    def _full_lanes(self, vehicles: Mapping[Name, RoadVehicle]) -> set[int]:
        """Return the lanes in which a body at the entrance leaves too little room to brake.

        A ramp is full, too, while a queue at its end leaves no room for merging.
        """
        lattice = self._lattice
        entering = (0.0, lattice.speed_mps, 0.0, 0.0, 0.0, 0.0)
        full = set[int]()
        for vehicle in vehicles.values():
            s_m, speed_mps, accel_mps2, y_m, _, _ = vehicle.state
            if s_m > self._near_m:
                continue
            length_m, width_m = vehicle.size
            first, last = lattice.lanes_touched(y_m, width_m)
            waits = vehicle.controller.off_lattice is not None
            for lane in {*range(first, last + 1)} - full:
                beyond_m = s_m - self._entry_m[lane]
                if waits and s_m - length_m < self._merging_m.get(lane, -math.inf):
                    full.add(lane)
                    continue
                if not 0.0 <= beyond_m <= self._room_m:
                    continue
                body = Neighbour(0, beyond_m - length_m, speed_mps, accel_mps2)
                spare_m = self._brake.spare_m(entering, 0.0, (0.0, 0.0), [body])
                slow = speed_mps < 0.5 * lattice.speed_mps
                if spare_m < (QUEUE_ROOM_M if slow else 0.0):
                    full.add(lane)
        return full

    def close_formations(self, t_s: float) -> list[ClosedFormation]:
        """Return the formations closed since the last call.

        Must be called after `admit` and `control_lane_ends`, which determine their members.
        """
        if self._builder is None:
            return []
        closed = self._builder.closed(t_s) + self._lane_ends.formations
        self._lane_ends.formations.clear()
        self._closed += closed
        if self._builder.closed_to > self._closed_to:
            self._closed_to = self._builder.closed_to
            self._census_changed = True
        return closed

    def assign_empty_cells(self, vehicles: Mapping[Name, RoadVehicle]) -> None:
        """Assign empty cells at the entrance to vehicles near them (rolling operation).

        A cell is assigned once no vehicle can enter it any more. A cell without a vehicle nearby
        waits for the next vehicles; if it is too far ahead of them, it remains without an owner.
        """
        if not self._rolling:
            return
        self._owned = None
        for lane in range(self._lanes):
            closed = self._meter.closed_column(lane)
            if self._outside_traffic is not None and lane in self._outside_traffic.start_lanes:
                closed += 1  # a vehicle from upstream may touch it
            for column in range(self._assigned_to[lane] - 1, closed - 1, -1):
                if self._next[lane] and self._next[lane][0][0] == column:
                    self._store_recent(column, lane, self._next[lane].pop(0)[1])
                elif (
                    not self._lane_ends.is_kept_free((column, lane))
                    and (column, lane) not in self._given
                    and (lane not in self._shared_lanes or self._is_free((column, lane)))
                ):
                    self._assign((column, lane), vehicles)
            self._assigned_to[lane] = closed
        unassigned, self._unassigned = self._unassigned, []
        for cell in unassigned:
            if cell[0] <= self._assigned_to[cell[1]] + 2 * self._max_empty:
                self._assign(cell, vehicles)
            else:
                self._ownerless.add(cell)

    def _is_free(self, cell: Cell) -> bool:
        """Return whether a vehicle on a ramp can use a cell.

        Behind an exit in the same lane, no vehicle may own it. A pending transfer may give the cell
        to a vehicle later; those of vehicles that have left are in `_lost`. Vehicles that do not
        change columns must not enter beside a gap that is kept free, which they could not enter.
        """
        column, lane = cell
        if self._keep_columns and any(
            self._lane_ends.is_kept_free((column, beside)) for beside in (lane - 1, lane + 1)
        ):
            return False
        if lane not in self._shared_lanes:
            return True
        if self._owned is None:
            self._owned = self._lost.union(
                *(vehicle.controller.store.possible_cells for vehicle in self._vehicles.values())
            )
        return cell not in self._owned

    def _assign(self, cell: Cell, vehicles: Mapping[Name, RoadVehicle]) -> None:
        """Assign an empty cell to a nearby vehicle, preferably one ahead of it in its lane.

        If vehicles keep their columns, only those of its column need the cell: preferably one of
        them, so that few vehicles have to agree to a move.
        """
        column, lane = cell
        first, last = column - self._max_empty, column + self._max_empty
        near = [
            (
                self._keep_columns and entered != column,
                entered < column,
                number != lane,
                abs(entered - column),
                name,
            )
            for entered, number, name in self._recent
            if first <= entered <= last
            and name in vehicles
            and vehicles[name].controller.off_lattice is None
            and self._keeps_cells(vehicles[name])
        ]
        if near:
            vehicles[min(near)[-1]].controller.store.assign_cell(cell)
        else:
            self._unassigned.append(cell)

    def _keeps_cells(self, vehicle: RoadVehicle) -> bool:
        """Return whether a vehicle may get empty cells.

        Where a ramp follows an exit, vehicles that leave by the exit get none: those from the ramp
        need the agreement of the owners of such cells, while these leave.
        """
        return not self._shared_lanes or vehicle.arrival.destination == END_OF_ROAD

    def _store_recent(self, column: int, lane: int, name: Name) -> None:
        """Add an entered vehicle to the recent ones, and drop those far ahead of it."""
        far = max(self._assigned_to) + 2 * self._max_empty
        self._recent = [one for one in self._recent if one[0] <= far]
        self._recent.append((column, lane, name))

    def control_lane_ends(
        self, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> list[LaneEndChange]:
        """Take vehicles off the lattice whose lanes end, and bring them back.

        Must be called before `assign_empty_cells`, from which gaps are excluded.
        """
        changes = list(self._lane_ends.update(vehicles, t_s))
        self._census_changed |= bool(changes)
        return changes

    def on_left(
        self, vehicle: RoadVehicle, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> None:
        """Count a vehicle that has left the road, and pass its cells on (rolling operation).

        Args:
            vehicle: the vehicle that has left. No later plan can contain it, so the cells that it
                owns whichever way its pending transfer resolves can be assigned again.
            vehicles: the vehicles on the road.
            t_s: road time.
        """
        self._left += 1
        self._census_changed = True
        if not self._rolling:
            return
        lattice, certain = self._lattice, vehicle.controller.store.certain_cells
        self._lost |= {
            cell
            for cell in vehicle.controller.store.possible_cells - certain
            if cell[1] in self._shared_lanes
        }
        for cells in (self._given, self._ownerless, self._lost):
            cells -= {
                cell for cell in cells if lattice.passing_time_s(cell[0], self._length_m) < t_s
            }
        on_lattice = [
            one
            for one in vehicles.values()
            if one.controller.off_lattice is None and self._keeps_cells(one)
        ]
        if not on_lattice:
            return
        for column, lane in sorted(certain):
            s_m = lattice.cell_s_m(column, t_s)
            if lane in self._shared_lanes and s_m < self._entry_m[lane]:
                continue  # for vehicles on the ramp
            if s_m < self._length_m:
                near = min(
                    on_lattice,
                    key=lambda one: (
                        abs(one.controller.hold_cell[0] - column),
                        abs(one.controller.hold_cell[1] - lane),
                        one.name,
                    ),
                )
                near.controller.store.assign_cell((column, lane))

    def publish(
        self, tick: int, t_s: float, on_road: Collection[RoadVehicle], *, ended: bool = False
    ) -> Iterator[Effect]:
        """Publish the clock; publish the census on changes, every 10 ticks, and when a run ends."""
        yield Send(CLOCK, self.clock(tick, t_s, len(on_road), ended=ended))
        due = ended or tick >= self._census_sent_tick + CENSUS_EVERY_TICKS
        announced = self.update_announcements(t_s)
        if announced or due or self._census_changed:
            self._census_changed = False
            self._census_sent_tick = tick
            yield Send(CENSUS, self.census(t_s, on_road))

    def clock(self, tick: int, t_s: float, on_road: int, *, ended: bool = False) -> RoadClock:
        """Return the clock message of a tick, with counts of vehicles."""
        return RoadClock(
            tick=tick,
            t_s=t_s,
            demanded=self._demanded + self._others_demanded,
            entered=self._entered,
            on_road=on_road,
            left=self._left,
            ended=ended,
            bridge=self._bridge,
        )

    def is_over(self, t_s: float, vehicles: Mapping[Name, RoadVehicle]) -> bool:
        """Return whether the road will not change any more.

        No vehicle will enter, and all have left, or have stood for long in a queue behind an exit.
        """
        if any(one.state[1] > MOVING_MPS for one in vehicles.values()):
            self._moved_s = t_s
        if not vehicles:
            return self.exhausted(t_s)
        # A queue may reach back to the start, where more vehicles wait.
        outside = self._outside_traffic
        return outside is not None and outside.exhausted and t_s >= self._moved_s + STANDING_S

    @property
    def never_came(self) -> Sequence[Arrival]:
        """The vehicles that were to come from outside, and have not come near an entrance."""
        return () if self._outside_traffic is None else self._outside_traffic.never_came

    def exhausted(self, t_s: float) -> bool:
        """Return whether no vehicle waits or will arrive."""
        return (
            self._queued == len(self._arrivals)
            and not self._meter.waiting
            and (self._outside_traffic is None or self._outside_traffic.exhausted)
            and (not self._arrivals or self._arrivals[-1].t_s <= t_s)
        )

    def update_announcements(self, t_s: float) -> bool:
        """Update the announcements; return whether they have changed."""
        before = self._announced
        self._announced = self._announcements(t_s)
        return self._announced != before

    def census(self, t_s: float, on_road: Iterable[RoadVehicle]) -> Census:
        """Return the census: vehicles on the road, announcements and closed formations."""
        vehicles = tuple(on_road)
        off_lattice = self._lane_ends.bodies({vehicle.name: vehicle for vehicle in vehicles})
        # A formation without members on the lattice counts as deserted; others may have joined it.
        present = {one.formation for one in vehicles if one.controller.off_lattice is None}
        self._closed = [closed for closed in self._closed if closed.first_block in present]
        return Census(
            t_s=t_s,
            on_road=tuple(
                CensusEntry(
                    vehicle=vehicle.name,
                    cell=vehicle.admission.cell,
                    preferred_lane=vehicle.admission.arrival.preferred_lane,
                    entered_s=vehicle.admission.t_s,
                    off_lattice=off_lattice.get(vehicle.name),
                    destination=Name(vehicle.admission.arrival.destination),
                    vehicle_type=Name(vehicle.admission.arrival.vehicle_type),
                    ready_s=vehicle.ready_s,
                )
                for vehicle in vehicles
            ),
            announced=self._announced,
            formations=tuple(self._closed),
            closed_to=self._closed_to,
            bridge=self._bridge,
        )

    def _announcements(self, t_s: float) -> tuple[Announcement, ...]:
        """Return the vehicles that may enter within `announce_s`."""
        room = [self._announced_per_lane] * self._lanes
        coming = []
        until = count_until(self._arrivals, t_s + self._announce_s)
        held = Counter[str]()
        for arrival in self._held:
            held[arrival.destination] += 1
            if held[arrival.destination] <= HELD_ANNOUNCED:
                coming.append(arrival)
        for arrival in (*self._meter.waiting, *self._arrivals[self._queued : until]):
            if room[arrival.lane] > 0:
                room[arrival.lane] -= 1
                coming.append(arrival)
        coming += () if self._outside_traffic is None else self._outside_traffic.announced(t_s)
        return tuple(
            Announcement(
                vehicle=Name(arrival.vehicle),
                lane=arrival.lane,
                preferred_lane=arrival.preferred_lane,
                arrival_s=arrival.t_s,
            )
            for arrival in sorted(coming, key=lambda arrival: (arrival.t_s, arrival.vehicle))
        )


def _goals(scenario: Scenario, arrival: Arrival) -> Goals:
    """Return where a vehicle may leave the road."""
    numbers = scenario.geometry.goal_sections(
        arrival.preferred_lane, arrival.destination, arrival.vehicle_type
    )
    sections = [scenario.geometry.sections[number] for number in numbers]
    lanes = {section.lane for section in sections}
    return Goals(tuple(sorted(lanes)), max(section.to_m for section in sections))
