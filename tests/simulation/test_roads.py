"""Lanes that end, ramps and exits in the fault search: it passes, and notices broken rules."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import run_story
from laneweave.launch.fault_search.story import Story
from support import broken_formations_on_roads, broken_lane_ends, broken_roads
from support.bug_register import Plant, catches

LANE_ENDS, ROADS, FORMATIONS = "lane-ends", "roads", "entry-roads"
QUICK: list[tuple[str, Plant, int]] = [
    (ROADS, broken_roads.ramps_are_issued_at_the_start, 0),
    (ROADS, broken_roads.cells_are_passed_on_twice, 0),
    (ROADS, broken_roads.late_commands_repeat_moves, 386),
    (ROADS, broken_roads.agents_insist, 337),
    (FORMATIONS, broken_formations_on_roads.ramps_are_forgotten, 2),
    (FORMATIONS, broken_formations_on_roads.columns_ahead_are_closed, 66),
]
"""Profiles, bugs, and a seed that catches each in a few seconds."""
LONG: list[tuple[str, Plant, int]] = [
    (LANE_ENDS, broken_lane_ends.never_leaves, 4),
    (LANE_ENDS, broken_lane_ends.agents_move_vehicles_without_cells, 17),
    (LANE_ENDS, broken_lane_ends.agent_remembers, 17),
    (ROADS, broken_roads.exits_are_closed, 1),
    (ROADS, broken_roads.types_are_ignored, 2),
    (FORMATIONS, broken_lane_ends.never_leaves, 6),
    (LANE_ENDS, broken_lane_ends.gaps_are_given_away, 3),
    (LANE_ENDS, broken_lane_ends.still_listed, 78),
    (LANE_ENDS, broken_lane_ends.gap_taken_too_early, 3),
    (FORMATIONS, broken_formations_on_roads.columns_are_not_reserved, 17),
    (FORMATIONS, broken_roads.exits_are_closed, 8),
    (FORMATIONS, broken_roads.types_are_ignored, 11),
]


@pytest.mark.parametrize(
    ("profile", "bug", "seed"),
    [
        *(pytest.param(*one, marks=catches(one[1])) for one in QUICK),
        *(pytest.param(*one, marks=[catches(one[1]), pytest.mark.more]) for one in LONG),
    ],
)
def test_planted_bugs_are_noticed(
    profile: str, bug: Plant, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    story = Story.drawn(seed, PROFILES[profile])
    assert run_story(story).violations == ()
    bug(monkeypatch)
    assert run_story(story).violations != ()


@pytest.mark.more
@catches(broken_roads.gates_stay_open)
def test_an_agent_gives_up_a_move_that_its_lane_end_does_not_allow_any_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    story = Story.read(Path(__file__).parent / "roads" / "late-for-a-lane-that-ends.json")
    assert run_story(story).violations == ()
    broken_roads.gates_stay_open(monkeypatch)
    assert [one.kind for one in run_story(story).violations] == ["stuck"]


@pytest.mark.more
@pytest.mark.parametrize(
    ("profile", "seed"),
    [(profile, n) for profile, count in ((ROADS, 20), (FORMATIONS, 6)) for n in range(count)],
)
def test_runs_without_violations(profile: str, seed: int) -> None:
    assert run_story(Story.drawn(seed, PROFILES[profile])).violations == ()


@pytest.mark.full
@pytest.mark.parametrize(
    ("profile", "seed"),
    [
        (profile, seed)
        for profile, count in ((LANE_ENDS, 100), (ROADS, 200), (FORMATIONS, 200))
        for seed in range(1000, 1000 + count)
    ],
)
def test_more_runs_without_violations(profile: str, seed: int) -> None:
    assert run_story(Story.drawn(seed, PROFILES[profile])).violations == ()
