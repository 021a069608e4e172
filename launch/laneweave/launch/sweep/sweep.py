"""A sweep: execution of its points with progress, and a table of results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from laneweave.launch.recordings.results_over_seeds import PREFERRED, over_seeds, results_table
from laneweave.launch.recordings.runs import Run
from laneweave.launch.sweep.execution import PointResult
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point, volume_text
from laneweave.protocol.errors import CommandFailedError

COUNTED = "travel_time_s_n"
"""Number of vehicles of which the mean travel time is given."""
HEADINGS = ("volume", "in lane\n(%)", "travel\ntime (s)", "throughput", "counted", "runs")
"""Headings of the console's table, after that of the labels."""
CAPTION = (
    "Means over the seeds. volume, throughput: veh/(lane h); in lane: share that left in the "
    "preferred lane; counted: vehicles of the mean travel time; runs: finished/all."
)
WIDEST = 1000
"""Maximum width of the console's table, in characters."""
Runner = Callable[[Sequence[Point], Path], Generator[PointResult, None, None]]
"""Function that runs points in a folder and yields results; closing the generator stops them."""


def run_sweep(points: Sequence[Point], folder: SweepFolder, run: Runner, *, show: bool) -> int:
    """Run the unfinished points, and return the number of failed points.

    Raises:
        CommandFailedError: files or processes cannot be created.
    """
    waiting = [point for point in points if not folder.is_finished(point)]
    folder.write_results()
    try:
        with (
            _Progress(len(points), len(points) - len(waiting), show=show) as progress,
            closing(run(waiting, folder.unfinished)) as results,
        ):
            for result in results:
                progress.count(folder.add(result))
    except OSError as error:
        raise CommandFailedError(f"the sweep cannot continue: {error}") from error
    return sum(bool(folder.runs[point.name].reason) for point in points)


class _Progress(Progress):
    """A line per completed point and, on a terminal, a progress bar."""

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
            console.print(f"{finished} of {total} runs were already finished", highlight=False)

    def count(self, run: Run) -> None:
        """Count a completed point."""
        self._failed += bool(run.reason)
        self.update(self._task, advance=1, failed=self._failed)
        if self._show:
            reason = f": {escape(run.reason)}" if run.reason else ""
            line = f"{escape(run.folder.name)}: {run.status} in {run.wall_s:.1f} s{reason}"
            self.console.print(line, highlight=False, soft_wrap=True)


def console_table(first: str, headings: Iterable[str]) -> Table:
    """Return an empty table: a column of texts, then columns of numbers."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    table.add_column(first, no_wrap=True)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def print_table(console: Console, title: str, table: Table, caption: str) -> None:
    """Print a table in full, with a title above and a caption below."""
    # On a narrow console, lines are longer than the console rather than values shortened.
    table.width = console.measure(table, options=console.options.update(width=WIDEST)).maximum
    console.print(escape(title), highlight=False, soft_wrap=True)
    console.print(table, crop=False)
    console.print(caption, highlight=False, style="dim")


def print_results(points: Sequence[Point], folder: SweepFolder, console: Console) -> None:
    """Print a sweep's means over its seeds, and why runs failed."""
    runs = [folder.runs[point.name] for point in points]
    done = [folder.runs[point.name] for point in points if folder.is_finished(point)]
    columns = (PREFERRED, "travel_time_s_mean", "throughput_veh_per_lane_h")
    wanted = [(COUNTED, "sum"), *((column, "mean") for column in columns)]
    found = over_seeds(results_table(done), wanted)
    means = {(row["label"], row["volume_veh_per_lane_h"]): row for row in found}
    table = console_table("label", HEADINGS)
    for (label, volume), count in Counter(
        (run.label, run.volume_veh_per_lane_h) for run in runs
    ).items():
        row = means.get((label, volume), {"runs": 0})
        values = [row.get(f"{column}_mean") for column in columns]
        figures = ["-" if value is None else f"{value:.2f}" for value in values]
        counted = row.get(f"{COUNTED}_sum")
        number = "-" if counted is None else str(counted)
        table.add_row(
            escape(label), volume_text(volume), *figures, number, f"{row['runs']}/{count}"
        )
    print_table(console, f"laneweave sweep: {folder.out}", table, CAPTION)
    for run in runs:
        if run.reason:
            line = f"FAILED: {run.folder.name}: {run.reason}"
            console.print(line, style="bold red", highlight=False, markup=False, soft_wrap=True)
