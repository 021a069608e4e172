"""Lanes that end, ramps and exits in the fault search: it passes, and notices broken rules."""

from __future__ import annotations

from pathlib import Path

import pytest
from attrs import evolve

from laneweave.coordinator.rolling import operation
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import run_story
from laneweave.launch.fault_search.story import Story
from support import road_bugs
from support.bugs import Bug, catches

LANE_ENDS, ROADS, FORMATIONS = "lane-ends", "roads", "entry-roads"
INTERCHANGES = "interchanges"
SURPRISES, WITH_FORMATIONS = "surprises", "entry-surprises"
NOTICED: list[tuple[str, Bug, int]] = [
    (ROADS, road_bugs.ramps_are_issued_at_the_start, 0),
    (ROADS, road_bugs.cells_are_passed_on_twice, 0),
    (INTERCHANGES, road_bugs.cells_are_passed_on_twice, 0),
    (INTERCHANGES, road_bugs.owned_cells_are_entered, 1),
    (ROADS, road_bugs.late_commands_repeat_moves, 11),
    (ROADS, road_bugs.agents_insist, 54),
    (FORMATIONS, road_bugs.ramps_are_forgotten, 2),
    (FORMATIONS, road_bugs.columns_ahead_are_closed, 66),
    (LANE_ENDS, road_bugs.never_leaves, 6),
    (LANE_ENDS, road_bugs.agents_move_vehicles_without_cells, 4),
    (LANE_ENDS, road_bugs.agent_remembers, 4),
    (ROADS, road_bugs.exits_are_closed, 1),
    (ROADS, road_bugs.types_are_ignored, 2),
    (FORMATIONS, road_bugs.never_leaves, 6),
    (LANE_ENDS, road_bugs.gaps_are_given_away, 23),
    (LANE_ENDS, road_bugs.still_listed, 130),
    (LANE_ENDS, road_bugs.gap_taken_too_early, 4),
    (FORMATIONS, road_bugs.columns_are_not_reserved, 17),
    (FORMATIONS, road_bugs.exits_are_closed, 8),
    (FORMATIONS, road_bugs.types_are_ignored, 11),
    (SURPRISES, road_bugs.controllers_do_not_know, 1),
    (SURPRISES, road_bugs.parts_open_while_vehicles_wait, 0),
    (WITH_FORMATIONS, road_bugs.controllers_do_not_know, 3),
]
"""Profiles, bugs, and a seed that catches each."""


@pytest.mark.more
@pytest.mark.parametrize(
    ("profile", "bug", "seed"),
    [pytest.param(*row, id="{}-{.name}-{}".format(*row), marks=catches(row[1])) for row in NOTICED],
)
def test_planted_bugs_are_noticed(
    profile: str, bug: Bug, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    story = Story.drawn(seed, PROFILES[profile])
    if bug is road_bugs.late_commands_repeat_moves:
        # At the drawn rate, vehicles that hold send too few commands for this seed.
        road = evolve(story.setup.road, hold_period_ticks=1)
        story = evolve(story, setup=evolve(story.setup, road=road))
        # A leader that waits for vehicles that it has not heard plans around their moves.
        monkeypatch.setattr(operation, "HEAR_S", 0.0)
    assert run_story(story).violations == ()
    bug.plant(monkeypatch)
    assert run_story(story).violations != ()


@pytest.mark.more
@catches(road_bugs.gates_stay_open)
def test_an_agent_gives_up_a_move_that_its_lane_end_does_not_allow_any_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    story = Story.read(Path(__file__).parent / "roads" / "late-for-a-lane-that-ends.json")
    assert run_story(story).violations == ()
    road_bugs.gates_stay_open.plant(monkeypatch)
    assert [one.kind for one in run_story(story).violations] == ["stuck"]


@pytest.mark.more
@pytest.mark.parametrize(
    ("profile", "seed"),
    [
        (profile, n)
        for profile, count in (
            *((ROADS, 20), (INTERCHANGES, 10), (FORMATIONS, 6)),
            *((SURPRISES, 20), (WITH_FORMATIONS, 10)),
        )
        for n in range(count)
    ],
)
def test_runs_without_violations(profile: str, seed: int) -> None:
    assert run_story(Story.drawn(seed, PROFILES[profile])).violations == ()


@pytest.mark.full
@pytest.mark.parametrize(
    ("profile", "seed"),
    [
        (profile, seed)
        for profile, count in (
            (LANE_ENDS, 100),
            (ROADS, 200),
            (INTERCHANGES, 200),
            (FORMATIONS, 200),
            (SURPRISES, 1500),
            (WITH_FORMATIONS, 1500),
        )
        for seed in range(1000, 1000 + count)
    ],
)
def test_more_runs_without_violations(profile: str, seed: int) -> None:
    assert run_story(Story.drawn(seed, PROFILES[profile])).violations == ()
