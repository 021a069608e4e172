"""The method and the runs of a study, which a command continues where it was stopped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from laneweave.launch.recordings.runs import VARIED, Run, settings_of
from laneweave.launch.run_methods import METHODS, REFERENCE_METHODS
from laneweave.launch.sweep.execution import run_locally
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point
from laneweave.launch.sweep.sweep import run_sweep
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.recording.trips import WARM_UP_S


def checked_label(label: str, field: str, base: Scenario) -> str:
    """Return the label of a method that can be studied in a scenario.

    Raises:
        BadInputError: there is no such method, or its runs would give no travel times.
    """
    if label not in METHODS:
        REFERENCE_METHODS.checked(label, field, METHODS)
    duration_s = base.demand.duration_s
    if not base.sumo.config and duration_s <= WARM_UP_S:
        allowed = f"more than {WARM_UP_S:g}: travel times leave out the first {WARM_UP_S:g} s"
        raise BadInputError("demand.duration_s", duration_s, allowed)
    return label


@contextmanager
def finished_runs(
    points: Sequence[Point], out: Path, workers: int, *, show: bool, prefix: str | None = None
) -> Iterator[dict[str, list[Run]]]:
    """Run the points that are not finished; yield the runs by label, in the order of the points.

    Args:
        points: points with different names.
        out: folder of the runs, which is locked in the context.
        workers: maximum number of simultaneous processes.
        show: whether to show progress.
        prefix: labels that begin with it may be in the folder without being in `points`; runs of
            the labels in `points` may have other volumes and seeds.

    Raises:
        BadInputError: the folder has other runs, or runs with other settings.
        CommandFailedError: files or processes cannot be created.
    """
    wanted = {point.name: point for point in points}
    found: dict[str, list[Run]] = {point.label: [] for point in points}
    with SweepFolder(out) as folder:
        for name, run in folder.runs.items():
            point = wanted.get(name)
            if point is None:
                known = any(_are_alike(run, one) for one in points if one.label == run.label)
                known |= run.label not in found and bool(prefix and run.label.startswith(prefix))
            else:
                known = (run.method, run.scenario, run.plug_in) == (
                    point.method,
                    point.scenario,
                    REFERENCE_METHODS.origin(point.method),
                )
            if not known:
                allowed = f"a new folder: {run.folder} is of another study or has other settings"
                raise BadInputError("--out", str(out), allowed)
        run_sweep(points, folder, partial(run_locally, workers=workers), show=show)
        for point in points:
            found[point.label].append(folder.runs[point.name])
        yield found


def _are_alike(run: Run, point: Point) -> bool:
    """Return whether a run and a point differ only in volume and seed."""
    return run.method == point.method and settings_of(
        run.scenario, run.method, VARIED
    ) == settings_of(point.scenario, point.method, VARIED)
