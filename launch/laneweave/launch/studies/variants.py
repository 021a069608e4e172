"""Variants of a method's settings, and the points of a sweep over them.

A variant has a label of its own, as methods do; `tuning` and `sensitivity` compare variants.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from attrs import evolve, frozen

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import LabelledMethod, labelled
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point, check_plug_ins, with_volume
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


def check_recorded(folder: SweepFolder, points: Iterable[Point]) -> None:
    """Check that the finished points of a folder have the same settings as these.

    Raises:
        BadInputError: some have not.
    """
    for point in points:
        run = folder.runs.get(point.name)
        if run is not None and (run.method, run.scenario) != (point.method, point.scenario):
            allowed = f"a new folder: {run.folder} has other settings"
            raise BadInputError("--out", str(folder.out), allowed)


def runs_by_label(folder: SweepFolder, points: Iterable[Point]) -> dict[str, list[Run]]:
    """Return the finished runs of points, by label in the order of the points."""
    found: dict[str, list[Run]] = {}
    for point in points:
        runs = found.setdefault(point.label, [])
        if point.name in folder.runs:
            runs.append(folder.runs[point.name])
    return found
