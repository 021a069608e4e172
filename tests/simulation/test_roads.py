"""Roads with ramps and exits in the fault search: it passes, and notices broken rules."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import run_story
from laneweave.launch.fault_search.story import Story
from support import broken_roads as broken

Bug = Callable[[pytest.MonkeyPatch], None]
BUGS: list[tuple[Bug, int]] = [
    (broken.ramps_are_issued_at_the_start, 0),
    (broken.cells_are_passed_on_twice, 0),
    (broken.exits_are_closed, 1),
    (broken.late_commands_repeat_moves, 386),
    (broken.gates_stay_open, 337),
    (broken.agents_insist, 337),
]
"""Bugs, and a seed of the profile `roads` that catches each."""


@pytest.mark.parametrize(("bug", "seed"), BUGS)
def test_planted_bugs_are_noticed(bug: Bug, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    story = Story.drawn(seed, PROFILES["roads"])
    assert run_story(story).violations == ()
    bug(monkeypatch)
    assert run_story(story).violations != ()


@pytest.mark.parametrize("seed", range(20))
def test_runs_without_violations(seed: int) -> None:
    assert run_story(Story.drawn(seed, PROFILES["roads"])).violations == ()


@pytest.mark.full
@pytest.mark.parametrize("seed", range(1000, 1200))
def test_more_runs_without_violations(seed: int) -> None:
    assert run_story(Story.drawn(seed, PROFILES["roads"])).violations == ()
