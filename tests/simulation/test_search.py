"""Random search: whatever happens to network and processes, no rule of the checker is broken.

Each seed draws road, vehicles, preferred lanes and faults (`laneweave.launch.fault_search`). The
command printed with a failure replays it. The whole programme is

    laneweave simulate --seeds 0:20000
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from laneweave.launch.fault_search.fault_run import SeedResult, Totals
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.road_setup import SLOT_S
from laneweave.launch.fault_search.search import replay_command, run_story, run_tasks
from laneweave.launch.fault_search.story import Story
from support.variants import variants

BATCH = 5
SEEDS = 20
LONG = {
    *("roads", "interchanges", "entry-roads", "lane-ends", "dense", "clocks"),
    *("surprises", "entry-surprises"),
    *("rolling", "rolling-dense", "entry-rolling", "harmful-rolling"),
}
"""Profiles whose search takes more than ten seconds."""
DIGESTS = range(1000, 1006)
_PRINT_DIGESTS = """
import json, sys
from laneweave.launch.fault_search.search import silence_logs, run_tasks
silence_logs()
outcomes = run_tasks([(seed, "mixed") for seed in range(*map(int, sys.argv[1:]))], digest=True)
print(json.dumps([outcome.digest for outcome in outcomes]))
"""


def search(profile: str, seeds: range) -> Totals:
    """Run seeds and return what they consisted of."""
    return sum((outcome.totals for outcome in outcomes(profile, seeds)), Totals())


def outcomes(profile: str, seeds: range, *, digest: bool = False) -> Iterator[SeedResult]:
    """Run seeds, in each of which no rule must be broken."""
    for seed in seeds:
        outcome = run_story(Story.drawn(seed, PROFILES[profile]), digest=digest)
        violations = "\n".join(map(str, outcome.violations))
        assert not violations, f"{violations}\n{replay_command(seed, profile)}"
        yield outcome


def check_something_happens(totals: Totals) -> None:
    """Check that a search of a batch is not idle."""
    assert totals.motions > 5 * BATCH
    assert totals.plans > 3 * BATCH
    assert totals.dropped > 50 * BATCH


@pytest.mark.more
@pytest.mark.parametrize("begin", range(0, SEEDS, BATCH))
def test_no_rule_is_broken_and_all_vehicles_arrive(begin: int) -> None:
    check_something_happens(search("mixed", range(begin, begin + BATCH)))


@pytest.mark.full
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("begin", range(100_000, 102_000, 100))
@pytest.mark.parametrize(("profile", "motions"), [("mixed", 500), ("rolling", 2000)])
def test_no_rule_is_broken_and_all_vehicles_arrive_long(
    profile: str, motions: int, begin: int
) -> None:
    assert search(profile, range(begin, begin + 100)).motions > motions


@pytest.mark.parametrize(
    ("profile", "seeds"),
    [
        pytest.param(name, seeds, marks=() if quick else pytest.mark.more, id=f"{name}-{seeds[0]}")
        for name in PROFILES
        if name != "mixed"
        for seeds, quick in (
            (range(1), name not in LONG),
            (range(1, {"rolling-dense": 2}.get(name, 4)), False),
        )
    ],
)
def test_profile(profile: str, seeds: range) -> None:
    search(profile, seeds)


@pytest.mark.full
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("profile", [name for name in PROFILES if name != "mixed"])
def test_profile_long(profile: str) -> None:
    search(profile, range(1000, 1200))


@pytest.mark.more
def test_formations_are_joined() -> None:
    assert search("joint", range(110, 122)).joint_plans > 0


def test_every_kind_of_fault_is_drawn() -> None:
    mixed = PROFILES["mixed"]
    stories = [Story.drawn(seed, mixed) for seed in range(200)]
    assert {event.kind for story in stories for event in story.events} == set(mixed.event_kinds)
    lasting = {kind for story in stories for kind in story.setup.lasting.kinds()}
    assert lasting == {
        "loss",
        "duplication",
        "reordering",
        "late-planning",
        "failing-planning",
        "lost-commands",
        "late-commands",
        "slow-moves",
        "wrong-clocks",
    }


@pytest.mark.parametrize("seed", variants(range(10), 1))
def test_without_faults_the_last_plan_is_not_late(seed: int) -> None:
    (outcome,) = run_tasks([(seed, "calm")])
    assert not outcome.violations
    # The last preferences change at most 1 s before the end of the phase; then follow one census,
    # the margin of a plan, and the steps: one of the current plan, at most eight of the last one.
    assert outcome.totals.longest_recovery_s < 1.0 + 0.5 + 9 * SLOT_S
    assert outcome.totals.dropped == 0


@pytest.mark.more
def test_equal_seeds_give_equal_runs_under_any_hash_seed() -> None:
    digests = [outcome.digest for outcome in outcomes("mixed", DIGESTS, digest=True)]
    assert len(set(digests)) == len(DIGESTS)
    assert _digests(DIGESTS, other_than=os.environ.get("PYTHONHASHSEED")) == digests


def _digests(seeds: range, other_than: str | None) -> list[str]:
    """Return the digests in a process with a hash seed that is surely another one than here."""
    done = subprocess.run(
        [sys.executable, "-c", _PRINT_DIGESTS, str(seeds.start), str(seeds.stop)],
        env=os.environ | {"PYTHONHASHSEED": "0" if other_than == "4711" else "4711"},
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
    )
    digests: list[str] = json.loads(done.stdout)
    return digests
