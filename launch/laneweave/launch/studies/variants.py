"""Variants of a method's settings, and the points of a sweep over them.

A variant has a label of its own, as methods do; `tuning` and `sensitivity` compare variants.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from attrs import evolve, frozen

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import LabelledMethod, labelled
from laneweave.launch.sweep.execution import run_locally
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point, check_plug_ins, with_volume
from laneweave.launch.sweep.sweep import run_sweep
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario


@frozen
class Variant:
    """A method with settings that replace some of its own."""

    label: str
    settings: Mapping[str, object]
    """Values by `table.field`."""

    def scenario(self, method: str, base: Scenario) -> Scenario:
        """Return the scenario of the labelled method `method` with these settings.

        Raises:
            BadInputError: the settings contradict each other or the scenario.
        """
        known = labelled(method)
        return LabelledMethod(known.method, {**known.overrides, **self.settings}).settings(base)


def variant_points(
    variants: Iterable[Variant],
    method: str,
    base: Scenario,
    volumes: Sequence[float],
    seeds: Sequence[int],
) -> tuple[Point, ...]:
    """Return the points of variants x volumes x seeds, seed by seed.

    Raises:
        BadInputError: the settings of a variant contradict each other or the scenario.
    """
    kind = labelled(method).method
    settings: list[tuple[str, Scenario]] = []
    for variant in variants:
        try:
            for volume in volumes:
                scenario = variant.scenario(method, with_volume(base, volume))
                check_plug_ins(scenario, kind)
                settings.append((variant.label, scenario))
        except BadInputError as error:
            field = f"{error.field} ({variant.label})"
            raise BadInputError(field, error.value, error.allowed) from error
    return tuple(
        Point(label, kind, evolve(scenario, seed=seed), keep_trajectories=False)
        for seed in seeds
        for label, scenario in settings
    )


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
