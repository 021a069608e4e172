"""`laneweave simulate`: seeds, processes, what is printed, and how it ends."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import time
from unittest.mock import Mock

import psutil
import pytest
from attrs import evolve

from laneweave.launch.cli.options import check_jobs, parse_seeds
from laneweave.launch.fault_search import search as search_module
from laneweave.launch.fault_search.checks.violations import Violation
from laneweave.launch.fault_search.fault_run import FaultRun, SeedResult, Totals
from laneweave.launch.fault_search.profiles import PROFILES
from laneweave.launch.fault_search.search import (
    SearchResult,
    describe,
    run_tasks,
    search,
    timeline_of,
)
from laneweave.launch.fault_search.story import Story
from laneweave.protocol.errors import BadInputError
from support import commands
from support.commands import LANEWEAVE, Here

CALM = PROFILES["calm"]
WELL_UNDER_WAY_S = 2.5
"""Loading everything takes half of it."""


@pytest.mark.parametrize("text", ["", "5", "3:3", "4:3", "-1:3", "a:b", "0:1:2", "0:99999999999"])
def test_bad_seeds(text: str) -> None:
    assert parse_seeds("5:20") == range(5, 20)
    with pytest.raises(BadInputError, match="A:B with A < B"):
        parse_seeds(text)


@pytest.mark.parametrize("jobs", [0, -1, 1000])
def test_bad_jobs(jobs: int) -> None:
    with pytest.raises(BadInputError, match="--jobs"):
        check_jobs(jobs)


@pytest.mark.slow
@pytest.mark.more
def test_several_processes_have_the_results_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_module, "BATCH", 2)
    seeds = range(4)  # two batches
    one = search(seeds, [CALM], jobs=1, digest=True)
    two = search(seeds, [CALM], jobs=2, digest=True)
    assert one.digests == two.digests
    assert one.digest == two.digest
    assert evolve(one.totals, cpu_s=0.0, virtual_s=0.0) == evolve(
        two.totals, cpu_s=0.0, virtual_s=0.0
    )
    assert len(set(one.digests.values())) == one.passed == len(seeds)


@pytest.mark.slow
@pytest.mark.more
def test_profiles_and_seeds_make_different_runs() -> None:
    digests = {
        run_tasks([(seed, name)], digest=True)[0].digest
        for seed in (1, 2)
        for name in ("calm", "dense")
    }
    assert len(digests) == 4


def test_failures_are_described_with_the_command_that_replays_them() -> None:
    violation = Violation("cell", 3.25, ("v01", "v02"), "both occupy [(0, 0)]")
    failed = (SeedResult(17, (violation,), Totals(runs=1), profile="calm"),)
    lines = list(describe(SearchResult(Totals(runs=20), failed)))
    assert lines[:3] == [
        "seed 17 failed:",
        "     3.250 s  cell: v01, v02: both occupy [(0, 0)]",
        "  replay: laneweave simulate --seeds 17:18 --profile calm --verbose",
    ]
    assert lines[-1] == "19 passed, 1 failed"


@pytest.mark.slow
def test_a_crash_in_a_computation_is_a_violation() -> None:
    run = FaultRun(Story.drawn(0, CALM))
    run.network.at(1.0, run.network.failed_jobs.append, (1.0, "c1", "ValueError: no"))
    (violation,) = run.run().violations
    found = violation.kind, violation.vehicles, violation.text
    assert found == ("crash", ("c1",), "ValueError: no")


def test_timeline_of_a_run() -> None:
    lines = list(timeline_of(Story.drawn(1, CALM)))
    assert lines[0] == "calm 1:"
    told = "\n".join(lines)
    for words in ("PREPARE", "PLAN", "STATE", "COMMAND", "moves", "all faults end", "*** v01"):
        assert words in told


def test_timeline_of_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FaultRun, "run", Mock(side_effect=ValueError("no")))
    first, *_, last = timeline_of(Story.drawn(1, CALM))
    assert first == "calm 1:"
    assert "crash" in last
    assert "ValueError: no" in last


@pytest.mark.more
@pytest.mark.slow
def test_the_command() -> None:
    done = commands.laneweave(
        "simulate", "--seeds", "0:4", "--profile", "calm", "--jobs", "2", "--digest"
    )
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert lines[0].startswith("digest ")
    assert "x real time on one core" in lines[1]
    assert lines[-1] == "4 passed, 0 failed"
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--seeds", "9:3"], "--seeds: got '9:3'; allowed: A:B with A < B"),
        (["--shrink", "/none/x"], "--shrink: got '/none/x'; allowed: a file in an existing folder"),
        (["--profile", "mild"], "--profile: got 'mild'; allowed: guided, mixed, calm"),
        (["--jobs", "0"], "--jobs: got 0; allowed: [1, 256]"),
    ],
)
def test_bad_input_is_one_line(laneweave: Here, arguments: list[str], line: str) -> None:
    assert laneweave.refused("simulate", *arguments).startswith(line)


def spent_s(pid: int) -> float:
    """Return the processor time of a process and its children, on which other load has no say."""
    spent = 0.0
    for process in (psutil.Process(pid), *psutil.Process(pid).children()):
        with contextlib.suppress(psutil.NoSuchProcess):
            spent += process.cpu_times().user
    return spent


@pytest.mark.more
@pytest.mark.slow
@pytest.mark.parametrize("jobs", ["2", "1"])
def test_interrupted(jobs: str) -> None:
    process = subprocess.Popen(
        [LANEWEAVE, "simulate", "--seeds", "0:100000", "--jobs", jobs],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        while spent_s(process.pid) < WELL_UNDER_WAY_S:
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 1
    assert out == ""
    assert err == "interrupted\n"
