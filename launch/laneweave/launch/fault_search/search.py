"""The search: runs many seeds in several processes, and describes the results."""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import signal
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice

import structlog
from attrs import field, frozen
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from laneweave.launch.fault_search.checker import Violation
from laneweave.launch.fault_search.fault_run import FaultRun, SeedResult, Totals
from laneweave.launch.fault_search.profiles import Profile
from laneweave.launch.fault_search.timeline import Timeline
from laneweave.launch.run.roles import die_with_supervisor, tune_garbage_collector
from laneweave.protocol.errors import CommandFailedError

BATCH = 20
"""Seeds per task of a worker process."""
SHOWN_VIOLATIONS = 5
"""Maximum number of violations printed per seed."""
SHOWN_SEEDS = 20
"""Maximum number of failed seeds described in detail."""


@frozen
class SearchResult:
    """Result of a search."""

    totals: Totals = field(factory=Totals)
    failed: tuple[SeedResult, ...] = ()
    """Results of the seeds with violations, by ascending seed."""
    digests: dict[int, str] = field(factory=dict)
    """Digest of each seed, if requested."""

    @property
    def passed(self) -> int:
        """Number of seeds without violations."""
        return self.totals.runs - len(self.failed)

    @property
    def digest(self) -> str:
        """Digest over all seeds."""
        lines = "".join(f"{seed} {digest}\n" for seed, digest in sorted(self.digests.items()))
        return hashlib.blake2b(lines.encode(), digest_size=16).hexdigest()


def run_seeds(seeds: Sequence[int], profile: Profile, *, digest: bool = False) -> list[SeedResult]:
    """Run seeds in this process; a crash counts as a violation."""
    return [_run_seed(seed, profile, digest=digest) for seed in seeds]


def _run_seed(seed: int, profile: Profile, *, digest: bool) -> SeedResult:
    try:
        return FaultRun(seed, profile, digest=digest).run()
    except Exception as error:  # noqa: BLE001 (the search continues after any error of a core)
        text = f"{type(error).__name__}: {error}"
        return SeedResult(seed, (Violation("crash", 0.0, (), text),), Totals(runs=1))


def search(
    seeds: range, profile: Profile, jobs: int, *, digest: bool = False, show: bool = False
) -> SearchResult:
    """Run all seeds in `jobs` processes, optionally with message digests and a progress bar."""
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
    with bar:
        task = bar.add_task(profile.name, total=len(seeds), failed=0)
        for outcomes in _batches(seeds, profile, jobs, digest=digest):
            result = _with(result, outcomes)
            bar.update(task, completed=result.totals.runs, failed=len(result.failed))
    return result


def _batches(
    seeds: range, profile: Profile, jobs: int, *, digest: bool
) -> Iterator[list[SeedResult]]:
    batches = [seeds[first : first + BATCH] for first in range(0, len(seeds), BATCH)]
    if jobs == 1 or len(batches) == 1:
        tune_garbage_collector()
        for batch in batches:
            yield run_seeds(batch, profile, digest=digest)
        return
    # A fork would copy locks held by the thread of the progress bar.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(batches)), context, _prepare_worker) as pool:
        waiting = iter(batches)
        running: set[Future[list[SeedResult]]] = set()
        try:
            # Submit only a few batches at a time, so that long searches start and end quickly.
            for batch in islice(waiting, 2 * jobs):
                running.add(pool.submit(run_seeds, batch, profile, digest=digest))
            while running:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for batch in islice(waiting, len(done)):
                    running.add(pool.submit(run_seeds, batch, profile, digest=digest))
                for future in done:
                    yield future.result()
        except BrokenProcessPool as error:
            raise CommandFailedError("a worker of the search was killed") from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _prepare_worker() -> None:
    """Ignore Ctrl-C, log critical errors only, and exit with the parent."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_supervisor()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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
    return SearchResult(
        sum((outcome.totals for outcome in outcomes), result.totals),
        tuple(sorted(failed, key=lambda outcome: outcome.seed)),
        result.digests | {outcome.seed: outcome.digest for outcome in outcomes if outcome.digest},
    )


# --- output ---------------------------------------------------------------------------------------


def describe(result: SearchResult, profile: Profile) -> Iterator[str]:
    """Yield lines that describe the result of a search; the last line has the counts."""
    for outcome in result.failed[:SHOWN_SEEDS]:
        yield f"seed {outcome.seed} failed:"
        for violation in outcome.violations[:SHOWN_VIOLATIONS]:
            yield f"  {violation}"
        yield f"  replay: {replay_command(outcome.seed, profile)}"
    if len(result.failed) > SHOWN_SEEDS:
        others = [str(outcome.seed) for outcome in result.failed[SHOWN_SEEDS:]]
        yield f"further failed seeds: {' '.join(others[:200])}"
    yield from describe_totals(result.totals)
    yield f"{result.passed} passed, {len(result.failed)} failed"


def replay_command(seed: int, profile: Profile) -> str:
    """Return the command that runs one seed again and prints its timeline."""
    return f"laneweave simulate --seeds {seed}:{seed + 1} --profile {profile.name} --verbose"


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


def timeline_of(seed: int, profile: Profile) -> Iterator[str]:
    """Run one seed again and yield the timeline around its first violation."""
    timeline = Timeline()
    outcome = FaultRun(seed, profile, timeline=timeline).run()
    yield f"seed {seed}, profile {profile.name}:"
    yield from timeline.around(outcome.violations)
