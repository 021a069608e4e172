"""Entry metering at the start of the road and on ramps.

A vehicle enters with the lattice speed v_F, at s = 0 or at the beginning of a ramp. Of the free
cells of its lane behind its predecessor, it gets the first that passes this position at most
`spread_s` before or after the vehicle, and settles in this cell. With interlaced entry only every
other cell may be entered, as in the paper's driving structure. Vehicles of a lane enter in order
of arrival, at least one column's time apart.

With formations, `formation_building` decides whether a formation admits a vehicle.

Vehicles of some types (trucks) do not change columns (`VehicleType.moves`). Two of them in a
column could not pass each other, so they enter the same column only if they can leave the road in
lanes of the same order. They enter exactly in their cells: a weak vehicle would take long to
settle, and a long one behind another has little room to approach it.

A ramp may follow an exit in the same lane (`RoadGeometry.shared_exit_lanes`). Cells of such a lane
are not assigned to vehicles near them before the ramp: each vehicle that leaves by the exit enters
with the cell of its column, and if it has left, the ramp can use the cell.

Decisions do not depend on later arrivals: they are made in order of time and, at equal times, from
the rightmost lane to the leftmost.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Callable, Collection, Sequence

from attrs import frozen

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.formation_building import FormationBuilder

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
        entry_m: Sequence[float] = (),
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
            entry_m: position of the entrance of each lane; empty: s = 0.
            column_bound: types of vehicles that do not change columns.
            goals_of: returns where a vehicle may leave the road; None: in its preferred lane, if it
                has one, at the end of the road.
            shared_lanes: lanes in which a ramp follows an exit.
            is_free: returns whether a vehicle on a ramp can use a cell; None: always.
        """
        self._goals_of = goals_of or self._goals
        self._shared_lanes = frozenset(shared_lanes)
        self._is_free = is_free
        self._column_bound = frozenset(column_bound)
        self._keeping_columns: dict[int, dict[int, Goals]] = {}
        """Where the vehicles of these types may leave, by their column and lane."""
        self._entry_m = tuple(entry_m) or (0.0,) * lattice.lanes
        self._lattice = lattice
        self._builder = builder
        self._spread_s = spread_s
        self._interlaced = interlaced
        self._queues: list[list[Arrival]] = [[] for _ in range(lattice.lanes)]
        self._names: set[str] = set()
        self._columns = [int(s_m // lattice.pitch_m) for s_m in self._entry_m]
        """Next column of each lane that vehicles can enter."""
        self._until_s = -math.inf
        """Time after which the next vehicles enter."""
        self._free_s = [-math.inf] * lattice.lanes
        """Earliest time at which the next vehicle of each lane may enter."""

    @property
    def waiting(self) -> tuple[Arrival, ...]:
        """Queued vehicles, ordered by lane."""
        return tuple(arrival for queue in self._queues for arrival in queue)

    def next_column(self, lane: int) -> int:
        """Return the next column of a lane that vehicles can enter.

        With formations, that of all lanes at the start of the road.
        """
        if self._builder is None:
            return self._columns[lane]
        return min(
            column
            for column, entry_m in zip(self._columns, self._entry_m, strict=True)
            if entry_m <= 0.0
        )

    def keep_free(self, lane: int, count: int, t_s: float) -> range:
        """Return the next columns of a lane, which no vehicle may enter any more."""
        first = self.next_column(lane)
        if self._builder is not None:
            return self._builder.reserve(first, count, t_s)
        self._columns[lane] = first - count
        return range(first - count + 1, first + 1)

    def lanes_kept_free(self, lane: int) -> Collection[int]:
        """Return the lanes in which `keep_free` keeps columns free: with formations, all."""
        return (lane,) if self._builder is None else range(self._lattice.lanes)

    def closed_column(self, lane: int) -> int:
        """Return the rearmost column of a lane that vehicles can no longer enter."""
        return self._columns[lane] + 1

    def demand(self, arrival: Arrival) -> None:
        """Queue a vehicle for its lane in order of arrival; its arrival may be in the future.

        Raises:
            ValueError: a lane does not exist, or the vehicle is already queued.
        """
        lanes = range(self._lattice.lanes)
        if arrival.lane not in lanes or arrival.preferred_lane not in (ANY_LANE, *lanes):
            raise ValueError(f"{arrival} needs lanes 0 to {self._lattice.lanes - 1}")
        if arrival.vehicle in self._names:
            raise ValueError(f"{arrival.vehicle} is already waiting")
        self._names.add(arrival.vehicle)
        insort(self._queues[arrival.lane], arrival, key=lambda other: other.t_s)

    def take(self, arrival: Arrival, column: int) -> bool:
        """Give a cell to a vehicle that does not queue; return whether it can have it.

        No later vehicle enters the lane in this column or ahead of it.
        """
        lane = arrival.lane
        if column > self._columns[lane] or not self.is_possible(arrival, column):
            return False
        if arrival.vehicle_type in self._column_bound:
            self._keep_column((column, lane), arrival)
        self._columns[lane] = column - 1
        return True

    def is_possible(self, arrival: Arrival, column: int) -> bool:
        """Return whether nothing but its formation keeps a vehicle from a column of its lane."""
        cell = (column, arrival.lane)
        from_ramp = self._entry_m[arrival.lane] > 0.0
        if from_ramp and self._is_free is not None and not self._is_free(cell):
            return False
        return arrival.vehicle_type not in self._column_bound or self._can_keep_column(
            cell, arrival
        )

    def next_open(self, lane: int, t_s: float) -> int:
        """Return the next column of a lane that a vehicle can enter at a road time."""
        self._skip(lane, t_s)
        return self._columns[lane]

    def admit(self, until_s: float, full: Collection[int] = ()) -> list[Admission]:
        """Return the vehicles that have entered since the last call, by time, then lane.

        Args:
            until_s: usually the current road time.
            full: lanes without room at the entrance, which no vehicle may enter now.
        """
        admissions = []
        lanes = [lane for lane in range(self._lattice.lanes) if lane not in full]
        while lanes:
            t_s, lane = min((self._entry_s(lane), lane) for lane in lanes)
            if t_s > until_s + TIME_TOLERANCE_S:
                break
            cell = (self._columns[lane], lane)
            arrival = self._dequeue(cell, t_s)
            if arrival is not None:
                late_s = self._passing_time_s(cell[0], lane) - t_s
                offset_m = late_s * self._lattice.speed_mps
                more_cells = self.exit_cells(arrival, cell[0])
                admissions.append(Admission(arrival, cell, t_s, offset_m, more_cells))
                self._free_s[lane] = t_s + self._lattice.pitch_m / self._lattice.speed_mps
            self._columns[lane] -= 1
        self._until_s = until_s + TIME_TOLERANCE_S
        # Columns that have passed are not available to later arrivals.
        for lane in range(self._lattice.lanes):
            self._skip(lane, until_s - TIME_TOLERANCE_S)
        return admissions

    def _entry_s(self, lane: int) -> float:
        """Return the time [s] at which the first vehicle of a queue can enter the next column."""
        queue = self._queues[lane]
        if not queue:
            return math.inf
        # A lane may have been full, and a vehicle that was held back is queued late.
        ready_s = max(queue[0].t_s, self._free_s[lane], self._until_s)
        self._skip(lane, ready_s)
        passing_s = self._passing_time_s(self._columns[lane], lane)
        return max(ready_s, passing_s - self._spread_in(lane))

    def _spread_in(self, lane: int) -> float:
        """Return the maximum time between the first vehicle of a queue and its cell [s]."""
        queue = self._queues[lane]
        return 0.0 if queue and queue[0].vehicle_type in self._column_bound else self._spread_s

    def _passing_time_s(self, column: int, lane: int) -> float:
        """Return the road time at which a column passes the entrance of a lane."""
        return self._lattice.passing_time_s(column, self._entry_m[lane])

    def _skip(self, lane: int, t_s: float) -> None:
        """Advance a lane to its first column that vehicles can enter at `t_s`."""
        lattice, column = self._lattice, self._columns[lane]
        if self._builder is not None and self._entry_m[lane] <= 0.0:
            column = int(min(column, self._builder.first_open_column))
        spread_s = self._spread_in(lane)
        while self._passing_time_s(column, lane) + spread_s < t_s - TIME_TOLERANCE_S or (
            self._interlaced and not lattice.interlaced((column, lane))
        ):
            column -= 1
        self._columns[lane] = column

    def _dequeue(self, cell: Cell, t_s: float) -> Arrival | None:
        """Remove and return the first vehicle of a queue, unless it needs a later cell."""
        builder, queue = self._builder, self._queues[cell[1]]
        keeps_column = queue[0].vehicle_type in self._column_bound
        if not self.is_possible(queue[0], cell[0]):
            return None
        if builder is not None and not builder.try_add(
            cell, queue[0].preferred_lane, t_s, column_bound=keeps_column
        ):
            return None
        if keeps_column:
            self._keep_column(cell, queue[0])
        self._names.discard(queue[0].vehicle)
        return queue.pop(0)

    def exit_cells(self, arrival: Arrival, column: int) -> tuple[Cell, ...]:
        """Return the cells for leaving by lanes in which a ramp follows the exit.

        There are none for a vehicle that enters from the ramp.
        """
        goals = self._goals_of(arrival)
        return tuple(
            (column, goal)
            for goal in goals.lanes
            if goal in self._shared_lanes and goals.end_m <= self._entry_m[goal]
        )

    def _goals(self, arrival: Arrival) -> Goals:
        preferred = arrival.preferred_lane
        lanes = range(self._lattice.lanes) if preferred == ANY_LANE else (preferred,)
        return Goals(tuple(lanes), math.inf)

    def _can_keep_column(self, cell: Cell, arrival: Arrival) -> bool:
        """Return whether a vehicle, and those of its column, can leave in the order of their lanes.

        These are the vehicles that do not change columns, and have not left yet.
        """
        column, lane = cell
        own = self._goals_of(arrival)
        goals = {
            here: goal.lanes
            for here, goal in self._keeping_columns.get(column, {}).items()
            if goal.end_m > self._entry_m[lane]
        }
        if not goals:
            return True
        leaves_in: float = -1
        goals[lane] = own.lanes
        for here in sorted(goals):
            # The rightmost lane that leaves the most room for those on its left.
            leaves_in = min((goal for goal in goals[here] if goal > leaves_in), default=math.inf)
        return leaves_in < math.inf

    def _keep_column(self, cell: Cell, arrival: Arrival) -> None:
        """Add a vehicle to the vehicles of its column that do not change columns."""
        column, lane = cell
        self._keeping_columns.setdefault(column, {})[lane] = self._goals_of(arrival)
        while len(self._keeping_columns) > _MAX_KEEPING_COLUMNS:
            del self._keeping_columns[next(iter(self._keeping_columns))]
