"""The unseen bugs can be planted, change something, and leave nothing behind."""

from __future__ import annotations

import pytest

from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from support.planted_bugs import BUGS, ROWS_OF_OTHERS, Bug, unchanged
from support.tables import for_each
from support.unseen_bugs import UNSEEN

RULES_IN_PROSE = {"V1", "C9"}
"""Rules of docs/PROTOCOL.md that are in no rule book."""

each_bug = for_each("bug", UNSEEN)


@each_bug
def test_planting_changes_something_and_is_undone(bug: Bug) -> None:
    patch = pytest.MonkeyPatch()
    with patch.context() as planted:
        bug.plant(planted)
        originals = [(target, name, old) for target, name, old in planted._setattr]
        assert all(getattr(target, str(name)) is not old for target, name, old in originals)
    assert all(getattr(target, str(name)) is old for target, name, old in originals)

    changed = _changed(bug.vehicle_rules, VEHICLE_RULES) + _changed(bug.leader_rules, LEADER_RULES)
    assert originals or changed
    assert bool(originals) is (bug.plant is not unchanged)
    assert bool(changed) is (bool(bug.replaced) or bug.vehicle_row is not None)


def _changed(book: RuleBook, original: RuleBook) -> list[Transition]:
    assert len(book.table) == len(original.table)
    return [row for row, old in zip(book.table, original.table, strict=True) if row != old]


def test_no_bug_has_the_name_of_another() -> None:
    assert len({bug.name for bug in (*BUGS, *UNSEEN)}) == len(BUGS) + len(UNSEEN)


def test_every_bug_breaks_a_rule_that_exists() -> None:
    books = (VEHICLE_RULES, LEADER_RULES, TRANSFER_RULES)
    rules = {row.rule for book in books for row in book.table}
    assert {bug.rule for bug in UNSEEN} <= rules | set(ROWS_OF_OTHERS) | RULES_IN_PROSE
