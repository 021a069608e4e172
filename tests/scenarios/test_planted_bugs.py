"""Every planted bug makes a scenario fail: the scenarios would notice if a rule were missing."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from scenarios.scenario_files import check_scenario, ends_in_collision, runner_of
from scenarios.scenario_text import ScenarioError
from support.bugs import Bug, catches
from support.planted_bugs import BUGS, NOT_A_SAFETY_MATTER

HERE = Path(__file__).parent
BOOKS = (VEHICLE_RULES, LEADER_RULES, TRANSFER_RULES)


@pytest.mark.parametrize(
    "bug", [pytest.param(bug, id=bug.name, marks=catches(bug)) for bug in BUGS]
)
def test_planted_bug_fails_its_scenario(bug: Bug, monkeypatch: pytest.MonkeyPatch) -> None:
    path = HERE / f"{bug.scenario}.txt"
    bug.plant(monkeypatch)
    with pytest.raises(ScenarioError):
        check_scenario(path, runner_of(path, bug.vehicle_rules, bug.leader_rules))
    collides = ends_in_collision(path, runner_of(path, bug.vehicle_rules, bug.leader_rules))
    assert collides is bug.collides


def test_every_rule_guard_and_action_is_broken_or_excused() -> None:
    assert {row.rule for book in BOOKS for row in book.table} <= {bug.rule for bug in BUGS}
    used = {function for book in BOOKS for function in book.functions}
    broken = {function for bug in BUGS for function in bug.replaced}
    assert used == broken | set(NOT_A_SAFETY_MATTER)
    assert not broken & set(NOT_A_SAFETY_MATTER)
