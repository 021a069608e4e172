"""Scenarios of tests that mean the paper's operation: closed formations, planned once."""

from __future__ import annotations

from attrs import evolve

from laneweave.protocol.scenario import FormationSettings, Scenario

FORMATIONS = FormationSettings(operation="paper")
PAPER = Scenario(formation=FORMATIONS)


def paper(scenario: Scenario) -> Scenario:
    """Return a scenario in the paper's operation."""
    return evolve(scenario, formation=evolve(scenario.formation, operation="paper"))
