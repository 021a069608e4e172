"""The search: runs many seeds in several processes, and describes the results."""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice

import structlog
from attrs import evolve, field, frozen
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from laneweave.launch.fault_search.checks.violations import Violation
from laneweave.launch.fault_search.coverage import Coverage, Rules, all_features
from laneweave.launch.fault_search.fault_run import RULES, FaultRun, SeedResult, Totals
from laneweave.launch.fault_search.profiles import PROFILES, Profile
from laneweave.launch.fault_search.shrinking import shrink
from laneweave.launch.fault_search.story import Story
from laneweave.launch.fault_search.timeline import Timeline
from laneweave.launch.run.roles import die_with_supervisor, tune_garbage_collector
from laneweave.protocol.errors import CommandFailedError

BATCH = 20
"""Seeds per task of a worker process."""
ROUND = 200
"""Runs between two choices of profiles."""
SHOWN_VIOLATIONS = 5
"""Maximum number of violations printed per seed."""
SHOWN_SEEDS = 20
"""Maximum number of failed seeds described in detail."""
SHOWN_FEATURES = 10
"""Maximum number of features printed that no run has reached."""

Task = tuple[int, str]
"""A seed, and the name of the profile from which its run is drawn."""


@frozen
class SearchResult:
    """Result of a search."""

    totals: Totals = field(factory=Totals)
    failed: tuple[SeedResult, ...] = ()
    """Results of the seeds with violations, by ascending seed."""
    digests: dict[int, str] = field(factory=dict)
    """Digest of each seed, if requested."""
    coverage: Coverage = field(factory=Coverage, eq=False)
    """Rules and guards that the runs have reached."""

    @property
    def passed(self) -> int:
        """Number of seeds without violations."""
        return self.totals.runs - len(self.failed)

    @property
    def digest(self) -> str:
        """Digest over all seeds."""
        lines = "".join(f"{seed} {digest}\n" for seed, digest in sorted(self.digests.items()))
        return hashlib.blake2b(lines.encode(), digest_size=16).hexdigest()


def run_tasks(tasks: Sequence[Task], *, digest: bool = False) -> list[SeedResult]:
    """Run seeds in this process; a crash counts as a violation."""
    return [_run_seed(seed, name, digest=digest) for seed, name in tasks]


def _run_seed(seed: int, profile: str, *, digest: bool) -> SeedResult:
    return evolve(run_story(Story.drawn(seed, PROFILES[profile]), digest=digest), profile=profile)


def run_story(story: Story, rules: Rules = RULES, *, digest: bool = False) -> SeedResult:
    """Run a story; a crash counts as a violation."""
    try:
        return FaultRun(story, rules, digest=digest).run()
    except Exception as error:  # noqa: BLE001 (the search continues after any error of a core)
        return SeedResult(story.seed, (_crash(error),), Totals(runs=1))


def _crash(error: Exception) -> Violation:
    return Violation("crash", 0.0, (), f"{type(error).__name__}: {error}")


def search(
    seeds: range,
    profiles: Sequence[Profile],
    jobs: int,
    *,
    digest: bool = False,
    show: bool = False,
) -> SearchResult:
    """Run all seeds in `jobs` processes.

    With several profiles, runs are drawn from those that reach rarely reached rules and guards
    (`coverage`). The result does not depend on the number of processes.

    Args:
        seeds: seeds to run.
        profiles: profiles to draw from.
        jobs: number of processes.
        digest: whether to compute digests of all messages.
        show: whether to show a progress bar.
    """
    result = SearchResult()
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[failed]} failed"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        disable=not show,
        transient=True,
    )
    with bar, _workers(jobs if len(seeds) > BATCH else 1) as run:
        shown = bar.add_task(" ".join(each.name for each in profiles), total=len(seeds), failed=0)
        for tasks in rounds(seeds, [each.name for each in profiles], result.coverage):
            for outcomes in run(tasks, digest):
                result = _with(result, outcomes)
                bar.update(shown, completed=result.totals.runs, failed=len(result.failed))
    return result


def rounds(seeds: range, profiles: Sequence[str], coverage: Coverage) -> Iterator[list[Task]]:
    """Yield the tasks of each round, with profiles chosen by the coverage of earlier rounds."""
    size = ROUND if len(profiles) > 1 else len(seeds)
    for first in range(0, len(seeds), size):
        numbers = seeds[first : first + size]
        names = coverage.choose(profiles, len(numbers), numbers[0])
        yield list(zip(numbers, names, strict=True))


Runner = Callable[[Sequence[Task], bool], Iterator[list[SeedResult]]]
"""Runs tasks, with or without digests, and yields results in any order."""


@contextmanager
def _workers(jobs: int) -> Iterator[Runner]:
    """Return what runs tasks in this process, or in several."""
    if jobs == 1:
        tune_garbage_collector()

        def run_here(tasks: Sequence[Task], digest: bool) -> Iterator[list[SeedResult]]:
            for batch in _batches(tasks):
                yield run_tasks(batch, digest=digest)

        yield run_here
        return
    # A fork would copy locks held by the thread of the progress bar.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _prepare_worker) as pool:

        def run(tasks: Sequence[Task], digest: bool) -> Iterator[list[SeedResult]]:
            waiting = iter(_batches(tasks))
            running: set[Future[list[SeedResult]]] = set()
            # Submit only a few batches at a time, so that long searches start and end quickly.
            for batch in islice(waiting, 2 * jobs):
                running.add(pool.submit(run_tasks, batch, digest=digest))
            while running:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for batch in islice(waiting, len(done)):
                    running.add(pool.submit(run_tasks, batch, digest=digest))
                for future in done:
                    yield future.result()

        try:
            yield run
        except BrokenProcessPool as error:
            raise CommandFailedError("a worker of the search was killed") from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _batches(tasks: Sequence[Task]) -> list[Sequence[Task]]:
    return [tasks[first : first + BATCH] for first in range(0, len(tasks), BATCH)]


def _prepare_worker() -> None:
    """Ignore Ctrl-C and hang-ups, log critical errors only, and exit with the parent."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_supervisor()
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    silence_logs()
    tune_garbage_collector()


def silence_logs() -> None:
    """Log only critical errors: rejected messages and failed plans are normal in a search."""
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )


def _with(result: SearchResult, outcomes: Sequence[SeedResult]) -> SearchResult:
    failed = [*result.failed, *(outcome for outcome in outcomes if outcome.violations)]
    for outcome in outcomes:
        result.coverage.add(outcome.profile, outcome.features, outcome.totals.delivered)
    return SearchResult(
        sum((outcome.totals for outcome in outcomes), result.totals),
        tuple(sorted(failed, key=lambda outcome: outcome.seed)),
        result.digests | {outcome.seed: outcome.digest for outcome in outcomes if outcome.digest},
        result.coverage,
    )


# --- output ---------------------------------------------------------------------------------------


def describe(result: SearchResult) -> Iterator[str]:
    """Yield lines that describe the result of a search; the last line has the counts."""
    for outcome in result.failed[:SHOWN_SEEDS]:
        yield f"seed {outcome.seed} failed:"
        for violation in outcome.violations[:SHOWN_VIOLATIONS]:
            yield f"  {violation}"
        yield f"  replay: {replay_command(outcome.seed, outcome.profile)}"
    if len(result.failed) > SHOWN_SEEDS:
        others = [str(outcome.seed) for outcome in result.failed[SHOWN_SEEDS:]]
        yield f"further failed seeds: {' '.join(others[:200])}"
    yield from describe_totals(result.totals)
    yield from _describe_coverage(result.coverage)
    yield f"{result.passed} passed, {len(result.failed)} failed"


def replay_command(seed: int, profile: str) -> str:
    """Return the command that runs one seed again and prints its timeline."""
    return f"laneweave simulate --seeds {seed}:{seed + 1} --profile {profile} --verbose"


def _describe_coverage(coverage: Coverage) -> Iterator[str]:
    total, missing = len(set(all_features())), coverage.never_reached
    yield f"{total - len(missing)} of {total} rules and false guards reached"
    for feature in missing[:SHOWN_FEATURES]:
        yield f"  never: {feature}"


def describe_totals(totals: Totals) -> Iterator[str]:
    """Yield lines with the totals of a search."""
    pace = totals.virtual_s / totals.cpu_s if totals.cpu_s else 0.0
    yield (
        f"{totals.runs} runs, {totals.virtual_s:.0f} s of virtual time in {totals.cpu_s:.0f} s of "
        f"processor time: {pace:.0f} x real time on one core"
    )
    yield (
        f"{totals.vehicles} vehicles, {totals.motions} motions, {totals.plans} plans, "
        f"{totals.joint_plans} of them for joined formations"
    )
    yield (
        f"{totals.delivered} messages delivered, {totals.dropped} lost, "
        f"{totals.takeovers} takeovers by caretakers, "
        f"longest recovery {totals.longest_recovery_s:.1f} s"
    )
    faults = ", ".join(f"{kind} {count}" for kind, count in sorted(totals.faults.items()))
    yield f"faults: {faults or 'none'}"


def timeline_of(story: Story) -> Iterator[str]:
    """Run a story and yield the timeline around its first violation, or until it crashed."""
    timeline = Timeline()
    yield f"{story.name}:"
    try:
        outcome = FaultRun(story, timeline=timeline).run()
    except Exception as error:  # noqa: BLE001 (any error of a core)
        yield from timeline.around(())
        yield str(_crash(error))
    else:
        yield from timeline.around(outcome.violations)


def shrunk(story: Story, rules: Rules = RULES) -> Story:
    """Return the smallest story found that fails as the given one does."""
    return shrink(story, lambda smaller: run_story(smaller, rules).violations)
