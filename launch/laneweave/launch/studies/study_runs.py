"""The runs of a study: points of a sweep, which a command continues where it was stopped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from laneweave.launch.recordings.runs import Run
from laneweave.launch.sweep.execution import run_locally
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point
from laneweave.launch.sweep.sweep import run_sweep
from laneweave.protocol.errors import BadInputError


@contextmanager
def finished_runs(
    points: Sequence[Point], out: Path, workers: int, *, show: bool
) -> Iterator[dict[str, list[Run]]]:
    """Run the points that are not finished; yield the runs by label, in the order of the points.

    Args:
        points: points of variants.
        out: folder of a sweep, which is locked in the context.
        workers: maximum number of simultaneous processes.
        show: whether to show progress.

    Raises:
        BadInputError: the folder has runs with other settings, or is not that of a sweep.
        CommandFailedError: files or processes cannot be created.
    """
    with SweepFolder(out) as folder:
        for point in points:
            run = folder.runs.get(point.name)
            if run is not None and (run.method, run.scenario) != (point.method, point.scenario):
                allowed = f"a new folder: {run.folder} has other settings"
                raise BadInputError("--out", str(out), allowed)
        run_sweep(points, folder, partial(run_locally, workers=workers), show=show)
        found: dict[str, list[Run]] = {point.label: [] for point in points}
        for point in points:
            found[point.label].append(folder.runs[point.name])
        yield found
