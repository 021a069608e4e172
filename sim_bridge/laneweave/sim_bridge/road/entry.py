"""Entry metering at the start of the road and on ramps.

A vehicle enters with the lattice speed v_F, at s = 0 or at the beginning of a ramp. Of the free
cells of its lane behind its predecessor, it gets the first that passes this position at most
`spread_s` before or after the vehicle, and settles in this cell. With interlaced entry only every
other cell may be entered, as in the paper's driving structure. Vehicles of a lane enter in order
of arrival, at least one column's time apart.

A lane may have several entry points (`RoadGeometry.entry_points`): ramps one after another, or one
behind the end of a lane that is open at the start.

With formations, `formation_building` decides whether a formation admits a vehicle.

Vehicles of some types (trucks) do not change columns (`VehicleType.moves`). Two of them in a
column could not pass each other, so they enter the same column only if they can leave the road in
lanes of the same order. They enter exactly in their cells: a weak vehicle would take long to
settle, and a long one behind another has little room to approach it.

A ramp may follow an exit or a dead end in the same lane (`RoadGeometry.shared_lanes`). Cells of
such a lane are not assigned to vehicles near them before the last ramp: each vehicle that leaves by
an exit before gets the cells of its column in the lanes of the exit, unless they have an owner, and
once it has left, a ramp can use them.

While parts of lanes are closed for a time, each column gets only as many vehicles from the start of
the road as lanes are open beside the part. Vehicles then pass it without changing columns.

Decisions do not depend on later arrivals: they are made in order of time and, at equal times, of
the numbers of entry points.
"""

from __future__ import annotations

import math
from bisect import insort
from collections import deque
from collections.abc import Callable, Collection, Sequence

from attrs import frozen

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.road_tables import EntryPoint
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.formation_building import FormationBuilder

LOAD_S = 60.0
"""Time over which the number of vehicles in a column is averaged."""
_MAX_KEEPING_COLUMNS = 4096
"""Number of columns, more than there are on a road, whose vehicles are remembered."""
TIME_TOLERANCE_S = 1e-9
"""Rounding tolerance for comparing ticks with passing times."""


@frozen
class Admission:
    """Entry of a vehicle at its entrance with speed v_F."""

    arrival: Arrival
    cell: Cell
    t_s: float
    """Road time at which the vehicle passes the entrance."""
    offset_m: float = 0.0
    """Distance by which the vehicle is ahead of its cell."""
    more_cells: tuple[Cell, ...] = ()
    """Further cells of its column that the vehicle gets."""
    start: EntryState | None = None
    """How the vehicle enters if not at v_F beside its cell."""


@frozen
class EntryState:
    """State of a vehicle that a simulator has driven to its entrance."""

    s_m: float
    speed_mps: float
    settle_s: float
    """Time in which it settles in its cell."""
    ready_s: float
    """Time after which it is so near to its cell that it is ready for plans."""


@frozen
class Goals:
    """Where a vehicle may leave the road."""

    lanes: tuple[int, ...]
    end_m: float
    """The last of the ends of these lanes."""


class EntryMeter:
    """Incremental assignment of lattice cells to arriving vehicles."""

    def __init__(
        self,
        lattice: Lattice,
        spread_s: float,
        builder: FormationBuilder | None = None,
        *,
        interlaced: bool = False,
        entry_points: Sequence[EntryPoint] = (),
        column_bound: Collection[str] = (),
        goals_of: Callable[[Arrival], Goals] | None = None,
        shared_lanes: Collection[int] = (),
        is_free: Callable[[Cell], bool] | None = None,
    ) -> None:
        """Start with an empty road at road time 0.

        Args:
            lattice: the lattice whose cells are assigned.
            spread_s: maximum time between a vehicle and its cell at the entrance.
            builder: assigns entering vehicles to formations; None: no formations.
            interlaced: only every other cell may be entered.
            entry_points: where vehicles enter; empty: in each lane at s = 0.
            column_bound: types of vehicles that do not change columns.
            goals_of: returns where a vehicle may leave the road; None: in its preferred lane, if it
                has one, at the end of the road.
            shared_lanes: lanes in which a ramp follows an exit or a dead end.
            is_free: returns whether a vehicle on a ramp can use a cell; None: always.
        """
        self._goals_of = goals_of or self._goals
        self._shared_lanes = frozenset(shared_lanes)
        self._is_free = is_free
        self._column_bound = frozenset(column_bound)
        self._keeping_columns: dict[int, dict[tuple[int, float], Goals]] = {}
        """Where the vehicles of these types may leave, by column and then by (lane, negative
        position) of their entry: from the right to the left."""
        points = tuple(entry_points) or tuple(EntryPoint(lane) for lane in range(lattice.lanes))
        self._points = range(len(points))
        self._lanes = tuple(point.lane for point in points)
        self._entry_m = tuple(point.at_m for point in points)
        self._last_entry_m = dict(zip(self._lanes, self._entry_m, strict=True))
        """Position of the last entry point of each lane."""
        self._lattice = lattice
        self._builder = builder
        self._spread_s = spread_s
        self._interlaced = interlaced
        self._queues: list[list[Arrival]] = [[] for _ in points]
        self._names: set[str] = set()
        self._columns = [int(s_m // lattice.pitch_m) for s_m in self._entry_m]
        """Next column that vehicles can enter at each entry point."""
        self.most_in_column: int | None = None
        """Maximum number of vehicles of a column that enter at the start of the road, counting the
        lanes kept free; None: any number."""
        self._in_column: dict[int, int] = {}
        """This number by column, as long as vehicles may enter there."""
        self._entered_s: deque[float] = deque()
        """Times at which vehicles have entered at the start of the road, up to `LOAD_S` ago."""
        self._until_s = -math.inf
        """Time after which the next vehicles enter."""
        self._free_s = [-math.inf] * len(points)
        """Earliest time at which the next vehicle of each entry point may enter."""

    @property
    def waiting(self) -> tuple[Arrival, ...]:
        """Queued vehicles, ordered by entry point."""
        return tuple(arrival for queue in self._queues for arrival in queue)

    def next_column(self, point: int) -> int:
        """Return the next column that vehicles can enter at an entry point.

        With formations, that of all lanes at the start of the road.
        """
        if self._builder is None:
            return self._columns[point]
        return min(
            column
            for column, entry_m in zip(self._columns, self._entry_m, strict=True)
            if entry_m <= 0.0
        )

    def keep_free(self, point: int, count: int, t_s: float, *, passes_parts: bool = True) -> range:
        """Return the next columns of an entry point, which no vehicle may enter any more.

        Args:
            point: index of the entry point.
            count: number of columns.
            t_s: road time.
            passes_parts: whether its lane is one in which others pass closed parts of lanes, so
                that the columns have less room for them (`most_in_column`).
        """
        first = self.next_column(point)
        if self._builder is not None:
            return self._builder.reserve(first, count, t_s)
        self._columns[point] = first - count
        kept = range(first - count + 1, first + 1)
        if passes_parts and self._entry_m[point] <= 0.0:
            for column in kept:
                self._count_in(column)
        return kept

    def vehicles_in_column(self, t_s: float) -> float:
        """Return the mean number of vehicles of a column that entered at the start of the road."""
        self._forget_entered(t_s)
        entered_s, column_s = self._entered_s, self._lattice.pitch_m / self._lattice.speed_mps
        return len(entered_s) * column_s / max(column_s, min(t_s, LOAD_S))

    def _forget_entered(self, t_s: float) -> None:
        while self._entered_s and self._entered_s[0] < t_s - LOAD_S:
            self._entered_s.popleft()

    def points_kept_free(self, point: int) -> Collection[int]:
        """Return the entry points at which `keep_free` keeps columns free: with formations, all."""
        return (point,) if self._builder is None else self._points

    def closed_columns(self) -> Sequence[int]:
        """Return the rearmost column that vehicles can no longer enter at each entry point."""
        return [column + 1 for column in self._columns]

    def demand(self, arrival: Arrival) -> None:
        """Queue a vehicle for its entry point by arrival; its arrival may be in the future.

        Raises:
            ValueError: an entry point or a lane does not exist, or the vehicle is already queued.
        """
        lanes, point = range(self._lattice.lanes), arrival.entry_point
        if arrival.preferred_lane not in (ANY_LANE, *lanes):
            raise ValueError(f"{arrival} needs lanes 0 to {self._lattice.lanes - 1}")
        if point not in self._points or self._lanes[point] != arrival.lane:
            raise ValueError(f"{arrival} needs an entry point of its lane")
        if arrival.vehicle in self._names:
            raise ValueError(f"{arrival.vehicle} is already waiting")
        self._names.add(arrival.vehicle)
        insort(self._queues[point], arrival, key=lambda other: other.t_s)

    def take(self, arrival: Arrival, column: int) -> bool:
        """Give a cell to a vehicle that does not queue; return whether it can have it.

        No later vehicle enters there in this column or ahead of it.
        """
        point = arrival.entry_point
        if column > self._columns[point] or not self.is_possible(arrival, column):
            return False
        self._enter(arrival, column)
        self._columns[point] = column - 1
        return True

    def is_possible(self, arrival: Arrival, column: int) -> bool:
        """Return whether nothing but its formation keeps a vehicle from a column of its lane."""
        from_ramp = self._entry_m[arrival.entry_point] > 0.0
        most, inside = self.most_in_column, self._in_column.get(column, 0)
        if most is not None and inside >= most and not from_ramp:
            return False
        if from_ramp and self._is_free is not None and not self._is_free((column, arrival.lane)):
            return False
        return arrival.vehicle_type not in self._column_bound or self._can_keep_column(
            column, arrival
        )

    def next_open(self, point: int, t_s: float) -> int:
        """Return the next column that a vehicle can enter at an entry point at a road time."""
        self._skip(point, t_s)
        return self._columns[point]

    def admit(self, until_s: float, full: Collection[int] = ()) -> list[Admission]:
        """Return the vehicles that have entered since the last call, by time, then lane.

        Args:
            until_s: usually the current road time.
            full: entry points without room, at which no vehicle may enter now.
        """
        admissions = []
        points = [point for point in self._points if point not in full]
        while points:
            t_s, point = min((self._entry_s(point), point) for point in points)
            if t_s > until_s + TIME_TOLERANCE_S:
                break
            column = self._columns[point]
            arrival = self._dequeue(point, column, t_s)
            if arrival is not None:
                late_s = self._passing_time_s(column, point) - t_s
                offset_m = late_s * self._lattice.speed_mps
                cell, more_cells = (column, arrival.lane), self.exit_cells(arrival, column)
                admissions.append(Admission(arrival, cell, t_s, offset_m, more_cells))
                if self._entry_m[point] <= 0.0:
                    self._entered_s.append(t_s)
                self._free_s[point] = t_s + self._lattice.pitch_m / self._lattice.speed_mps
            self._columns[point] -= 1
        self._until_s = until_s + TIME_TOLERANCE_S
        self._forget_entered(until_s)
        # Columns that have passed are not available to later arrivals.
        for point in self._points:
            self._skip(point, until_s - TIME_TOLERANCE_S)
        return admissions

    def _entry_s(self, point: int) -> float:
        """Return the time [s] at which the first vehicle of a queue can enter the next column."""
        queue = self._queues[point]
        if not queue:
            return math.inf
        # A lane may have been full, and a vehicle that was held back is queued late.
        ready_s = max(queue[0].t_s, self._free_s[point], self._until_s)
        self._skip(point, ready_s)
        passing_s = self._passing_time_s(self._columns[point], point)
        return max(ready_s, passing_s - self._spread_in(point))

    def _spread_in(self, point: int) -> float:
        """Return the maximum time between the first vehicle of a queue and its cell [s]."""
        queue = self._queues[point]
        return 0.0 if queue and queue[0].vehicle_type in self._column_bound else self._spread_s

    def _passing_time_s(self, column: int, point: int) -> float:
        """Return the road time at which a column passes an entry point."""
        return self._lattice.passing_time_s(column, self._entry_m[point])

    def _skip(self, point: int, t_s: float) -> None:
        """Advance an entry point to its first column that vehicles can enter at `t_s`."""
        lattice, column = self._lattice, self._columns[point]
        if self._builder is not None and self._entry_m[point] <= 0.0:
            column = int(min(column, self._builder.first_open_column))
        spread_s = self._spread_in(point)
        while self._passing_time_s(column, point) + spread_s < t_s - TIME_TOLERANCE_S or (
            self._interlaced and not lattice.interlaced((column, self._lanes[point]))
        ):
            column -= 1
        self._columns[point] = column

    def _dequeue(self, point: int, column: int, t_s: float) -> Arrival | None:
        """Remove and return the first vehicle of a queue, unless it needs a later column."""
        builder, queue = self._builder, self._queues[point]
        keeps_column = queue[0].vehicle_type in self._column_bound
        if not self.is_possible(queue[0], column):
            return None
        cell = column, self._lanes[point]
        if builder is not None and not builder.try_add(
            cell, queue[0].preferred_lane, t_s, column_bound=keeps_column
        ):
            return None
        self._enter(queue[0], column)
        self._names.discard(queue[0].vehicle)
        return queue.pop(0)

    def _enter(self, arrival: Arrival, column: int) -> None:
        """Note that a vehicle has entered in a column."""
        if arrival.vehicle_type in self._column_bound:
            self._keep_column(column, arrival)
        if self._entry_m[arrival.entry_point] <= 0.0:
            self._count_in(column)

    def _count_in(self, column: int) -> None:
        at_start = zip(self._columns, self._entry_m, strict=True)
        next_one = max(next_one for next_one, entry_m in at_start if entry_m <= 0.0)
        counts = self._in_column
        # Columns ahead of those that vehicles can enter are forgotten.
        self._in_column = {each: count for each, count in counts.items() if each <= next_one}
        self._in_column[column] = counts.get(column, 0) + 1

    def exit_cells(self, arrival: Arrival, column: int) -> tuple[Cell, ...]:
        """Return the cells for leaving by lanes in which a ramp follows the exit.

        There are none in its own lane. Where vehicles enter such a lane at the start of the road,
        its empty cells are assigned there.
        """
        goals = self._goals_of(arrival)
        return tuple(
            (column, goal)
            for goal in goals.lanes
            if goal in self._shared_lanes
            and goal != arrival.lane
            and self._entry_m[goal] > 0.0
            and goals.end_m <= self._last_entry_m[goal]
        )

    def _goals(self, arrival: Arrival) -> Goals:
        preferred = arrival.preferred_lane
        lanes = range(self._lattice.lanes) if preferred == ANY_LANE else (preferred,)
        return Goals(tuple(lanes), math.inf)

    def _can_keep_column(self, column: int, arrival: Arrival) -> bool:
        """Return whether a vehicle, and those of its column, can leave in the order of their lanes.

        These are the vehicles that do not change columns, and have not left yet. At each place at
        which some of them leave, the others are in other lanes, in the same order.
        """
        kept = {
            place: goals
            for place, goals in self._keeping_columns.get(column, {}).items()
            if goals.end_m > self._entry_m[arrival.entry_point]
        }
        if not kept:
            return True
        kept[self._place(arrival)] = self._goals_of(arrival)
        ordered = [kept[place] for place in sorted(kept)]
        return all(
            _in_order([one for one in ordered if one.end_m >= end_m], end_m, self._lattice.lanes)
            for end_m in {one.end_m for one in ordered}
        )

    def _place(self, arrival: Arrival) -> tuple[int, float]:
        return arrival.lane, -self._entry_m[arrival.entry_point]

    def _keep_column(self, column: int, arrival: Arrival) -> None:
        """Add a vehicle to the vehicles of its column that do not change columns."""
        goals = self._keeping_columns.setdefault(column, {})
        goals[self._place(arrival)] = self._goals_of(arrival)
        while len(self._keeping_columns) > _MAX_KEEPING_COLUMNS:
            del self._keeping_columns[next(iter(self._keeping_columns))]


def _in_order(column: Sequence[Goals], end_m: float, lanes: int) -> bool:
    """Return whether the vehicles of a column have lanes in their order where some of them leave.

    Args:
        column: where they may leave, from the right to the left.
        end_m: where those leave whose lanes end there.
        lanes: number of lanes, in which the others may be.
    """
    lane: float = -1
    for one in column:
        possible = one.lanes if one.end_m == end_m else range(lanes)
        # The rightmost lane leaves the most room for those on its left.
        lane = min((each for each in possible if each > lane), default=math.inf)
    return lane < math.inf
