"""Formation building at the entrances: which columns and members formations get.

A formation is *closed* when no vehicle can enter its columns any more, so its members are final.
Each column belongs to at most one closed formation, permanently: plans of different formations rely
on this.

- `ColumnBlocks`, as in the paper: all formations have the same number of columns.
- `GrowingFormations`, the default: the length depends on the traffic. A formation begins near the
  column of its first vehicle. It is complete at its maximum number of vehicles, at its maximum
  length, or before more vehicles prefer a lane than the shortest full formation has columns. Behind
  the last vehicle it gets the columns that sorting needs: at least as many free cells as lanes, as
  many columns as there are vehicles that prefer the same lane, and one more if vehicles from the
  start of the road cannot change columns, since others make room for these.

In both, the number of vehicles that prefer the same lane is at most the number of columns, unlike
in the paper, which groups vehicles regardless of their preferences. Where lanes end, the vehicles
must fit into those that remain.

Vehicles from ramps join the formation whose columns pass, if it has room. It is closed when its
columns have passed all entrances.

For vehicles that waited at the end of a lane, columns are *reserved*: no vehicle enters them, in
any lane. The vehicle that drives into them is a formation of its own.
"""

from __future__ import annotations

import math
from collections import Counter

from attrs import define, field, frozen

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import formation_columns
from laneweave.protocol.wire.messages import ClosedFormation


@frozen
class Entrances:
    """Data of a road for formation building: its entrances, and the number of lanes that remain."""

    narrowest: int
    """Smallest number of lanes that are open anywhere."""
    ramps: frozenset[int] = frozenset()
    """Lanes of ramps."""
    last_m: float = 0.0
    """Position of the last entrance."""
    from_ramps: int = 0
    """Vehicles from ramps for which a full formation has room."""

    @classmethod
    def of(cls, scenario: Scenario) -> Entrances:
        """Return the entrances of a scenario."""
        ramps = frozenset(one.lane for one in scenario.entrance)
        from_ramps = scenario.flow.vehicles_from_ramps
        return cls(scenario.road.narrowest_lanes, ramps, max(scenario.geometry.entry_m), from_ramps)

    def first_column(self, lattice: Lattice) -> int:
        """Return the foremost column that vehicles can enter: the next to pass the last ramp."""
        return int(self.last_m // lattice.pitch_m)


@define
class Vehicles:
    """Number of vehicles of a formation, by preferred lane."""

    _preferring: Counter[int] = field(factory=Counter)

    @property
    def count(self) -> int:
        """Number of all vehicles."""
        return self._preferring.total()

    @property
    def most_preferring(self) -> int:
        """Maximum number of vehicles that prefer the same lane."""
        return max((n for lane, n in self._preferring.items() if lane != ANY_LANE), default=0)

    def fits(self, preferred_lane: int, columns: int) -> bool:
        """Return whether one more vehicle that prefers a lane finds a cell there."""
        return preferred_lane == ANY_LANE or self._preferring[preferred_lane] < columns

    def add(self, preferred_lane: int) -> None:
        """Add a vehicle."""
        self._preferring[preferred_lane] += 1


@define
class ColumnBlocks:
    """Formations of equal length: each is one block of `lattice.block_columns` columns."""

    lattice: Lattice
    max_vehicles: int
    """Maximum number of vehicles from the start of the road."""
    spread_s: float
    """Maximum time between a vehicle and its cell at its entrance."""
    entrances: Entrances
    first_open_column: float = math.inf
    """Foremost column that can still be entered at the start of the road; infinite: any."""
    _vehicles: dict[int, Vehicles] = field(factory=dict)
    """Vehicles of each block that is not closed."""
    _reserved: set[int] = field(factory=set)
    """Blocks that no vehicle may enter and that are not closed."""
    _next: int = field(init=False)
    """Next block to be closed."""

    @_next.default
    def _first_block(self) -> int:
        return self.lattice.block_of(self.entrances.first_column(self.lattice))

    def try_add(
        self, cell: Cell, preferred_lane: int, t_s: float, *, column_bound: bool = False
    ) -> bool:
        """Add a vehicle that would enter in a cell; return False if it needs a later cell."""
        del t_s, column_bound  # all blocks have the same length
        block, columns = self.lattice.block_of(cell[0]), self.lattice.block_columns
        vehicles = self._vehicles.setdefault(block, Vehicles())
        room = self.max_vehicles
        if cell[1] in self.entrances.ramps:
            room = max(room, (columns - 1) * self.entrances.narrowest)
        if (
            block in self._reserved
            or vehicles.count >= room
            or not vehicles.fits(preferred_lane, columns)
        ):
            return False
        vehicles.add(preferred_lane)
        return True

    def reserve(self, column: int, count: int, t_s: float) -> range:
        """Reserve columns from the first block behind a column on; return the foremost `count`."""
        del t_s
        first = max(self.lattice.block_of(column), *self._reserved, self._next) + 1
        self._reserved |= {
            first + number for number in range(math.ceil(count / self.lattice.block_columns))
        }
        front = self.lattice.block_range(first)[-1]
        return range(front - count + 1, front + 1)

    def closed(self, t_s: float) -> list[ClosedFormation]:
        """Return the formations whose last columns have passed since the last call."""
        closed = []
        while (closed_s := self._closing_s(self._next)) <= t_s:
            vehicles = self._vehicles.pop(self._next, None)
            if vehicles is not None and vehicles.count:
                closed.append(ClosedFormation(self._next, self._next, closed_s))
            self._reserved.discard(self._next)
            self._next += 1
        return closed

    @property
    def closed_to(self) -> int:
        """Block up to which all blocks are closed."""
        return self._next - 1

    def _closing_s(self, block: int) -> float:
        rear = self.lattice.block_range(block)[0]
        return self.lattice.passing_time_s(rear, self.entrances.last_m) + self.spread_s


@define
class Shape:
    """Columns and vehicles of a formation that is not closed."""

    front: int
    """Foremost column."""
    rear: int
    """Rearmost column; of a formation that is not complete, that of its last vehicle."""
    vehicles: Vehicles = field(factory=Vehicles)
    from_ramps: int = 0
    """Number of its vehicles that came from ramps."""
    complete_s: float = 0.0
    """Road time at which it was completed."""
    column_bound: bool = False
    """Whether it has vehicles from the start of the road that cannot change columns."""

    @property
    def columns(self) -> range:
        """All columns."""
        return range(self.rear, self.front + 1)


@define
class GrowingFormations:
    """Formations whose length depends on the traffic; blocks are single columns."""

    lattice: Lattice
    max_vehicles: int
    """Maximum number of vehicles from the start of the road."""
    max_columns: int
    spread_s: float
    """Maximum time between a vehicle and its cell at its entrance."""
    entrances: Entrances
    first_open_column: float = field(init=False)
    """Foremost column that can still be entered at the start of the road."""
    _open: Shape | None = None
    """The formation that vehicles enter at the start of the road."""
    _complete: list[Shape] = field(factory=list)
    """Formations that vehicles can enter only from ramps, foremost first."""
    _ramp_column: float = field(init=False)
    """Foremost column that can still be entered from the last ramp; -inf: there is none."""

    def __attrs_post_init__(self) -> None:
        """Begin at road time 0."""
        self.first_open_column = self.entrances.first_column(self.lattice)
        self._pass_ramps(0.0)

    @property
    def shortest_length(self) -> int:
        """Minimum number of columns of a full formation, with the vehicles expected from ramps."""
        return self._length_for(self.max_vehicles + self._coming(0))

    def _length_for(self, vehicles: int) -> int:
        """Return the minimum number of columns for some vehicles."""
        return formation_columns(vehicles, self.entrances.narrowest)

    def _coming(self, entered: int) -> int:
        """Return how many more vehicles from ramps are expected in a full formation."""
        return max(self.entrances.from_ramps - entered, 0)

    def try_add(
        self, cell: Cell, preferred_lane: int, t_s: float, *, column_bound: bool = False
    ) -> bool:
        """Add a vehicle that would enter in a cell; return False if it needs a later cell."""
        column, lane = cell
        if lane in self.entrances.ramps:
            return self._try_add_from_ramp(column, preferred_lane)
        shape = self._open
        if shape is not None:
            if column <= shape.front - self.max_columns:
                self._complete_open(shape.front - self.max_columns + 1, t_s)
            elif not shape.vehicles.fits(preferred_lane, self.shortest_length):
                self._complete_open(shape.rear, t_s)
        if column > self.first_open_column:
            return False
        shape = self._opened(column)
        shape.rear = min(shape.rear, column)
        shape.vehicles.add(preferred_lane)
        shape.column_bound = shape.column_bound or column_bound
        if shape.vehicles.count - shape.from_ramps >= self.max_vehicles:
            self._complete_open(shape.rear, t_s)
        return True

    def _try_add_from_ramp(self, column: int, preferred_lane: int) -> bool:
        shape = next((one for one in self._complete if column in one.columns), None)
        if shape is None:
            if column > self.first_open_column:
                return False
            begun = self._open
            if begun is not None and not begun.front - self.max_columns < column <= begun.front:
                return False
            shape = self._opened(column)
            columns = self.shortest_length
        else:
            columns = len(shape.columns)
        count = shape.vehicles.count + 1
        if self._length_for(count) > columns or not shape.vehicles.fits(preferred_lane, columns):
            return False
        shape.rear = min(shape.rear, column)
        shape.vehicles.add(preferred_lane)
        shape.from_ramps += 1
        return True

    def reserve(self, column: int, count: int, t_s: float) -> range:
        """Reserve columns that can still be entered, from a column on or behind it.

        The open formation is completed.
        """
        if self._open is not None:
            self._complete_open(self._open.rear, t_s)
        front = int(min(column, self.first_open_column))
        self.first_open_column = front - count
        return range(front - count + 1, front + 1)

    @property
    def closed_to(self) -> int:
        """Block up to which all blocks are closed."""
        waiting = [shape.front for shape in self._complete]
        foremost = max(self.first_open_column, self._ramp_column, *waiting)
        return self.lattice.block_of(int(foremost)) - 1

    def closed(self, t_s: float) -> list[ClosedFormation]:
        """Return the formations that have been closed since the last call."""
        shape = self._open
        if shape is not None:
            rear = shape.front - self.max_columns + 1
            complete_s = self.lattice.passing_time_s(rear) + self.spread_s
            if complete_s <= t_s:
                self._complete_open(rear, complete_s)
        self._pass_ramps(t_s)
        closed = [one for one in self._complete if one.rear > self._ramp_column]
        self._complete = [one for one in self._complete if one.rear <= self._ramp_column]
        return [
            ClosedFormation(
                self.lattice.block_of(one.front),
                self.lattice.block_of(one.rear),
                t_s if self.entrances.ramps else one.complete_s,
            )
            for one in closed
        ]

    def _pass_ramps(self, t_s: float) -> None:
        """Update the foremost column that can still be entered from a ramp."""
        self._ramp_column = -math.inf
        if self.entrances.ramps:
            in_reach_m = self.lattice.speed_mps * (t_s - self.spread_s)
            columns = (self.entrances.last_m - in_reach_m) / self.lattice.pitch_m
            self._ramp_column = math.floor(columns + 1e-6)

    def _opened(self, column: int) -> Shape:
        """Return the formation that vehicles enter, a new one if necessary."""
        if self._open is None:
            # Vehicles can still enter this many columns ahead of the current one.
            spread_m = self.spread_s * self.lattice.speed_mps
            ahead = math.floor(2.0 * spread_m / self.lattice.pitch_m + 1e-6)
            self._open = Shape(int(min(self.first_open_column, column + ahead)), column)
        return self._open

    def _complete_open(self, last_column: int, t_s: float) -> None:
        """Complete the open formation at a column, or farther back if it needs more cells."""
        shape, self._open = self._open, None
        if shape is None:
            return
        needed = self._length_for(shape.vehicles.count + self._coming(shape.from_ramps))
        length = max(
            shape.front - min(last_column, shape.rear) + 1,
            min(needed + shape.column_bound, max(needed, self.max_columns)),
            shape.vehicles.most_preferring,
        )
        shape.rear, shape.complete_s = shape.front - length + 1, t_s
        self.first_open_column = shape.rear - 1
        self._complete.append(shape)


FormationBuilder = ColumnBlocks | GrowingFormations
"""Assigns entering vehicles to formations, in order of entry."""


def formation_builder(scenario: Scenario) -> FormationBuilder:
    """Return the builder of a scenario's formations."""
    formation, lattice, entrances = scenario.formation, scenario.lattice, Entrances.of(scenario)
    most, spread_s = formation.max_vehicles, formation.entry_spread_s
    if formation.closes_by_vehicles:
        return GrowingFormations(lattice, most, formation.max_columns, spread_s, entrances)
    return ColumnBlocks(lattice, scenario.flow.block_vehicles, spread_s, entrances)
