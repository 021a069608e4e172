"""A sweep from its points to its table, with progress."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from laneweave.launch.sweep.execution import Ended, Job
from laneweave.launch.sweep.folder import FAILED, PointRecord, SweepFolder, read_summary
from laneweave.launch.sweep.points import Point, volume_text
from laneweave.protocol.config.loading import to_tables
from laneweave.protocol.errors import CommandFailedError

Runner = Callable[[Sequence[Job], Path], Generator[Ended, None, None]]
"""Runs jobs in a folder, and yields each when it has ended; closing it ends all of them."""


def conduct(points: Sequence[Point], folder: SweepFolder, run: Runner, *, show: bool) -> int:
    """Run the points that are not finished, and return how many of all points have failed.

    Args:
        points: the sweep.
        folder: where finished points are, and new ones go.
        run: how they are run.
        show: whether to show progress on stderr.

    Raises:
        CommandFailedError: files or processes cannot be made.
    """
    waiting = {point.name: point for point in points if not folder.is_finished(point)}
    jobs = [
        Job(point.name, point.method, to_tables(point.scenario), point.keep_trajectories)
        for point in waiting.values()
    ]
    folder.write_results()
    try:
        with (
            _Progress(len(points), len(points) - len(jobs), show=show) as progress,
            closing(run(jobs, folder.unfinished)) as ends,
        ):
            for ended in ends:
                record = folder.take(waiting[ended.name], ended)
                progress.count(ended.name, record)
    except OSError as error:
        raise CommandFailedError(f"the sweep cannot go on: {error}") from error
    return sum(folder.records[point.name].status == FAILED for point in points)


class _Progress(Progress):
    """A bar on a terminal; elsewhere a line for each point."""

    def __init__(self, total: int, finished: int, *, show: bool) -> None:
        console = Console(stderr=True)
        super().__init__(
            TextColumn("sweep"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[failed]} failed"),
            TimeElapsedColumn(),
            console=console,
            disable=not show or not console.is_terminal,
            transient=True,
        )
        self._show = show
        self._failed = 0
        self._task = self.add_task("sweep", total=total, completed=finished, failed=0)
        if show and finished:
            console.print(f"{finished} of {total} runs were finished before", highlight=False)

    def count(self, name: str, record: PointRecord) -> None:
        """One more has ended."""
        self._failed += record.status == FAILED
        self.update(self._task, advance=1, failed=self._failed)
        if self._show:
            reason = f": {escape(record.reason)}" if record.reason else ""
            line = f"{escape(name)}: {record.status} in {record.wall_s:.1f} s{reason}"
            self.console.print(line, highlight=False, soft_wrap=True)


def print_results(points: Sequence[Point], folder: SweepFolder, console: Console) -> None:
    """Print what came of a sweep: means over its seeds, and what failed."""
    table = Table(title=f"laneweave sweep: {folder.out}")
    table.add_column("label")
    for heading in ("veh/(lane h)", "done", "failed", "travel time", "throughput", "on lane"):
        table.add_column(heading, justify="right")
    groups: dict[tuple[str, float], list[Point]] = {}
    for point in points:
        groups.setdefault((point.label, point.volume_veh_per_lane_h), []).append(point)
    for (label, volume), group in groups.items():
        done = [point for point in group if folder.is_finished(point)]
        summaries = [read_summary(folder.out / point.name) or {} for point in done]
        times = [summary["travel_time_s"]["mean"] for summary in summaries]
        rates = [summary["throughput_veh_per_lane_h"] for summary in summaries]
        shares = [
            100.0 * summary["vehicles"]["on_preferred_lane"] / summary["vehicles"]["left"]
            for summary in summaries
            if summary["vehicles"]["left"]
        ]
        table.add_row(
            label,
            volume_text(volume),
            str(len(done)),
            str(len(group) - len(done)),
            _mean(times, " s"),
            _mean(rates, ""),
            _mean(shares, " %"),
        )
    console.print(table)
    for point in points:
        record = folder.records[point.name]
        if record.status == FAILED:
            line = f"FAILED: {point.name}: {record.reason}"
            console.print(line, style="bold red", highlight=False, markup=False, soft_wrap=True)


def _mean(values: Sequence[float | None], unit: str) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.2f}{unit}" if known else "-"
