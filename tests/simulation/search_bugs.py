"""Which planted bugs does the random search find, and with which seed?

    python tests/simulation/search_bugs.py [--unseen] [SEEDS] [BUG ...]

prints a Markdown table: for each bug of `planted_bugs.BUGS`, or of `unseen_bugs.UNSEEN`, the first
seed that catches it, and what was violated. The search uses the guided choice of profiles.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from attrs import frozen

if __name__ == "__main__":  # run as a program: as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1]))

from laneweave.launch.fault_search.coverage import Coverage
from laneweave.launch.fault_search.profiles import GUIDED, PROFILES, profiles_named
from laneweave.launch.fault_search.search import ROUND, run_story, silence_logs
from laneweave.launch.fault_search.story import Story
from support.planted_bugs import BUGS, Bug
from support.unseen_bugs import UNSEEN

SEEDS = 2000


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
        for first in range(seeds.start, seeds.stop, ROUND):
            numbers = range(first, min(first + ROUND, seeds.stop))
            for seed, name in zip(
                numbers, coverage.choose(names, len(numbers), first), strict=True
            ):
                result = run_story(Story.drawn(seed, PROFILES[name]), bug.rules)
                if result.violations:
                    kinds = tuple(dict.fromkeys(each.kind for each in result.violations))
                    return Catch(bug.name, name, seed, kinds)
                coverage.add(name, result.features, result.totals.delivered)
    return None


def bug_named(name: str) -> Bug:
    """Return a planted bug."""
    return next(bug for bug in (*BUGS, *UNSEEN) if bug.name == name)


def _search(name: str, count: int) -> Catch | None:
    silence_logs()
    return first_catch(bug_named(name), range(count))


def table(bugs: Sequence[Bug], catches: Iterable[Catch | None]) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    yield "| planted bug | rule | what is broken | random search |"
    yield "|---|---|---|---|"
    found = 0
    for bug, catch in zip(bugs, catches, strict=True):
        found += catch is not None
        seen = "-" if catch is None else f"{catch.profile} {catch.seed}: {', '.join(catch.kinds)}"
        yield f"| `{bug.name}` | {bug.rule} | {bug.text} | {seen} |"
    yield f"{found} of {len(bugs)} found"


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    every = UNSEEN if "--unseen" in arguments else BUGS
    count, *names = [each for each in arguments if each != "--unseen"] or [str(SEEDS)]
    bugs = [bug for bug in every if not names or bug.name in names]
    with ProcessPoolExecutor() as pool:
        catches = pool.map(partial(_search, count=int(count)), [bug.name for bug in bugs])
        for line in table(bugs, catches):
            sys.stdout.write(line + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
