"""Planted bugs of formations on roads whose lanes end, and with ramps."""

from __future__ import annotations

import math

import pytest

from laneweave.sim_bridge.road.formation_building import (
    ColumnBlocks,
    Entrances,
    GrowingFormations,
)

Patch = pytest.MonkeyPatch


def columns_are_not_reserved(patch: Patch) -> None:
    """Vehicles enter the columns that are kept free."""
    reserve = GrowingFormations.reserve

    def growing(self: GrowingFormations, column: int, count: int, t_s: float) -> range:
        reserved = reserve(self, column, count, t_s)
        self.first_open_column = reserved[-1]
        return reserved

    def blocks(self: ColumnBlocks, column: int, count: int, t_s: float) -> range:
        del t_s
        front = self.lattice.block_range(self.lattice.block_of(column) + 1)[-1]
        return range(front - count + 1, front + 1)

    patch.setattr(GrowingFormations, "reserve", growing)
    patch.setattr(ColumnBlocks, "reserve", blocks)


def ramps_are_forgotten(patch: Patch) -> None:
    """Formations are closed before their columns have passed the ramp."""

    def mutant(self: GrowingFormations, t_s: float) -> None:
        del t_s
        self._ramp_column = -math.inf

    def closing_s(self: ColumnBlocks, block: int) -> float:
        return self.lattice.passing_time_s(self.lattice.block_range(block)[0]) + self.spread_s

    patch.setattr(GrowingFormations, "_pass_ramps", mutant)
    patch.setattr(ColumnBlocks, "_closing_s", closing_s)


def columns_ahead_are_closed(patch: Patch) -> None:
    """Columns that pass only the ramp, since they were ahead of the road's start, are closed."""
    patch.setattr(Entrances, "first_column", lambda *_: 0)
