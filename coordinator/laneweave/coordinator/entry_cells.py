"""Check that hold cells are within reach of the cells in which vehicles entered."""

from __future__ import annotations

import math
from collections.abc import Iterable

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import CensusEntry, Name, VehicleState

SPARE_COLUMNS = 100
"""Margin, added to the number of columns that a vehicle at its maximum speed gains on the
lattice."""


class EntryCells:
    """The cells that the vehicles of the newest census entered."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin without vehicles."""
        self._lattice = scenario.lattice
        self._lanes = scenario.road.lanes
        ratio = max(1.0, scenario.vehicle.max_speed_mps / scenario.formation.speed_mps)
        columns = ratio * scenario.road.length_m / scenario.lattice.pitch_m
        self._max_columns = SPARE_COLUMNS + math.ceil(columns)
        self._cells: dict[Name, Cell] = {}

    def update(self, entries: Iterable[CensusEntry]) -> None:
        """Take the vehicles of a census that are on the lattice."""
        self._cells = {entry.vehicle: entry.cell for entry in entries}

    def has_entry_of(self, state: VehicleState) -> bool:
        """Return whether the census lists the vehicle of a state, in the same block."""
        cell = self._cells.get(state.vehicle)
        return cell is not None and self._lattice.block_of(cell[0]) == state.block

    def check(self, state: VehicleState) -> None:
        """Check the hold cell of a vehicle: planning costs time for each column between vehicles.

        Raises:
            BadInputError: the vehicle cannot have come there from the cell that it entered.
        """
        if not self.has_entry_of(state):
            return  # of another road, or it has entered again since
        entered, (column, lane) = self._cells[state.vehicle][0], state.hold_cell
        low, high = entered - self._max_columns, entered + self._max_columns
        if not (0 <= lane < self._lanes and low <= column <= high):
            allowed = f"a cell in columns {low} to {high} and lanes 0 to {self._lanes - 1}"
            raise BadInputError("hold_cell", state.hold_cell, allowed)
