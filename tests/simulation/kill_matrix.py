"""Which tests catch which planted bug?

    python tests/simulation/kill_matrix.py [BUG ...]

Writes docs/evidence/kill_matrix.json, from which `make docs` makes the tables of
docs/PLANTED_BUGS.md. Two kinds of tests catch a bug:

- tests with the marker `catches`: they plant the bug themselves and fail unless it is noticed;
- other tests that fail with the bug: each bug is planted in a process of its own, which is forked
  from one that has collected the tests, and runs them. For a bug that a marked test of `make test`
  catches these are the text scenarios; for others also the unit tests of `SUITE`.

With names of bugs, only these are examined anew. All take seven minutes of CPU time.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from _pytest.runner import runtestprotocol
from attrs import define, field
from hypothesis import Phase, settings

if __name__ == "__main__":  # run as a program: as `pythonpath` in pyproject.toml
    sys.path.insert(0, str(Path(__file__).parents[1]))

from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES
from laneweave.launch.fault_search.search import silence_logs
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from support.bugs import Bug
from support.examples import PART
from support.planted_bugs import EVERY_BUG

ROOT = Path(__file__).parents[2]
EVIDENCE = ROOT / "docs" / "evidence" / "kill_matrix.json"
SCENARIOS = "tests/scenarios/test_scenarios.py"
SUITE = (
    SCENARIOS,
    *("tests/unit/agents/test_core.py", "tests/unit/agents/test_charge.py"),
    "tests/unit/agents/test_host.py",
    "tests/unit/coordinator/formations",
    "tests/unit/coordinator/rolling",
    *("tests/unit/coordinator/test_core.py", "tests/unit/coordinator/test_election.py"),
    "tests/unit/protocol/vehicle",
    "tests/unit/sim_bridge/bodies/test_motion_controller.py",
    "tests/unit/sim_bridge/rolling",
    *("tests/unit/sim_bridge/test_charge.py", "tests/unit/sim_bridge/test_core.py"),
    *(
        f"tests/unit/sim_bridge/road/test_{name}.py"
        for name in ("caretaker", "entry", "formation_building", "roadside", "tick_answers")
    ),
)
"""Tests that bugs are planted into."""
MARKED = (
    *("tests/scenarios/test_planted_bugs.py", "tests/simulation"),
    "tests/unit/sim_bridge/road/test_lane_end_control.py",
    "tests/unit/sim_bridge/road/test_obstacles.py",
    "tests/unit/sim_bridge/road/test_passing_vehicles.py",
    "tests/unit/sim_bridge/road/test_several_causes.py",
)
"""Where tests with the marker are."""
JOBS = 2
LONGEST_S = 0.5
"""Tests that take more CPU time without a bug are left out, unless they carry the marker."""
LIMIT_S = 5.0
"""A test that takes more CPU time with a bug fails."""
WAIT_S = 60
"""A test that waits for longer fails."""
ENOUGH = 3
"""Number of other tests that fail with a bug, after which no more are tried."""


@define
class Examination:
    """Pytest plug-in that runs the collected tests once for each bug."""

    bugs: Sequence[str]
    marked: dict[str, dict[str, list[str]]] = field(factory=dict)
    """Tests that plant a bug, by bug and target."""
    failed: dict[str, list[str]] = field(factory=dict)
    """Other tests that fail with a bug."""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Find the tests that plant bugs, and keep those that bugs are planted into."""
        for item in items:
            for bug in (name for mark in item.iter_markers("catches") for name in mark.args):
                tests = self.marked.setdefault(bug, {}).setdefault(target_of(item), [])
                tests.append(item.nodeid)
        items[:] = [
            item
            for item in items
            if item.nodeid.startswith(SUITE)
            and target_of(item) == "test"
            and item.get_closest_marker("catches") is None
        ]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Plant one bug after the other, each in a fork of this process."""
        session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
        # Failing examples are not made smaller.
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("examination", settings.get_profile(PART), phases=phases)
        settings.load_profile("examination")
        took_s = next(_forked({"": session.items}))[1]
        healthy = [item for item in session.items if isinstance(took_s[item.nodeid], float)]
        healthy.sort(key=lambda item: took_s[item.nodeid])
        for nodeid in (each for each, seen in took_s.items() if not isinstance(seen, float)):
            sys.stderr.write(f"fails without a bug: {nodeid}\n")
        scenarios = [item for item in healthy if item.nodeid.startswith(SCENARIOS)]
        tests = {
            bug: scenarios if self.marked.get(bug, {}).get("test") else healthy for bug in self.bugs
        }
        for bug, results in _forked(tests):
            self.failed[bug] = [one for one, seen in results.items() if not isinstance(seen, float)]
            sys.stderr.write(f"{bug}: {len(self.failed[bug])} other tests\n")
        return True


def target_of(item: pytest.Item) -> str:
    """Return the target of the Makefile that runs a test: `test`, `more` or `full`."""
    found = (name for name in ("full", "more") if item.get_closest_marker(name) is not None)
    return next(found, "test")


Results = dict[str, Any]
"""CPU time [s] of each test; a text for a test that failed."""


def _forked(tests: Mapping[str, Sequence[pytest.Item]]) -> Iterator[tuple[str, Results]]:
    """Run tests with each bug planted, in `JOBS` processes at a time; the empty name: no bug."""
    waiting = list(tests)
    running: dict[int, tuple[str, int, bytearray]] = {}
    while waiting or running:
        while waiting and len(running) < JOBS:
            bug = waiting.pop(0)
            ours, theirs = os.pipe()
            pid = os.fork()
            if pid == 0:
                os.close(ours)
                _examine(EVERY_BUG.get(bug), tests[bug], theirs)
            os.close(theirs)
            running[ours] = (bug, pid, bytearray())
        for reader in select.select(list(running), [], [])[0]:
            bug, pid, text = running[reader]
            if data := os.read(reader, 1 << 16):
                text += data
                continue
            os.close(reader)
            os.waitpid(pid, 0)
            del running[reader]
            yield bug, json.loads(text)


def _examine(bug: Bug | None, items: Sequence[pytest.Item], writer: int) -> None:
    """Plant a bug, run tests, and write the results; this process ends here."""
    shown = os.dup(2)
    try:
        sink = os.open(os.devnull, os.O_WRONLY)
        for stream in (1, 2):
            os.dup2(sink, stream)
        for number in (signal.SIGALRM, signal.SIGPROF):
            signal.signal(number, _too_long)
        silence_logs()
        if bug is not None:
            plant(bug)
        with os.fdopen(writer, "w") as pipe:
            json.dump(_results(bug, items), pipe)
    except BaseException:  # noqa: BLE001 (nothing is above this function)
        os.write(shown, traceback.format_exc().encode())
    os._exit(0)


def _results(bug: Bug | None, items: Sequence[pytest.Item]) -> Results:
    results: Results = {}
    for item, following in zip(items, [*items[1:], None], strict=True):
        try:
            results[item.nodeid] = _run(item, following, LONGEST_S if bug is None else LIMIT_S)
        except (TooLongError, TypeError):  # the signal came inside pytest's report
            results[item.nodeid] = "too long"
            with contextlib.suppress(Exception):
                item.session._setupstate.teardown_exact(None)
        failed = sum(isinstance(result, str) for result in results.values())
        if bug is not None and failed >= ENOUGH:
            break
    return results


def plant(bug: Bug) -> None:
    """Plant a bug for the rest of this process, in the rule books as well."""
    books = (VEHICLE_RULES, LEADER_RULES, TRANSFER_RULES)
    broken = (bug.rules.vehicle, bug.rules.leader, bug.rules.transfer)
    tables = [book.table for book in broken]
    bug.plant(pytest.MonkeyPatch())
    for book, table in zip(books, tables, strict=True):
        book.__init__(table)  # type: ignore[misc]


class TooLongError(BaseException):
    """A test takes too long; not an `Exception`, so that nothing under test handles it."""


def _run(item: pytest.Item, following: pytest.Item | None, limit_s: float) -> float | str:
    begun_s = time.process_time()
    signal.alarm(WAIT_S)
    signal.setitimer(signal.ITIMER_PROF, limit_s)
    try:
        reports = runtestprotocol(item, log=False, nextitem=following)
    finally:
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    failed = next((report.when for report in reports if report.failed), None)
    return time.process_time() - begun_s if failed is None else str(failed)


def _too_long(_: int, __: FrameType | None) -> None:
    raise TooLongError


def examined(bugs: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return for each bug the tests that catch it, by target; marked ones first."""
    examination = Examination([name for name in EVERY_BUG if name in bugs])
    folders = [*SUITE, *MARKED]
    status = pytest.main(
        [*folders, "-q", "-p", "no:cacheprovider", "-p", "no:xdist",
         "--rootdir", str(ROOT)],
        plugins=[examination],
    )  # fmt: skip
    if status not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        raise RuntimeError(f"pytest ended with {status}")
    return {name: _entry(name, examination) for name in examination.bugs}


def _entry(name: str, examination: Examination) -> dict[str, Any]:
    others = examination.failed[name]
    tests = {
        target: list(dict.fromkeys(examination.marked.get(name, {}).get(target, [])))
        for target in ("test", "more")
    }
    tests["test"] += [nodeid for nodeid in others if nodeid not in tests["test"]]
    return {"rule": EVERY_BUG[name].rule, **tests}


def main(names: Sequence[str]) -> None:
    """Examine bugs, and write the evidence."""
    os.chdir(ROOT)
    known = json.loads(EVIDENCE.read_text("utf-8")) if names else {}
    found = examined(names or EVERY_BUG)
    merged = {name: found.get(name) or known[name] for name in EVERY_BUG}
    EVIDENCE.write_text(json.dumps(merged, indent=1) + "\n", "utf-8")
    for target, command in (("test", "make test"), ("more", "make test-more")):
        count = sum(bool(entry[target]) for entry in merged.values())
        sys.stdout.write(f"{count} of {len(merged)} bugs: caught by `{command}`\n")
    for name, entry in merged.items():
        if not entry["test"] and not entry["more"]:
            sys.stdout.write(f"not caught: {name}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
