"""docs/evidence/kill_matrix.json names tests that exist, for all planted bugs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import attrs
import pytest

from laneweave.launch.fault_search.coverage import Rules
from support.bug_register import EVERY_BUG
from support.planted_bugs import BUGS, Bug, unchanged
from support.unseen_bugs import UNSEEN

ROOT = Path(__file__).parents[2]
CAUGHT = json.loads((ROOT / "docs" / "evidence" / "kill_matrix.json").read_text("utf-8"))
MAKE_TEST = "not full and not more"
"""Selection of `make test`."""


def test_it_has_all_planted_bugs() -> None:
    assert CAUGHT.keys() == EVERY_BUG.keys()
    assert len(BUGS) + len(UNSEEN) < len(EVERY_BUG)


def test_all_bugs_are_caught_and_nearly_all_by_make_test() -> None:
    assert [name for name, caught in CAUGHT.items() if not caught["test"] + caught["more"]] == []
    assert sum(bool(caught["test"]) for caught in CAUGHT.values()) >= 100


def test_tests_that_are_named_exist() -> None:
    named = {test for caught in CAUGHT.values() for test in (*caught["test"], *caught["more"])}
    for test in named:
        path, function = re.match(r"([^:]+)::(\w+)", test).groups()  # type: ignore[union-attr]
        assert f"\ndef {function}(" in (ROOT / path).read_text("utf-8"), test


def test_tests_that_are_named_are_run_by_make_test(request: pytest.FixtureRequest) -> None:
    option, collected = request.config.option, {item.nodeid for item in request.session.items}
    files = {test.partition("::")[0] for test in collected}
    named = {test.partition("::")[0] for caught in CAUGHT.values() for test in caught["test"]}
    if option.markexpr != MAKE_TEST or option.keyword or not named <= files:
        pytest.skip("only with the whole of `make test`")
    for name, caught in CAUGHT.items():
        assert set(caught["test"]) <= collected, name


def test_every_bug_says_what_it_breaks() -> None:
    assert [bug.name for bug in EVERY_BUG.values() if not bug.text.endswith(".")] == []


@pytest.mark.parametrize("bug", EVERY_BUG.values(), ids=lambda bug: bug.name)
def test_every_bug_can_be_planted(bug: Bug, monkeypatch: pytest.MonkeyPatch) -> None:
    """What it replaces exists; most of the tests that plant it are not run by `make test`."""
    with monkeypatch.context() as patch:
        bug.plant(patch)
        books = attrs.astuple(bug.rules, recurse=False)
    intact = attrs.astuple(Rules(), recurse=False)
    used = {rule for book in intact for rule in book.functions}
    assert bug.replaced.keys() <= used
    assert bug.plant is not unchanged or books != intact
