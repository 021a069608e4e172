"""The random search can fail: it finds planted bugs.

`search_bugs.py` prints which ones, and with which seed; docs/SAFETY.md has its table. The text
scenarios of tests/scenarios catch the others.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from simulation.search_bugs import bug_named, first_catch
from support.planted_bugs import BUGS
from support.unseen_bugs import UNSEEN

EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence" / "planted-bugs-found.json"
SOON = {
    "lower-ballot-promised": ("loss", "monotone"),
    "promise-keeps-plan": ("mixed", "false"),
    "no-gate": ("mixed", "gate"),
    "need-minus-one": ("coordinators", "order"),
    "no-pacing": ("mixed", "early"),
    "second-plan-under-one-ballot": ("calm", "two-plans"),
    "promise-without-cell": ("mixed", "basis"),
    "planned-before-closed": ("mixed", "roster"),
    "start-cell-not-checked": ("harmful", "harmful"),
    "joined-not-learned": ("mixed", "stuck"),
    "ownership-without-gate": ("rolling", "owner"),
}
"""Bugs that a few seeds of a profile show, and as what."""
LONG = {
    *("need-minus-one", "planned-before-closed", "joined-not-learned"),
    *("promise-keeps-plan", "no-pacing"),
}
"""Bugs whose search takes more than ten seconds; text scenarios catch them, too."""
FOUND: dict[str, str] = {
    name: seen
    for name, seen in json.loads(EVIDENCE.read_text("utf-8"))["found"].items()
    if seen != "-"
}
"""Bugs that the search has found: profile, seed and kind of violation."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.more if name in LONG else ()) for name in SOON]
)
def test_planted_bug_is_found_soon(name: str) -> None:
    profile, kind = SOON[name]
    catch = first_catch(bug_named(name), range(25), profile)
    assert catch is not None
    assert kind in catch.kinds


@pytest.mark.full
@pytest.mark.parametrize("name", FOUND)
def test_planted_bug_is_found(name: str) -> None:
    profile, seed, _ = FOUND[name].replace(":", "").split()
    number = int(seed)
    catch = first_catch(bug_named(name), range(number, number + 1), profile)
    assert catch is not None


def test_most_bugs_are_found() -> None:
    every = (*BUGS, *UNSEEN)
    assert sum(bug.name in FOUND for bug in every) >= 0.8 * len(every)
