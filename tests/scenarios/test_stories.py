"""Every story in this folder goes exactly as written (`stories` tells how to read one)."""

from __future__ import annotations

from pathlib import Path

import pytest

from scenarios.stories import StoryError, check_story
from simulation import mutants
from simulation.mutants import Mutant

HERE = Path(__file__).parent
STORIES = sorted(HERE.glob("*.txt"))


@pytest.mark.parametrize("path", STORIES, ids=lambda path: path.stem)
def test_story(path: Path) -> None:
    check_story(path)


@pytest.mark.parametrize(
    ("plant", "story"),
    [
        (mutants.no_gate, "start_gate"),
        (mutants.no_gate, "plan_lost_for_one"),
        (mutants.no_promise_check, "late_duplicate_plan"),
        (mutants.no_promise_check, "zombie_leader"),
        (mutants.timetable_only, "dependency"),
        (mutants.needs_one_less, "dependency"),
        (mutants.ready_while_moving, "prepare_while_moving"),
        (mutants.foreign_motion_counts, "prepare_while_moving"),
        (mutants.any_ballot_releases, "newer_ballot_releases_nothing"),
    ],
)
def test_planted_bug_spoils_a_story(
    plant: Mutant, story: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant(monkeypatch)
    with pytest.raises(StoryError):
        check_story(HERE / f"{story}.txt")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("=> A promises", "without a command"),
        ("A jumps", "no such command"),
        ("vehicle A at 0,0 wants 1\nvehicle B at 0,0 wants 1", "both occupy"),
        ("vehicle A at 0,0 wants 1\nA ticks\n=> A moves 0,0 > 0,1", "A holds 0,0"),
        ("vehicle A at 0,0 wants 1\nA gets PLAN 1/L1/1/1", "nobody has sent"),
    ],
)
def test_a_wrong_story_is_told_why(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "wrong.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(StoryError, match=complaint):
        check_story(path)


def test_taking_an_old_plan_ends_in_an_occupied_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the promise the late duplicate is not only a wrong answer but a collision."""
    mutants.no_promise_check(monkeypatch)
    story = (HERE / "late_duplicate_plan.txt").read_text(encoding="utf-8")
    path = tmp_path / "collision.txt"
    path.write_text(
        story.replace("PLAN 1/L1/1/1\n  => A ignores it", "PLAN 1/L1/1/1\n  => A accepts"),
        encoding="utf-8",
    )
    with pytest.raises(StoryError, match="both occupy"):
        check_story(path)
