"""Planted bugs of formations on roads whose lanes end, and with ramps."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from attrs import evolve

from laneweave.coordinator.formations import operation
from laneweave.coordinator.formations.roster import Formation, Groups, closed_formations
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle import plan_execution
from laneweave.protocol.wire.messages import Census
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.road.formation_building import (
    ColumnBlocks,
    Entrances,
    GrowingFormations,
)

Patch = pytest.MonkeyPatch


def still_members(patch: Patch) -> None:
    """Leaders wait for vehicles that have left the lattice."""

    def mutant(
        census: Census, t_s: float, scenario: Scenario, groups: Groups
    ) -> dict[int, Formation]:
        on_road = tuple(evolve(entry, off_lattice=None) for entry in census.on_road)
        return closed_formations(evolve(census, on_road=on_road), t_s, scenario, groups)

    patch.setattr(operation, "closed_formations", mutant)


def remains_joined(patch: Patch) -> None:
    """A vehicle that enters the lattice again still belongs to its former formation."""

    def mutant(self: MotionController, cells: Iterable[Cell]) -> None:
        del cells
        self.off_lattice = None

    patch.setattr(MotionController, "enter_lattice", mutant)


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


def old_leaders_are_obeyed(patch: Patch) -> None:
    """A vehicle promises ballots of formations to which it does not belong any more."""
    patch.setattr(
        plan_execution,
        "is_in_roster",
        lambda execution, prepare: execution.vehicle in prepare.roster,
    )
