"""The random search can fail: it finds planted bugs.

`search_bugs.py` prints which ones, and with which seed; docs/SAFETY.md has its table. The seeds of
bugs that no text scenario was written for are replayed here; text scenarios of tests/scenarios and
stories catch the others.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from simulation.search_bugs import first_catch
from support.planted_bugs import BUGS, EVERY_BUG
from support.unseen_bugs import UNSEEN

EVIDENCE = Path(__file__).parents[2] / "docs" / "evidence" / "planted-bugs-found.json"
FOUND: dict[str, str] = {
    name: seen
    for name, seen in json.loads(EVIDENCE.read_text("utf-8"))["found"].items()
    if seen != "-"
}
"""Bugs that the search has found: profile, seed and kind of violation."""
LONG = {
    *("ballot-not-above-promises", "dropped-result-blocks-planning", "partners-not-asked"),
    *("formation-listed-by-block", "formations-overlap", "outbid-by-term-only"),
    *("any-transfer-opened", "assigned-cells-kept", "gate-opens-while-moving"),
    *("motion-stays-in-plan", "groups-not-merged", "ballots-numbered-by-formation"),
}
"""Unseen bugs whose seed takes more than three seconds, or that other tests catch sooner."""


def marks_of(name: str) -> list[pytest.MarkDecorator]:
    """Return the marks of the replay of the seed that found a bug."""
    if name not in {bug.name for bug in UNSEEN}:
        target = [pytest.mark.full]
    else:
        target = [pytest.mark.more] if name in LONG else []
    return [pytest.mark.catches(name), *target]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=marks_of(name), id=name) for name in FOUND]
)
def test_the_seed_that_found_a_planted_bug_finds_it(name: str) -> None:
    profile, seed, _ = FOUND[name].replace(":", "").split()
    catch = first_catch(EVERY_BUG[name], range(int(seed), int(seed) + 1), profile)
    assert catch is not None


@pytest.mark.more
@pytest.mark.catches("no-gate")
def test_a_search_finds_a_planted_bug() -> None:
    catch = first_catch(EVERY_BUG["no-gate"], range(25), "mixed")
    assert catch is not None
    assert "gate" in catch.kinds


def test_most_bugs_are_found() -> None:
    every = (*BUGS, *UNSEEN)
    assert sum(bug.name in FOUND for bug in every) >= 0.8 * len(every)
