"""All planted bugs can be planted; docs/evidence/kill_matrix.json names tests that catch them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import attrs
import pytest

from laneweave.launch.fault_search.coverage import Rules
from support.bugs import Bug, unchanged
from support.planted_bugs import BUGS, EVERY_BUG, ROWS_OF_OTHERS
from support.road_bugs import ROAD_BUGS
from support.tables import for_each
from support.unseen_bugs import UNSEEN

ROOT = Path(__file__).parents[2]
CAUGHT = json.loads((ROOT / "docs" / "evidence" / "kill_matrix.json").read_text("utf-8"))
MAKE_TEST = "not full and not more"
"""Selection of `make test`."""
RULES_IN_PROSE = {"V1", "C9"}
"""Rules of docs/PROTOCOL.md that are in no rule book."""


def test_it_has_all_planted_bugs() -> None:
    assert CAUGHT.keys() == EVERY_BUG.keys()
    assert len(EVERY_BUG) == len(BUGS) + len(UNSEEN) + len(ROAD_BUGS), "names are unique"


def test_all_bugs_are_caught_and_nearly_all_by_make_test() -> None:
    assert [name for name, caught in CAUGHT.items() if not caught["test"] + caught["more"]] == []
    assert sum(bool(caught["test"]) for caught in CAUGHT.values()) >= 100


def test_tests_that_are_named_exist() -> None:
    named = {test for caught in CAUGHT.values() for test in (*caught["test"], *caught["more"])}
    for test in named:
        path, function = re.match(r"([^:]+)::(\w+)", test).groups()  # type: ignore[union-attr]
        assert f"\ndef {function}(" in (ROOT / path).read_text("utf-8"), test


def test_tests_that_are_named_are_run_by_make_test(request: pytest.FixtureRequest) -> None:
    config, collected = request.config, {item.nodeid for item in request.session.items}
    folders = [ROOT / folder for folder in config.getini("testpaths")]
    whole = [ROOT / folder for folder in config.args] == folders and not config.option.keyword
    if config.option.markexpr != MAKE_TEST or not whole:
        pytest.skip("only with the whole of `make test`")
    for name, caught in CAUGHT.items():
        assert set(caught["test"]) <= collected, name


def test_every_bug_says_what_it_breaks() -> None:
    books = attrs.astuple(Rules(), recurse=False)
    rules = {row.rule for book in books for row in book.table}
    assert {bug.rule for bug in (*BUGS, *UNSEEN)} <= rules | set(ROWS_OF_OTHERS) | RULES_IN_PROSE
    assert [bug.name for bug in EVERY_BUG.values() if not bug.text.endswith(".")] == []


@for_each("bug", EVERY_BUG.values())
def test_every_bug_can_be_planted(bug: Bug) -> None:
    """What it replaces exists, is another one with the bug, and is there again without it."""
    intact = attrs.astuple(Rules(), recurse=False)
    with pytest.MonkeyPatch.context() as patch:
        bug.plant(patch)
        replaced = [(target, name, old) for target, name, old in patch._setattr]
        assert all(getattr(target, str(name)) is not old for target, name, old in replaced)
        books = attrs.astuple(bug.rules, recurse=False)
    assert all(getattr(target, str(name)) is old for target, name, old in replaced)
    assert bug.replaced.keys() <= {rule for book in intact for rule in book.functions}
    assert bool(replaced) is (bug.plant is not unchanged)
    assert replaced or books != intact
