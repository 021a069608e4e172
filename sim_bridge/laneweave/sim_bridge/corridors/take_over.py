"""Takes over the vehicles that SUMO drives to the entrances of a corridor.

These are its ramps, and the start of the road for vehicles that come from upstream. Each vehicle
gets the first cell of its lane, behind the vehicle before, into which it can settle from its speed
in time for changing lanes. If it would be at the entrance too early for this cell, it is advised to
drive more slowly; the time that it loses counts as delay. When its front is at the entrance,
laneweave takes over.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from itertools import chain, takewhile
from typing import Protocol

from attrs import evolve, frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import READY_LATE_S, SNAPSHOT_S
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.vehicle.lane_ends import dead_ends
from laneweave.protocol.wire.messages import OffLattice
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody
from laneweave.sim_bridge.corridors.exit_room import QUEUEING_MPS, ExitRoom
from laneweave.sim_bridge.corridors.hand_over import HandOver
from laneweave.sim_bridge.corridors.settling import (
    LONGEST_S,
    SLOW_ENTRY_S,
    before_rest_s,
    fall_back,
    settling_s,
)
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.demand_queue import OnRoadT, OutsideTraffic
from laneweave.sim_bridge.road.entry import TIME_TOLERANCE_S, Admission, EntryMeter, EntryState

ADVICE_SHARE = 0.9
"""Share of its maximum acceleration with which a vehicle is expected to accelerate."""
MIN_ADVICE_MPS = 3.0
"""Lowest speed that a vehicle is advised to drive."""
UPSTREAM_SHARE = 0.6
"""Share of its own speed at which a vehicle is advised to drive at least before a junction."""
NEAR_S = 2.0
"""Time before its arrival at the start within which no other vehicle enters before a vehicle."""
KEEPS_LANE_S = 3.0
"""Time before its arrival at the start from which a vehicle keeps its lane. It could otherwise
change into a lane in the tick in which another vehicle enters there."""
DEPARTS_S, AWAITED_S = 0.3, 5.0
"""Time before and after its departure within which a vehicle may appear just before the start.
SUMO sees the vehicles that have entered a tick before; it may be unable to let it depart at once.
"""
EARLY_S = 0.3
"""Time by which a vehicle may be too early without advice."""
CENSUS_S = 0.7
"""Time after its entry in which coordinators know a vehicle."""
BESIDE_COLUMNS = 1
"""Number of columns by which a vehicle rather falls back than entering beside another vehicle."""
STANDING_S = 120.0
"""Time for which all vehicles stand in queues behind exits when a run ends, after all entries."""
VEHICLES_PER_CHANGE = 2
"""Number of vehicles by which a queue has to be shorter for each lane change towards it."""
MAX_COLUMNS = 40
"""Maximum number of columns that are tried."""


@frozen
class Approaching:
    """A vehicle that SUMO drives towards an entrance."""

    arrival: Arrival
    """With the lane to which it comes."""
    s_m: float
    """Position of its front on the road; it is negative before the start."""
    speed_mps: float
    limits: tuple[tuple[float, float], ...]
    """Where each lane on its way ends [m], from its own on, and how fast it drives there [m/s]."""
    upstream: bool = False
    """Whether it still has to pass a junction where ways join, so that others may come before."""


class SumoTraffic(Protocol):
    """What take-over sees of the vehicles that SUMO drives, and what it asks of them."""

    @property
    def start_lanes(self) -> tuple[int, ...]:
        """Lanes of the road into which lanes lead at its start."""

    @property
    def departing(self) -> Sequence[Arrival]:
        """Vehicles that depart near their entrances, by time."""

    @property
    def outside(self) -> Sequence[Arrival]:
        """All vehicles that come from outside."""

    @property
    def exhausted(self) -> bool:
        """Whether no more vehicles will come."""

    def approaching(self, entry_point: int) -> Sequence[Approaching]:
        """Return the vehicles that approach an entry point, the first one first."""

    def others(self) -> Sequence[OtherBody]:
        """Return the bodies of SUMO's vehicles near the road."""

    def advise(self, vehicle: str, speed_mps: float | None) -> None:
        """Advise a vehicle's speed; None: its driver decides."""

    def keep_lane(self, vehicle: str) -> None:
        """Forbid a vehicle to change lanes, until it is taken over."""


class TakeOver(OutsideTraffic):
    """Takes vehicles over from SUMO."""

    def __init__(self, scenario: Scenario, world: SumoTraffic) -> None:
        """Begin without vehicles on their way to the entrances."""
        self._world = world
        self._lattice = scenario.lattice
        self._limits = {name: one.limits for name, one in scenario.types.items()}
        self._points = points = scenario.geometry.entry_points
        self._at_m = {
            number: point.at_m
            for number, point in enumerate(points)
            if point.entrance != MAIN_ENTRANCE or number in world.start_lanes
        }
        """Positions of the entry points to which SUMO drives vehicles, by number."""
        self._before_rest_s = {
            name: before_rest_s(scenario.types.room_ahead_m, one.limits)
            for name, one in scenario.types.items()
        }
        self._slot_s = scenario.timing.cycles_s[0]
        ends = dead_ends(scenario)
        self._lines_m = {
            number: min(
                (
                    end.line_m
                    for end in ends
                    if end.lane == points[number].lane and end.end_m > at_m
                ),
                default=scenario.road.length_m,
            )
            for number, at_m in self._at_m.items()
        }
        """Where moves out of the lane of each entry point have ended."""
        self._exit_room = ExitRoom(scenario)
        self._hand_over = HandOver(scenario)
        self._going = Counter[int]()
        """Vehicles that queue at the entrances or are on the road, by preferred lane."""
        self._occupied = set[Cell]()
        """Cells in which vehicles are, or to which they move."""
        self._known: dict[str, Arrival] = {}
        """Approaching vehicles, each with the time at which it was expected first."""
        self._announce_s = scenario.runtime.announce_s
        self._departing = deque(world.departing)
        self._due: dict[str, Arrival] = {}
        """Announced vehicles that have not departed."""
        self._moved_s = 0.0
        """Road time at which a vehicle on the road moved the last time."""

    def demanded(self, t_s: float) -> Sequence[Arrival]:
        """Return the vehicles that have come near an entrance since the last call."""
        new = []
        for point, at_m in self._at_m.items():
            for one in self._world.approaching(point):
                name = one.arrival.vehicle
                if name not in self._known:
                    fastest_mps = max(one.speed_mps, self._lattice.speed_mps)
                    expected_s = t_s + (at_m - one.s_m) / fastest_mps
                    self._known[name] = evolve(one.arrival, t_s=expected_s)
                    self._due.pop(name, None)
                    new.append(self._known[name])
        return new

    def announced(self, t_s: float) -> Sequence[Arrival]:
        """Return the vehicles that approach, or depart near an entrance within `announce_s`."""
        while self._departing and self._departing[0].t_s <= t_s + self._announce_s:
            first = self._departing.popleft()
            self._due[first.vehicle] = first
        return [*self._known.values(), *self._due.values(), *self._exit_room.announced]

    @property
    def exhausted(self) -> bool:
        """Whether no more vehicles will come."""
        return self._world.exhausted

    @property
    def never_came(self) -> Sequence[Arrival]:
        """The vehicles that were to come, and have not come near an entrance."""
        return [one for one in self._world.outside if one.vehicle not in self._known]

    @property
    def start_lanes(self) -> Sequence[int]:
        """Lanes to whose beginning vehicles come from upstream."""
        return self._world.start_lanes

    def release(self, coming: Sequence[Arrival], ahead: Iterable[Arrival]) -> Sequence[Arrival]:
        """Return which of the vehicles at the start may enter; see `ExitRoom`."""
        known = [*ahead]
        self._going = Counter(one.preferred_lane for one in known)
        return self._exit_room.release(coming, known, self._world.others)

    def full_lanes(self, t_s: float) -> set[int]:
        """Return the lanes that no vehicle may enter at their start now.

        A queue ahead leaves no room to brake, or a vehicle from upstream would come too close. A
        vehicle that SUMO lets depart just before the start may appear in any lane.
        """
        full = self._hand_over.full_lanes(self._world.others())
        if self._departs_upstream(t_s):
            return full | {*self._world.start_lanes}
        return full | {
            lane
            for lane in self._world.start_lanes
            for one in self._world.approaching(lane)[:1]
            if one.s_m > -NEAR_S * max(one.speed_mps, self._lattice.speed_mps)
        }

    def _departs_upstream(self, t_s: float) -> bool:
        """Return whether a vehicle may appear just before the start of the road, in this tick."""
        due = takewhile(
            lambda one: one.t_s <= t_s + DEPARTS_S,
            chain(self._due.values(), self._departing),
        )
        return any(
            self._points[one.entry_point].entrance == MAIN_ENTRANCE and one.t_s > t_s - AWAITED_S
            for one in due
        )

    def admit(self, t_s: float, meter: EntryMeter, occupied: Iterable[Cell]) -> list[Admission]:
        """Take over the vehicles whose fronts are at their entrances, and advise the others."""
        admissions = []
        self._occupied = set(occupied)
        for point, at_m in self._at_m.items():
            column = meter.next_open(point, t_s)
            for one in self._world.approaching(point):
                if one.arrival.vehicle not in self._known:
                    continue  # it has come since `demanded`
                if one.s_m < at_m:
                    column = self._advise(one, column, t_s, meter)
                    continue
                admissions.append(self._take(one, column, t_s, meter))
                self._going[admissions[-1].arrival.preferred_lane] += 1
                self._occupied.add(admissions[-1].cell)
                column = admissions[-1].cell[0] - 1
                del self._known[one.arrival.vehicle]
        return admissions

    def given_back(self, vehicles: Iterable[OnRoadT]) -> Iterable[OnRoadT]:
        """Return the vehicles that SUMO takes back before their exits; see `HandOver`."""
        return self._hand_over.given_back(vehicles, self._world.others())

    def plans_end(self) -> tuple[OffLattice, ...]:
        """Return lanes with positions beyond which no plan may use them."""
        return self._hand_over.plans_end(self._world.others())

    def is_stuck(self, t_s: float, *, moving: bool) -> bool:
        """Return whether all vehicles have stood for long in queues, and no more will come.

        A queue may reach back to the start, where more vehicles wait.
        """
        if moving:
            self._moved_s = t_s
        return self.exhausted and t_s >= self._moved_s + STANDING_S

    def _take(self, one: Approaching, first: int, t_s: float, meter: EntryMeter) -> Admission:
        """Return the entry of a vehicle whose front is at its entrance."""
        arrival = self._arrival(one)
        slower_mps = self._lattice.speed_mps - one.speed_mps
        limits = self._limits[arrival.vehicle_type]

        def ahead_m(column: int) -> float:
            return one.s_m - self._lattice.cell_s_m(column, t_s)

        def entry(column: int) -> tuple[float, float] | None:
            time_s = settling_s(ahead_m(column), slower_mps, self._lattice.speed_mps, limits)
            return None if time_s is None else (t_s, time_s)

        chosen = self._choose(arrival, first, meter, entry)
        if chosen is not None:
            column, _, time_s = chosen
        else:
            column, time_s = first, LONGEST_S
            while not meter.is_possible(arrival, column):
                column -= 1
        if not meter.take(arrival, column):
            raise RuntimeError(f"{arrival.vehicle} cannot have column {column}")
        ready_s = max(0.0, time_s - self._before_rest_s[arrival.vehicle_type])
        start = EntryState(one.s_m, one.speed_mps, time_s, ready_s)
        more = meter.exit_cells(arrival, column)
        if self._at_m[arrival.entry_point] <= 0.0:
            # From the lanes beside it, no vehicle may enter the cells that it may touch. The last
            # one past the start is not assigned yet (`Roadside.assign_empty_cells`).
            last = first if (first + 1, arrival.lane) in self._occupied else first + 1
            more += tuple((ahead, arrival.lane) for ahead in range(column + 1, last + 1))
        return Admission(arrival, (column, arrival.lane), t_s, ahead_m(column), more, start)

    def _arrival(self, one: Approaching) -> Arrival:
        """Return the arrival of a vehicle in the lane to which it comes.

        If its route continues from several lanes, it prefers the one with the fewest vehicles of
        those that it can reach; a lane change has to save it the time that some vehicles need at
        the stop line.
        """
        arrival = evolve(one.arrival, t_s=self._known[one.arrival.vehicle].t_s)
        lanes = arrival.right_lanes
        if len(lanes) < 2:
            return arrival
        others = self._world.others()
        queueing = (
            other.lane
            for other in others
            if other.rear_m < other.exit_m or other.speed_mps < QUEUEING_MPS
        )
        there = self._going + Counter(queueing)
        within_m = self._hand_over.last_lines_m(others)
        settled_m = max(one.s_m, 0.0) + SLOW_ENTRY_S * self._lattice.speed_mps

        def cost(lane: int) -> tuple[bool, int, int]:
            away = abs(lane - arrival.lane)
            late = settled_m + self._hand_over.moves_m(away) > within_m.get(lane, 0.0)
            return away > 0 and late, there[lane] + VEHICLES_PER_CHANGE * away, away

        return evolve(arrival, preferred_lane=min(lanes, key=cost))

    def _choose(
        self,
        arrival: Arrival,
        first: int,
        meter: EntryMeter,
        entry: Callable[[int], tuple[float, float] | None],
    ) -> tuple[int, float, float] | None:
        """Return the best column for a vehicle, its entry time and settling time; None: none.

        `first` is the first column that it can have. `entry` returns when it would enter a column,
        and how long it would settle; None: it cannot get there.
        """
        found: list[tuple[bool, int, int, float, float]] = []
        for column in range(first, first - MAX_COLUMNS, -1):
            times = entry(column)
            if times is None or not meter.is_possible(arrival, column):
                continue
            beside = 0
            while (column, arrival.lane + 1 + beside) in self._occupied:
                beside += 1
            # It rather falls back than entering beside a vehicle that has to make room first.
            cost = BESIDE_COLUMNS * (beside > 0) - column
            # If it is too late, it will stop at the end of its lane.
            late = self._is_late(arrival, column, times, beside)
            found.append((late, cost, column, *times))
            if not late and not beside:
                break  # none behind is better
        return min(found)[2:] if found else None

    def _is_late(
        self, arrival: Arrival, column: int, times: tuple[float, float], beside: int
    ) -> bool:
        """Return whether a vehicle cannot change lanes in time.

        `times` says when it enters, and how long it settles; `beside` is the number of vehicles
        that make room before, one after another.
        """
        entry_s, settle_s = times
        move_m = self._slot_s * self._lattice.speed_mps
        ahead_m = self._lines_m[arrival.entry_point] - move_m - self._lattice.cell_s_m(column, 0.0)
        # The last slot in which it can change lanes, and the first that is planned with it.
        last = math.floor(ahead_m / move_m + TIME_TOLERANCE_S)
        planned = math.ceil((entry_s + CENSUS_S - SNAPSHOT_S) / self._slot_s) + 1
        ready_s = entry_s + settle_s - self._before_rest_s[arrival.vehicle_type]
        latest_s = min(last * self._slot_s + READY_LATE_S, ahead_m / self._lattice.speed_mps)
        return ready_s > latest_s or last < planned + beside

    def _advise(self, one: Approaching, first: int, t_s: float, meter: EntryMeter) -> int:
        """Advise a vehicle for the first cell that it can reach; return the column behind it."""
        arrival = self._arrival(one)
        lattice, limits = self._lattice, self._limits[arrival.vehicle_type]
        at_m = self._at_m[arrival.entry_point]
        distance_m = at_m - one.s_m
        if at_m <= 0.0 and distance_m <= KEEPS_LANE_S * max(one.speed_mps, lattice.speed_mps):
            self._world.keep_lane(arrival.vehicle)
        accel_mps2 = ADVICE_SHARE * limits.max_accel_mps2
        takes_s, comes_mps = _soonest(one, at_m, accel_mps2, lattice.speed_mps)
        slower_mps = math.ceil(lattice.speed_mps - comes_mps)
        falls_back_m, settle_s = fall_back(slower_mps, lattice.speed_mps, limits)
        comes_s = t_s + takes_s
        cell_m = at_m - falls_back_m

        def entry(column: int) -> tuple[float, float] | None:
            at_ramp_s = lattice.passing_time_s(column, cell_m)
            # Earlier ones will have passed.
            return (at_ramp_s, settle_s) if at_ramp_s >= comes_s - EARLY_S else None

        chosen = self._choose(arrival, first, meter, entry)
        own_mps = one.limits[0][1]
        slower_ahead = any(limit_mps < own_mps for _, limit_mps in one.limits)
        # SUMO's drivers may be inattentive, and then accelerate less than they can.
        advice = None if slower_ahead else min(own_mps, lattice.speed_mps)
        if chosen is not None:
            column, wanted_s, _ = chosen
            first = first if one.upstream else column - 1
            if wanted_s > comes_s + EARLY_S:
                advice = _slow_mps(distance_m, wanted_s - t_s, comes_mps, accel_mps2) or advice
                if advice is not None and one.upstream:
                    advice = max(advice, UPSTREAM_SHARE * own_mps)
        self._world.advise(arrival.vehicle, advice)
        return first


def _soonest(
    one: Approaching, at_m: float, accel_mps2: float, fastest_mps: float
) -> tuple[float, float]:
    """Return the time in which a vehicle can be at a position, and its speed there."""
    takes_s, s_m, speed_mps = 0.0, one.s_m, one.speed_mps
    for end_m, own_limit_mps in one.limits:
        if s_m >= at_m:
            break
        to_m, limit_mps = min(end_m, at_m), min(own_limit_mps, fastest_mps)
        speed_mps = min(speed_mps, limit_mps)
        takes_s += _shortest_s(to_m - s_m, speed_mps, limit_mps, accel_mps2)
        speed_mps = min(limit_mps, math.sqrt(speed_mps**2 + 2.0 * accel_mps2 * (to_m - s_m)))
        s_m = to_m
    return takes_s, speed_mps


def _shortest_s(distance_m: float, speed_mps: float, end_mps: float, accel_mps2: float) -> float:
    """Return the time for a distance, accelerating to `end_mps` and then at this speed."""
    gained_m = (end_mps**2 - speed_mps**2) / (2.0 * accel_mps2)
    if gained_m >= distance_m:
        end_mps = math.sqrt(speed_mps**2 + 2.0 * accel_mps2 * distance_m)
        return (end_mps - speed_mps) / accel_mps2
    return (end_mps - speed_mps) / accel_mps2 + (distance_m - gained_m) / end_mps


def _slow_mps(distance_m: float, time_s: float, end_mps: float, accel_mps2: float) -> float | None:
    """Return the speed at which a vehicle drives first, to come in time and at `end_mps`.

    None: it is time to accelerate.
    """
    low, high = MIN_ADVICE_MPS, end_mps
    if distance_m <= (end_mps**2 - low**2) / (2.0 * accel_mps2):
        low = math.sqrt(max(end_mps**2 - 2.0 * accel_mps2 * distance_m, 0.0))
        if low >= end_mps - 0.5:
            return None
    for _ in range(12):
        middle = 0.5 * (low + high)
        later = _cruising_s(distance_m, middle, end_mps, accel_mps2) > time_s
        low, high = (middle, high) if later else (low, middle)
    return high


def _cruising_s(distance_m: float, slow_mps: float, end_mps: float, accel_mps2: float) -> float:
    """Return the time for a distance, at a slow speed and then accelerating to `end_mps`."""
    gained_m = (end_mps**2 - slow_mps**2) / (2.0 * accel_mps2)
    return (distance_m - gained_m) / slow_mps + (end_mps - slow_mps) / accel_mps2
