"""Which planted bugs does the random search find, and with which seed?

    python tests/simulation/search_bugs.py [SEEDS] [BUG ...]
    python tests/simulation/search_bugs.py --stories BUG ...

The first form prints for each bug of `planted_bugs.BUGS` and `unseen_bugs.UNSEEN` the first seed
that catches it, and what was violated, as JSON: the content of
docs/evidence/planted-bugs-found.json. The search uses the guided choice of profiles. The second
form writes shrunk runs to tests/simulation/stories.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from attrs import evolve, frozen

if __name__ == "__main__":  # run as a program: as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1]))

from laneweave.launch.fault_search.coverage import Coverage
from laneweave.launch.fault_search.profiles import GUIDED, PROFILES, profiles_named
from laneweave.launch.fault_search.search import rounds, run_story, shrunk, silence_logs
from laneweave.launch.fault_search.story import Story
from support.bugs import Bug
from support.planted_bugs import BUGS, EVERY_BUG
from support.unseen_bugs import UNSEEN

SEEDS = 2000
STORIES = Path(__file__).parent / "stories"


@frozen
class Catch:
    """A seed that shows that a rule is broken."""

    bug: str
    profile: str
    seed: int
    kinds: tuple[str, ...]
    """What was violated."""


def first_catch(bug: Bug, seeds: range, profile: str = GUIDED) -> Catch | None:
    """Run seeds with a planted bug until a run is not as it must be.

    Raises:
        RuntimeError: the same run fails without the bug, too, so it shows nothing about the bug.
    """
    catch = _first_failure(bug, seeds, profile)
    if catch is not None:
        story = Story.drawn(catch.seed, PROFILES[catch.profile])
        if run_story(story).violations:
            raise RuntimeError(f"{story.name} fails without {bug.name}, too")
    return catch


def _first_failure(bug: Bug, seeds: range, profile: str) -> Catch | None:
    names = [each.name for each in profiles_named(profile)]
    coverage = Coverage()
    with pytest.MonkeyPatch.context() as patch:
        bug.plant(patch)
        for tasks in rounds(seeds, names, coverage):
            for seed, name in tasks:
                result = run_story(Story.drawn(seed, PROFILES[name]), bug.rules)
                if result.violations:
                    kinds = tuple(dict.fromkeys(each.kind for each in result.violations))
                    return Catch(bug.name, name, seed, kinds)
                coverage.add(name, result.features, result.totals.delivered)
    return None


def _search(name: str, count: int) -> Catch | None:
    silence_logs()
    return first_catch(EVERY_BUG[name], range(count))


def shrunk_story(bug: Bug, catch: Catch) -> Story:
    """Return the smallest story found that fails with a planted bug as a catch does."""
    with pytest.MonkeyPatch.context() as patch:
        bug.plant(patch)
        return shrunk(Story.drawn(catch.seed, PROFILES[catch.profile]), bug.rules)


def write_stories(names: Sequence[str]) -> None:
    """Write a shrunk story for each bug to `STORIES`."""
    silence_logs()
    for name in names:
        catch = first_catch(EVERY_BUG[name], range(SEEDS))
        if catch is not None:
            story = evolve(shrunk_story(EVERY_BUG[name], catch), name=name)
            (STORIES / f"{name}.json").write_text(story.text(), "utf-8")


def main(arguments: Sequence[str]) -> None:
    """Print what is found as JSON, or write stories."""
    if arguments[:1] == ["--stories"]:
        write_stories(arguments[1:])
        return
    count, *names = arguments or [str(SEEDS)]
    bugs = [bug.name for bug in (*BUGS, *UNSEEN) if not names or bug.name in names]
    found: dict[str, str] = {}
    with ProcessPoolExecutor() as pool:
        for name, catch in zip(
            bugs, pool.map(partial(_search, count=int(count)), bugs), strict=True
        ):
            seen = "-" if catch is None else f"{catch.profile} {catch.seed}: {catch.kinds[0]}"
            found[name] = seen
            sys.stderr.write(f"{name}: {seen}\n")
    sys.stdout.write(json.dumps({"seeds": int(count), "found": found}, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
