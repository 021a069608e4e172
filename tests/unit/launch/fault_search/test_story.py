"""Stories: stored, read again, refused if malformed, shrunk."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from attrs import evolve

from laneweave.launch.fault_search.checks.violations import Violation
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import run_story
from laneweave.launch.fault_search.shrinking import shrink
from laneweave.launch.fault_search.story import Story
from laneweave.protocol.errors import BadInputError
from support import commands
from support.commands import Here


@pytest.mark.parametrize("name", PROFILES)
def test_a_story_is_read_as_it_was_written(name: str, tmp_path: Path) -> None:
    story, path = Story.drawn(3, PROFILES[name]), tmp_path / "story.json"
    path.write_text(story.text(), "utf-8")
    assert Story.read(path) == story


def test_the_same_story_gives_the_same_run() -> None:
    story = Story.drawn(4, PROFILES["small"])
    assert run_story(story, digest=True).digest == run_story(story, digest=True).digest


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schema": "laneweave.story/9"}, "laneweave.story/1"),
        ({"seed": "one"}, "seed"),
        ({"weather": 1}, "weather"),
        ({"events": [{"t_s": 1.0, "kind": "rain", "seed": 1}]}, "events"),
    ],
)
def test_a_malformed_story_is_refused_in_one_line(
    laneweave: Here, tmp_path: Path, change: dict[str, object], words: str
) -> None:
    path = tmp_path / "story.json"
    table = json.loads(Story.drawn(1, PROFILES["calm"]).text()) | change
    path.write_text(json.dumps(table), "utf-8")
    assert words in laneweave.refused("simulate", "--story", str(path))


@pytest.mark.more
@pytest.mark.slow
def test_the_command_runs_a_story(tmp_path: Path) -> None:
    path = tmp_path / "story.json"
    path.write_text(Story.drawn(1, PROFILES["small"]).text(), "utf-8")
    done = commands.laneweave("simulate", "--story", str(path), "--verbose")
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert lines[0] == "small 1:"
    assert lines[-1] == "passed"


def test_a_story_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="a readable file"):
        Story.read(tmp_path / "missing.json")


def test_shrinking_keeps_only_what_the_failure_needs() -> None:
    """The check fails while one event and one vehicle are there; both must survive."""
    story = Story.drawn(10, PROFILES["mixed"])
    event, visit = story.events[len(story.events) // 2], story.setup.visits[-1]

    def check(smaller: Story) -> tuple[Violation, ...]:
        if event in smaller.events and visit in smaller.setup.visits:
            return (Violation("cell", event.t_s + 0.1, (), ""),)
        return ()

    small = shrink(story, check)
    assert small.events == (event,)
    assert small.setup.visits == (visit,)
    assert small.fault_s < story.fault_s
    assert small.setup.lasting.conditions.loss == 0.0
    assert not small.setup.lasting.wrong_clocks


def test_a_story_that_passes_is_not_shrunk() -> None:
    story = Story.drawn(10, PROFILES["mixed"])
    assert shrink(story, lambda _: ()) is story


def test_shrinking_is_bounded() -> None:
    story, runs = Story.drawn(10, PROFILES["mixed"]), []

    def check(smaller: Story) -> tuple[Violation, ...]:
        runs.append(smaller)
        return (Violation("cell", 1.0, (), ""),)

    shrink(evolve(story), check, max_runs=7)
    assert len(runs) == 7
