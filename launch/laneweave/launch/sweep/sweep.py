"""A sweep from its points to its table, with progress."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from laneweave.launch.recordings.results import PREFERRED, over_seeds, results_table
from laneweave.launch.recordings.runs import Run
from laneweave.launch.sweep.execution import Ended, Job
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point, volume_text
from laneweave.protocol.config.loading import to_tables
from laneweave.protocol.errors import CommandFailedError

Runner = Callable[[Sequence[Job], Path], Generator[Ended, None, None]]
"""Runs jobs in a folder and yields each at its end; closing the generator ends all of them."""


def conduct(points: Sequence[Point], folder: SweepFolder, run: Runner, *, show: bool) -> int:
    """Run the points that are not finished, and return the number of failed points.

    Args:
        points: the sweep.
        folder: where the points are recorded.
        run: runs the jobs.
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
                progress.count(ended.name, folder.take(waiting[ended.name], ended))
    except OSError as error:
        raise CommandFailedError(f"the sweep cannot go on: {error}") from error
    return sum(bool(folder.runs[point.name].reason) for point in points)


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

    def count(self, name: str, run: Run) -> None:
        """Count a point that has ended."""
        self._failed += bool(run.reason)
        self.update(self._task, advance=1, failed=self._failed)
        if self._show:
            reason = f": {escape(run.reason)}" if run.reason else ""
            line = f"{escape(name)}: {run.status} in {run.wall_s:.1f} s{reason}"
            self.console.print(line, highlight=False, soft_wrap=True)


def print_results(points: Sequence[Point], folder: SweepFolder, console: Console) -> None:
    """Print the results of a sweep: means over its seeds, and the reasons of failed runs."""
    runs = [folder.runs[point.name] for point in points]
    done = [folder.runs[point.name] for point in points if folder.is_finished(point)]
    columns = ("travel_time_s_mean", "throughput_veh_per_lane_h", PREFERRED)
    found = over_seeds(results_table(done), [(column, "mean") for column in columns])
    means = {(row["label"], row["volume_veh_per_lane_h"]): row for row in found}
    table = Table(title=f"laneweave sweep: {folder.out}")
    table.add_column("label")
    for heading in ("veh/(lane h)", "done", "failed", "travel time", "throughput", "on lane"):
        table.add_column(heading, justify="right")
    for key, count in Counter((run.label, run.volume_veh_per_lane_h) for run in runs).items():
        row = means.get(key, {"runs": 0})
        table.add_row(
            key[0],
            volume_text(key[1]),
            str(row["runs"]),
            str(count - row["runs"]),
            *(
                "-" if row.get(f"{column}_mean") is None else f"{row[f'{column}_mean']:.2f}{unit}"
                for column, unit in zip(columns, (" s", "", " %"), strict=True)
            ),
        )
    console.print(table)
    for point in points:
        run = folder.runs[point.name]
        if run.reason:
            line = f"FAILED: {point.name}: {run.reason}"
            console.print(line, style="bold red", highlight=False, markup=False, soft_wrap=True)
