"""Formation building at the entrance: which columns and members formations get.

A formation is *closed* when no vehicle can enter its columns any more, so its members are final.
Each column belongs to at most one closed formation, permanently: plans of different formations rely
on this.

- `ColumnBlocks`, as in the paper: all formations have the same number of columns.
- `GrowingFormations`, the default: the length depends on the traffic. A formation begins near the
  column of its first vehicle. It closes at its maximum number of vehicles, at its maximum length,
  or before more vehicles prefer a lane than the shortest full formation has columns. Behind the
  last vehicle it gets the columns that sorting needs: at least as many free cells as lanes, and as
  many columns as there are vehicles that prefer the same lane.

In both, the number of vehicles that prefer the same lane is at most the number of columns, unlike
in the paper, which groups vehicles regardless of their preferences.
"""

from __future__ import annotations

import math
from collections import Counter

from attrs import define, field

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import ClosedFormation


@define
class ColumnBlocks:
    """Formations of equal length: each is one block of `lattice.block_columns` columns."""

    lattice: Lattice
    max_vehicles: int
    spread_s: float
    """Maximum time between a vehicle and its cell at the start of the road."""
    first_open_column: float = math.inf
    """Foremost column that can still be entered; infinite: any."""
    _preferring: dict[int, Counter[int]] = field(factory=dict)
    """Number of vehicles by preferred lane, for each block that is not closed."""
    _next: int = 0
    """Next block to be closed."""

    def try_add(self, cell: Cell, preferred_lane: int, t_s: float) -> bool:
        """Add a vehicle that would enter in a cell; return False if it needs a later cell."""
        del t_s
        preferring = self._preferring.setdefault(self.lattice.block_of(cell[0]), Counter())
        if (
            preferring.total() >= self.max_vehicles
            or preferring[preferred_lane] >= self.lattice.block_columns
        ):
            return False
        preferring[preferred_lane] += 1
        return True

    def closed(self, t_s: float) -> list[ClosedFormation]:
        """Return the formations whose last columns have passed since the last call."""
        closed = []
        while (closed_s := self._closing_s(self._next)) <= t_s:
            if self._preferring.pop(self._next, None):
                closed.append(ClosedFormation(self._next, self._next, closed_s))
            self._next += 1
        return closed

    @property
    def closed_to(self) -> int:
        """Block up to which all blocks are closed; -1: none."""
        return self._next - 1

    def _closing_s(self, block: int) -> float:
        rear = self.lattice.block_range(block)[0]
        return self.lattice.passing_time_s(rear) + self.spread_s


@define
class GrowingFormations:
    """Formations whose length depends on the traffic; blocks are single columns."""

    lattice: Lattice
    max_vehicles: int
    max_columns: int
    spread_s: float
    """Maximum time between a vehicle and its cell at the start of the road."""
    first_open_column: float = 0
    """Foremost column that can still be entered."""
    _front: int | None = None
    """Foremost column of the open formation, if any."""
    _rear: int = 0
    """Column of the last vehicle in the open formation."""
    _taken: int = 0
    _preferring: Counter[int] = field(factory=Counter)
    """Number of vehicles in the open formation by preferred lane."""
    _closed: list[ClosedFormation] = field(factory=list)

    @property
    def shortest_length(self) -> int:
        """Minimum number of columns of a full formation."""
        return self._length_for(self.max_vehicles)

    def try_add(self, cell: Cell, preferred_lane: int, t_s: float) -> bool:
        """Add a vehicle that would enter in a cell; return False if it needs a later cell."""
        column = cell[0]
        if self._front is not None and column <= self._front - self.max_columns:
            self._close(self._front - self.max_columns + 1, t_s)
        elif self._preferring[preferred_lane] >= self.shortest_length:
            self._close(self._rear, t_s)
        if column > self.first_open_column:
            return False
        if self._front is None:
            # Vehicles can still enter this many columns ahead of the current one.
            spread_m = self.spread_s * self.lattice.speed_mps
            ahead = math.floor(2.0 * spread_m / self.lattice.pitch_m + 1e-6)
            self._front = int(min(self.first_open_column, column + ahead))
            self._rear = column
        self._rear = min(self._rear, column)
        self._taken += 1
        self._preferring[preferred_lane] += 1
        if self._taken >= self.max_vehicles:
            self._close(self._rear, t_s)
        return True

    @property
    def closed_to(self) -> int:
        """Block up to which all blocks are closed; -1: none."""
        return self.lattice.block_of(int(self.first_open_column)) - 1

    def closed(self, t_s: float) -> list[ClosedFormation]:
        """Return the formations that have been closed since the last call."""
        if self._front is not None:
            rear = self._front - self.max_columns + 1
            closed_s = self.lattice.passing_time_s(rear) + self.spread_s
            if closed_s <= t_s:
                self._close(rear, closed_s)
        closed, self._closed = self._closed, []
        return closed

    def _close(self, last_column: int, t_s: float) -> None:
        """Close the open formation at a column, or farther back if it needs more cells."""
        if self._front is None:
            return
        length = max(
            self._front - min(last_column, self._rear) + 1,
            self._length_for(self._taken),
            *self._preferring.values(),
        )
        rear = self._front - length + 1
        blocks = self.lattice.block_of(self._front), self.lattice.block_of(rear)
        self._closed.append(ClosedFormation(*blocks, t_s))
        self.first_open_column = rear - 1
        self._front, self._taken = None, 0
        self._preferring.clear()

    def _length_for(self, vehicles: int) -> int:
        """Return the minimum number of columns.

        With several lanes, at least as many cells as there are lanes stay free.
        """
        lanes = self.lattice.lanes
        return math.ceil((vehicles + lanes) / lanes) if lanes > 1 else vehicles


FormationBuilder = ColumnBlocks | GrowingFormations
"""Assigns entering vehicles to formations, in order of entry."""


def formation_builder(scenario: Scenario) -> FormationBuilder | None:
    """Return the builder of a scenario's formations; None in the rolling operation."""
    formation, lattice = scenario.formation, scenario.lattice
    spread_s = formation.entry_spread_s
    if formation.rolling:
        return None
    if formation.closes_by_vehicles:
        return GrowingFormations(lattice, formation.max_vehicles, formation.max_columns, spread_s)
    return ColumnBlocks(lattice, formation.max_vehicles, spread_s)
