"""Committed stories: each fails with the planted bug of its name, and passes without it.

`search_bugs.py --stories` writes them. Changes of the protocol may change what happens in a story;
one that no longer fails with its bug is replaced.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.launch.fault_search.search import run_story
from laneweave.launch.fault_search.story import Story
from simulation.search_bugs import STORIES
from support.planted_bugs import EVERY_BUG

PATHS = sorted(STORIES.glob("*.json"))
LONG = {"superseded-command-played"}
"""Stories that take seconds; text scenarios catch their bugs, too."""


def test_there_are_stories() -> None:
    assert len(PATHS) >= 5


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path,
            id=path.stem,
            marks=[pytest.mark.catches(path.stem), *([pytest.mark.more] * (path.stem in LONG))],
        )
        for path in PATHS
    ],
)
def test_story(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    story, bug = Story.read(path), EVERY_BUG[path.stem]
    assert run_story(story).violations == ()
    bug.plant(monkeypatch)
    assert run_story(story, bug.rules).violations != ()
