"""The random search can fail: it finds planted bugs.

`search_bugs.py` prints which ones, and with which seed; docs/SAFETY.md has its table. The text
scenarios of tests/scenarios catch the others.
"""

from __future__ import annotations

import pytest

from simulation.search_bugs import SEEDS, bug_named, first_catch

SOON = {
    "lower-ballot-promised": ("mixed", "monotone"),
    "no-gate": ("mixed", "interleaved"),
    "old-motion-counts": ("mixed", "cell"),
    "second-plan-under-one-ballot": ("mixed", "two-plans"),
    "promise-keeps-plan": ("mixed", "motion"),
    "joined-not-learned": ("mixed", "stuck"),
    "ownership-not-taken": ("rolling", "gate"),
    "ownership-without-gate": ("rolling", "owner"),
}
"""Bugs that a few seeds of a profile show, and as what; each kind of violation but `overlap`."""
FOUND = (
    "lower-ballot-promised",
    "promise-keeps-count",
    "promise-keeps-plan",
    "promise-keeps-heard",
    "joining-not-asked",
    "no-promise-check",
    "lower-ballot-plan-accepted",
    "plan-taken-twice",
    "no-gate",
    "gate-minus-one",
    "gate-on-promise",
    "ready-while-moving",
    "one-acceptance-opens-the-gate",
    "go-of-another-ballot",
    "release-on-any-ballot",
    "move-under-way-counts",
    "timetable",
    "lease",
    "need-minus-one",
    "start-while-moving",
    "counted-at-the-start",
    "old-motion-counts",
    "second-plan-under-one-ballot",
    "joined-not-learned",
    "part-of-blocks-planned",
    "ownership-not-taken",
    "moves-outside-owned-cells",
    "ownership-without-gate",
    "transfer-after-promise",
    "ownership-lost-with-process",
    "closed-transfers-ignored",
    "common-promise-cancels-transfers",
    "cell-kept-by-both",
)
"""Bugs that the search has been seen to find, each with a run that passes without the bug."""


@pytest.mark.parametrize("name", SOON)
def test_planted_bug_is_found_soon(name: str) -> None:
    profile, kind = SOON[name]
    catch = first_catch(bug_named(name), range(25), [profile])
    assert catch is not None
    assert kind in catch.kinds


@pytest.mark.full
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", FOUND)
def test_planted_bug_is_found(name: str) -> None:
    assert first_catch(bug_named(name), range(SEEDS)) is not None
