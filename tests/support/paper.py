"""Scenarios of tests that mean the paper's formations (`PAPERS_FORMATIONS`)."""

from __future__ import annotations

from collections.abc import Iterable

from attrs import evolve, fields

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import PAPERS_FORMATIONS, FormationSettings
from laneweave.protocol.scenario.vehicle_tables import Sensing
from laneweave.protocol.structuring import structure
from laneweave.protocol.wire.messages import CensusEntry, ClosedFormation
from laneweave.sim_bridge.road.formation_building import formation_builder

FORMATIONS = structure({"operation": "formations", **PAPERS_FORMATIONS}, FormationSettings)
PAPER = Scenario(formation=FORMATIONS)
EXACT = Sensing(**dict.fromkeys((field.name for field in fields(Sensing)), 0.0))
"""Sensors without errors."""


def paper(scenario: Scenario) -> Scenario:
    """Return a scenario in the paper's operation."""
    names = ("operation", *PAPERS_FORMATIONS)
    changes = {name: getattr(FORMATIONS, name) for name in names}
    return evolve(scenario, formation=evolve(scenario.formation, **changes))


def closing_time_s(block: int, scenario: Scenario = PAPER) -> float:
    """Return the road time from which on nobody can enter a block of columns any more."""
    lattice = scenario.lattice
    passing_s = lattice.passing_time_s(lattice.block_range(block)[0])
    return passing_s + scenario.formation.entry_spread_s


def closed_blocks(
    on_road: Iterable[CensusEntry], t_s: float, scenario: Scenario = PAPER
) -> tuple[tuple[ClosedFormation, ...], int]:
    """Return which formations of these vehicles the roadside has closed, and up to which block."""
    builder = formation_builder(scenario)
    for entry in on_road:
        builder.try_add(entry.cell, entry.preferred_lane, entry.entered_s)
    formations = tuple(builder.closed(t_s))
    return formations, builder.closed_to
