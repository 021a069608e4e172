"""Which planted bugs does the random search find, and with which seed?

    python tests/simulation/search_bugs.py [SEEDS] [PROFILE ...]

prints a Markdown table: for each bug of `planted_bugs.BUGS` the first seed that catches it, and
what was violated. Bugs without one need a scripted schedule: the scenarios of tests/scenarios.
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

from laneweave.launch.fault_search.fault_run import FaultRun
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import silence_logs
from support.planted_bugs import BUGS, Bug

SEEDS = 500
SEARCHED = ("mixed", "joint", "rolling")
"""Profiles that are searched, one after the other."""


@frozen
class Catch:
    """A seed that shows that a rule is broken."""

    bug: str
    profile: str
    seed: int
    kinds: tuple[str, ...]
    """What was violated."""


def first_catch(bug: Bug, seeds: Iterable[int], profiles: Sequence[str] = SEARCHED) -> Catch | None:
    """Run seeds with a planted bug until a run is not as it must be.

    Raises:
        RuntimeError: the same run fails without the bug, too, so it shows nothing about the bug.
    """
    catch = _first_failure(bug, seeds, profiles)
    if catch is not None and FaultRun(catch.seed, PROFILES[catch.profile]).run().violations:
        raise RuntimeError(f"{catch.profile} {catch.seed} fails without {bug.name}, too")
    return catch


def _first_failure(bug: Bug, seeds: Iterable[int], profiles: Sequence[str]) -> Catch | None:
    with pytest.MonkeyPatch.context() as patch:
        bug.plant(patch)
        for profile in profiles:
            for seed in seeds:
                world = FaultRun(seed, PROFILES[profile], bug.vehicle_rules, bug.leader_rules)
                violations = world.run().violations
                if violations:
                    kinds = tuple(dict.fromkeys(violation.kind for violation in violations))
                    return Catch(bug.name, profile, seed, kinds)
    return None


def _search(name: str, count: int, profiles: Sequence[str]) -> Catch | None:
    silence_logs()
    return first_catch(bug_named(name), range(count), profiles)


def bug_named(name: str) -> Bug:
    """Return a planted bug."""
    return next(bug for bug in BUGS if bug.name == name)


def table(catches: Iterable[Catch | None]) -> Iterator[str]:
    """Return the lines of a Markdown table."""
    yield "| planted bug | rule | what is broken | random search | scenario |"
    yield "|---|---|---|---|---|"
    for bug, catch in zip(BUGS, catches, strict=True):
        found = "-" if catch is None else f"{catch.profile} {catch.seed}: {', '.join(catch.kinds)}"
        yield f"| `{bug.name}` | {bug.rule} | {bug.text} | {found} | `{bug.scenario}` |"


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    count = int(arguments[0]) if arguments else SEEDS
    search = partial(_search, count=count, profiles=arguments[1:] or SEARCHED)
    with ProcessPoolExecutor() as pool:
        for line in table(pool.map(search, [bug.name for bug in BUGS])):
            sys.stdout.write(line + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
