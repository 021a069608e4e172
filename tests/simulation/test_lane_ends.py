"""Lanes that end in the fault search: it passes, and notices broken rules."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import run_story
from laneweave.launch.fault_search.story import Story
from support import broken_lane_ends as broken

Bug = Callable[[pytest.MonkeyPatch], None]
BUGS: list[tuple[Bug, int]] = [
    (broken.never_leaves, 4),
    (broken.agents_move_vehicles_without_cells, 6),
    (broken.agent_remembers, 6),
    (broken.gaps_are_given_away, 3),
    (broken.still_listed, 49),
    (broken.gap_taken_too_early, 3),
]
"""Bugs, and a seed of the profile `lane-ends` that catches each."""


@pytest.mark.parametrize(("bug", "seed"), BUGS)
def test_planted_bugs_are_noticed(bug: Bug, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    story = Story.drawn(seed, PROFILES["lane-ends"])
    assert run_story(story).violations == ()
    bug(monkeypatch)
    assert run_story(story).violations != ()


@pytest.mark.full
@pytest.mark.parametrize("seed", range(1000, 1100))
def test_more_runs_without_violations(seed: int) -> None:
    assert run_story(Story.drawn(seed, PROFILES["lane-ends"])).violations == ()
