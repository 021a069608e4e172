"""Allocation: how the roadside hands out the territory (`protocol.vehicle.territory`) at entrances.

Blocks of columns belong to a formation as soon as it is closed. Cells belong to at most one vehicle
each. `allocation_of` selects one of the two; no other part of the roadside depends on the
operation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

from attrs import evolve

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import ClosedFormation, Name
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.formation_building import FormationBuilder, formation_builder
from laneweave.sim_bridge.road.vehicle import RoadVehicle

NO_VEHICLES: Mapping[Name, RoadVehicle] = MappingProxyType({})
"""The empty road, as a default argument."""
MAX_EMPTY = 12
"""Maximum distance in columns between a vehicle and empty cells assigned to it; smaller if moves
begin near the entrance, since all cells must be assigned before a plan can transfer them."""


class BlockAllocation:
    """Blocks of columns for formations; vehicles own no cells."""

    def __init__(self, builder: FormationBuilder) -> None:
        """Begin without formations."""
        self.builder = builder

    @property
    def closed_to(self) -> int:
        """Block up to which all blocks are closed."""
        return self.builder.closed_to

    def close_formations(self, t_s: float, gaps: Sequence[range]) -> list[ClosedFormation]:
        """Return the formations closed since the last call.

        A vehicle that has entered the columns of one of the `gaps` is a formation of its own.
        """
        block_of = self.builder.lattice.block_of
        alone = [ClosedFormation(block_of(gap[-1]), block_of(gap[0]), t_s) for gap in gaps]
        return self.builder.closed(t_s) + alone

    def is_free(self, cell: Cell) -> bool:
        """Return True: the builder decides whether a vehicle on a ramp can use a cell."""
        del cell
        return True

    def begin_tick(self, vehicles: Mapping[Name, RoadVehicle]) -> None:
        """Begin a tick."""

    def admit(self, admissions: list[Admission]) -> list[Admission]:
        """Return the vehicles that enter, without further cells."""
        return admissions

    def assign_empty_cells(
        self, vehicles: Mapping[Name, RoadVehicle], closed: Sequence[int]
    ) -> None:
        """Assign no cells."""

    def on_left(
        self,
        vehicle: RoadVehicle,
        vehicles: Mapping[Name, RoadVehicle],
        t_s: float,
        still_in: int | None,
    ) -> None:
        """Do nothing: vehicles own no cells."""


class CellAllocation:
    """Cells of the rolling operation: each belongs to at most one vehicle."""

    builder: FormationBuilder | None = None
    closed_to = -1

    def __init__(self, scenario: Scenario, is_kept_free: Callable[[Cell], bool]) -> None:
        """Begin without vehicles.

        Args:
            scenario: road, types of vehicles.
            is_kept_free: returns whether a cell belongs to a gap (`LaneEndControl`).
        """
        self._lattice: Lattice = scenario.lattice
        self._length_m = scenario.road.length_m
        self._points = scenario.geometry.entry_points
        self._last_entry_m = scenario.geometry.last_entry_m
        self._shared_lanes = scenario.geometry.shared_lanes
        self._exits_m = [
            {
                section.exit: section.to_m
                for section in scenario.geometry.sections
                if section.lane == lane and section.exit and section.to_m <= last_m
            }
            for lane, last_m in enumerate(self._last_entry_m)
        ]
        """Exits before the last ramp of each lane, with their positions."""
        self._keep_columns = not scenario.formation.change_columns
        self._is_kept_free = is_kept_free
        columns = int(scenario.geometry.moves_from_m / self._lattice.pitch_m)
        self._max_empty = max(0, min(MAX_EMPTY, columns - 2))
        self._vehicles = NO_VEHICLES
        """The vehicles on the road."""
        self._lost = set[Cell]()
        """Cells of shared lanes that may belong to a vehicle that nothing on the road knows yet."""
        self._owned: set[Cell] | None = None
        """Cells that a vehicle may own, and those in `_lost`; None: not determined yet."""
        self._recent: list[tuple[int, int, Name]] = []
        """(column, lane, name) of recently entered vehicles."""
        self._next: list[list[tuple[int, Name]]] = [[] for _ in self._points]
        """Vehicles that have entered since cells were last assigned, by entry point, foremost
        first."""
        self._unassigned: dict[Cell, int] = {}
        """Empty cells without an owner, with their entry points."""
        self._assigned_to = [
            MAX_EMPTY + int(point.at_m // self._lattice.pitch_m) + 1 for point in self._points
        ]
        """Last column of each entry point whose cells have been processed."""
        self._ownerless_from = {
            point.lane: column
            for point, column in zip(self._points, self._assigned_to, strict=True)
        }
        """First column of each lane that had passed its last entry point before the road began."""
        self._ownerless = set[Cell]()
        """Cells that have never had an owner, since no vehicle was near them at the entrance."""
        self._given = set[Cell]()
        """Cells of these columns that have been assigned since."""

    def close_formations(self, t_s: float, gaps: Sequence[range]) -> list[ClosedFormation]:
        """Return nothing: there are no formations."""
        del t_s, gaps
        return []

    def begin_tick(self, vehicles: Mapping[Name, RoadVehicle]) -> None:
        """Begin a tick, before vehicles enter behind those on the road."""
        self._vehicles, self._owned = vehicles, None

    def admit(self, admissions: list[Admission]) -> list[Admission]:
        """Return the vehicles that enter, with all cells that they get."""
        entering, entered = [], {one.cell for one in admissions}
        self._ownerless -= entered
        for cell in entered:
            self._unassigned.pop(cell, None)
        for one in admissions:
            # Of several vehicles of a column that need a cell, the first one gets it.
            more_cells = tuple(
                cell
                for cell in one.more_cells
                if not (cell in self._given or cell in entered or self._is_owned(cell))
            )
            self._given.update(more_cells)
            entering.append(self._with_ownerless(evolve(one, more_cells=more_cells)))
            arrival = one.arrival
            self._next[arrival.entry_point].append((one.cell[0], Name(arrival.vehicle)))
        return entering

    def _with_ownerless(self, admission: Admission) -> Admission:
        """Add cells beside a vehicle from a ramp that have never had an owner.

        Without an owner no vehicle could enter them. A vehicle that changes columns reaches others.
        """
        column, lane = admission.cell
        if self._points[admission.arrival.entry_point].at_m <= 0.0 or not self._keep_columns:
            return admission
        beside = [(column, other) for other in range(self._lattice.lanes) if other != lane]
        free = [cell for cell in beside if self._is_ownerless(cell)]
        self._given.update(free)
        self._ownerless.difference_update(free)
        for cell in free:
            self._unassigned.pop(cell, None)
        return evolve(admission, more_cells=(*admission.more_cells, *free))

    def _is_ownerless(self, cell: Cell) -> bool:
        """Return whether a cell has never had an owner."""
        first = self._ownerless_from[cell[1]]
        return cell not in self._given and (
            cell[0] >= first or cell in self._ownerless or cell in self._unassigned
        )

    def assign_empty_cells(
        self, vehicles: Mapping[Name, RoadVehicle], closed: Sequence[int]
    ) -> None:
        """Assign empty cells at the entrances to vehicles near them.

        A cell is assigned once no vehicle can enter it any more: up to the `closed` column of the
        last entry point of its lane. A cell without a vehicle nearby waits for the next vehicles;
        if it is too far ahead of them, it remains without an owner.
        """
        self._owned = None
        for point, last in enumerate(closed):
            lane, entered = self._points[point].lane, self._next[point]
            for column in range(self._assigned_to[point] - 1, last - 1, -1):
                cell = (column, lane)
                if entered and entered[0][0] == column:
                    self._store_recent(column, lane, entered.pop(0)[1])
                elif (
                    self._assigns_at(point)
                    and not self._is_kept_free(cell)
                    and cell not in self._given
                    and (lane not in self._shared_lanes or self.is_free(cell))
                ):
                    self._assign(cell, point, vehicles)
            self._assigned_to[point] = last
        unassigned, self._unassigned = self._unassigned, {}
        for cell, point in unassigned.items():
            if cell[0] <= self._assigned_to[point] + 2 * self._max_empty:
                self._assign(cell, point, vehicles)
            else:
                self._ownerless.add(cell)

    def _assigns_at(self, point: int) -> bool:
        """Return whether empty cells are assigned at an entry point: the last one of its lane.

        At the start of the road, too, but to vehicles that leave the lane before the ramp.
        """
        return self._is_last(point) or self._points[point].at_m <= 0.0

    def _is_last(self, point: int) -> bool:
        return self._points[point].at_m == self._last_entry_m[self._points[point].lane]

    def is_free(self, cell: Cell) -> bool:
        """Return whether a vehicle on a ramp can use a cell.

        In a shared lane, no vehicle may own it. A pending transfer may give the cell to a vehicle
        later; those of vehicles that have left are in `_lost`. No vehicle enters a gap that is
        kept free, or beside it if vehicles do not change columns: they could not enter it.
        """
        column, lane = cell
        if self._keep_columns and any(
            self._is_kept_free((column, beside)) for beside in (lane - 1, lane, lane + 1)
        ):
            return False
        return not self._is_owned(cell)

    def _is_owned(self, cell: Cell) -> bool:
        """Return whether a vehicle may own a cell of a shared lane.

        Cells of other lanes are assigned once, so it returns False.
        """
        if cell[1] not in self._shared_lanes:
            return False
        if self._owned is None:
            self._owned = self._lost.union(
                *(vehicle.controller.store.possible_cells for vehicle in self._vehicles.values())
            )
        return cell in self._owned

    def _assign(self, cell: Cell, point: int, vehicles: Mapping[Name, RoadVehicle]) -> None:
        """Assign an empty cell to a nearby vehicle, preferably one ahead of it in its lane.

        If vehicles keep their columns, only those of its column need the cell: preferably one of
        them, so that few vehicles have to agree to a move.

        Args:
            cell: the cell.
            point: entry point at which it is assigned.
            vehicles: the vehicles on the road.
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
            and vehicles[name].has_cell
            and (
                self._keeps_cells(vehicles[name])
                if self._is_last(point)
                else self._leaves_by(vehicles[name], cell, self._points[point].at_m)
            )
        ]
        if near:
            vehicles[min(near)[-1]].controller.store.assign_cell(cell)
            self._ownerless.discard(cell)
        else:
            self._unassigned[cell] = point

    def _keeps_cells(self, vehicle: RoadVehicle) -> bool:
        """Return whether a vehicle may get empty cells.

        Where a ramp follows an exit, vehicles that leave by the exit get none: those from the ramp
        need the agreement of the owners of such cells, while these leave.
        """
        return not self._shared_lanes or vehicle.arrival.destination == END_OF_ROAD

    def _leaves_by(self, vehicle: RoadVehicle, cell: Cell, s_m: float) -> bool:
        """Return whether a vehicle needs a cell of its column to leave before a ramp.

        Args:
            vehicle: the vehicle.
            cell: a cell of a shared lane.
            s_m: position behind which the exit is.
        """
        column, lane = cell
        exit_m = self._exits_m[lane].get(vehicle.arrival.destination, -math.inf)
        return exit_m > s_m and vehicle.controller.hold_cell[0] == column

    def _store_recent(self, column: int, lane: int, name: Name) -> None:
        """Add an entered vehicle to the recent ones, and drop those far ahead of it."""
        far = max(self._assigned_to) + 2 * self._max_empty
        self._recent = [one for one in self._recent if one[0] <= far]
        self._recent.append((column, lane, name))

    def on_left(
        self,
        vehicle: RoadVehicle,
        vehicles: Mapping[Name, RoadVehicle],
        t_s: float,
        still_in: int | None,
    ) -> None:
        """Pass on the cells of a vehicle that has left the road.

        No later plan can contain it, so the cells that it owns whichever way its pending transfer
        resolves can be assigned again; those of the lane in which it is still driven are not.
        """
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
        on_lattice = [one for one in vehicles.values() if one.has_cell]
        staying = [one for one in on_lattice if self._keeps_cells(one)]
        for column, lane in sorted(certain):
            s_m = lattice.cell_s_m(column, t_s)
            if lane == still_in or s_m >= self._length_m:
                continue  # no vehicle must be led into it
            possible = staying
            if lane in self._shared_lanes and s_m < self._last_entry_m[lane]:
                # Vehicles from the ramp need it, unless one of its column leaves before.
                cell = (column, lane)
                possible = [one for one in on_lattice if self._leaves_by(one, cell, s_m)]
            if possible:
                near = min(
                    possible,
                    key=lambda one: (
                        abs(one.controller.hold_cell[0] - column),
                        abs(one.controller.hold_cell[1] - lane),
                        one.name,
                    ),
                )
                near.controller.store.assign_cell((column, lane))


Allocation = BlockAllocation | CellAllocation


def allocation_of(scenario: Scenario, is_kept_free: Callable[[Cell], bool]) -> Allocation:
    """Return the allocation of a scenario's operation; see `CellAllocation`."""
    if scenario.formation.traits.has_formations:
        return BlockAllocation(formation_builder(scenario))
    return CellAllocation(scenario, is_kept_free)
