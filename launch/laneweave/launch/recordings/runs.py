"""Runs in the folders of runs and sweeps, and comparisons of runs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from attrs import evolve, frozen

from laneweave.launch.recordings.files import TRAJECTORIES_FILE, TRIPS_FILE, not_a_run, reading
from laneweave.launch.run_methods import FORMATION, affects, rank
from laneweave.protocol.config.scenario_files import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.operations import DEFAULT_OPERATION
from laneweave.protocol.summary import Ending, RunSummary, read_summary
from laneweave.sim_bridge.recording.columns import SCENARIO_KEY

SWEEP_FILE, POINT_FILE = "sweep.json", "point.json"
"""Files that identify the folders of sweeps and of their points."""
POINT_SCHEMA = "laneweave.sweep.point/1"
VARIED = ("demand.volume_veh_per_lane_h", "seed")
"""Fields of a scenario in which runs of a label may differ."""
_OF_DEMAND = ("demand.", "entrance", "exit", "vehicle_type")
"""Fields of a scenario that follow from the demand of a SUMO simulation."""


@frozen
class Run:
    """A finished run."""

    folder: Path
    label: str
    """In sweeps, the label of the method with its settings; for other runs, the method."""
    method: str
    """Value of `laneweave run --method`."""
    scenario: Scenario
    summary: RunSummary | None
    """Summary; None: the run failed without a summary."""
    reason: str = ""
    """Reason for the failure; empty: success."""
    wall_s: float | None = None
    """Run time of the run's process; None: unknown."""
    plug_in: str = ""
    """Distribution and version of a method that is a plug-in; empty: none, or unknown."""

    @property
    def status(self) -> str:
        """`done` or `failed`."""
        return "failed" if self.reason else "done"

    @property
    def volume_veh_per_lane_h(self) -> float:
        """Demand per lane."""
        return self.scenario.demand.volume_veh_per_lane_h

    @property
    def title(self) -> str:
        """Label, operation if it is the rolling one, volume and seed."""
        operation, label = self.scenario.formation.operation, self.label
        if self.method == FORMATION == label and operation != DEFAULT_OPERATION:
            label = f"{label} ({operation} operation)"
        return f"{label}, {self.volume_veh_per_lane_h:g} veh/(lane·h), seed {self.scenario.seed}"

    @property
    def has_trajectories(self) -> bool:
        """Whether trajectories were kept."""
        return (self.folder / TRAJECTORIES_FILE).is_file()

    @property
    def preferred_percent(self) -> float | None:
        """Percentage of the departed vehicles that left in their preferred lane.

        None: no vehicle left, or vehicles have no preferred lanes.
        """
        if self.summary is None or not self.scenario.flow.lane_shares:
            return None
        return self.summary.preferred_percent

    @property
    def order(self) -> tuple[tuple[int, str], float, int]:
        """Sort key: label, volume, seed."""
        return rank(self.label), self.volume_veh_per_lane_h, self.scenario.seed


@frozen
class Comparison:
    """Sorted runs of one or more labels and volumes."""

    runs: tuple[Run, ...]
    """Successful runs."""
    failed: tuple[Run, ...]

    @classmethod
    def of(cls, runs: Iterable[Run]) -> Comparison:
        """Sort runs; a folder that is named twice is one run.

        Runs of a label that differ in more than volume and seed, or have other faults, are not
        averaged: they get other labels, which contain their folder or that of their sweep. So do
        repetitions of a volume and seed.
        """
        all_runs = list({(run.folder.resolve(), run.order): run for run in runs}.values())
        listed = all_runs
        for name in (attrgetter("name"), str):
            alike, counts = _labels_of_like_runs(listed), Counter(run.order for run in listed)
            listed = [
                run
                if run.label in alike and counts[run.order] == 1
                else _labelled_by_folder(original, name)
                for run, original in zip(listed, all_runs, strict=True)
            ]
        listed.sort(key=lambda run: run.order)
        return cls(
            tuple(run for run in listed if not run.reason),
            tuple(run for run in listed if run.reason),
        )

    @property
    def labels(self) -> tuple[str, ...]:
        """All labels, sorted."""
        return tuple(dict.fromkeys(run.label for run in self.runs))

    @property
    def volumes(self) -> tuple[float, ...]:
        """All volumes, ascending [vehicles/(lane h)]."""
        return tuple(sorted({run.volume_veh_per_lane_h for run in self.runs}))

    def at(self, label: str, volume_veh_per_lane_h: float) -> tuple[Run, ...]:
        """Return the runs of a label at a volume, one per seed."""
        return tuple(
            run
            for run in self.runs
            if run.label == label and run.volume_veh_per_lane_h == volume_veh_per_lane_h
        )

    def representative(self, label: str, volume_veh_per_lane_h: float) -> Run | None:
        """Return a label's first run with trajectories at a volume, or None."""
        runs = self.at(label, volume_veh_per_lane_h)
        return next((run for run in runs if run.has_trajectories), None)

    def busiest(self, label: str) -> Run | None:
        """Return a label's `representative` run at the highest volume that has one, or None."""
        found = (self.representative(label, volume) for volume in reversed(self.volumes))
        return next((run for run in found if run is not None), None)


def settings_of(scenario: Scenario, method: str, ignored: Collection[str] = ()) -> dict[str, Any]:
    """Return the values of a scenario that can change the results of a method.

    Args:
        scenario: the scenario.
        method: value of `laneweave run --method`.
        ignored: paths that are left out.

    Returns:
        Values by path (`table.field`).
    """
    values = flatten(to_tables(scenario), ".")
    return {
        name: one for name, one in values.items() if name not in ignored and affects(name, method)
    }


def _labels_of_like_runs(runs: Iterable[Run]) -> set[str]:
    """Return the labels whose runs differ in nothing but volume and seed."""
    kinds: dict[str, set[str]] = {}
    for run in runs:
        own = settings_of(run.scenario, run.method, VARIED)
        if run.scenario.sumo.config:  # SUMO draws the demand from the seed
            own = {name: one for name, one in own.items() if not name.startswith(_OF_DEMAND)}
        faults = None if run.summary is None else run.summary.faults
        if faults is not None:
            own["faults"] = sorted({one["fault"] for one in faults["injected"]})
        kinds.setdefault(run.label, set()).add(repr(own))
    return {label for label, found in kinds.items() if len(found) == 1}


def _labelled_by_folder(run: Run, name: Callable[[Path], str]) -> Run:
    """Return a run that is labelled by its folder; one of a sweep by its label and the sweep's."""
    folder = run.folder.resolve()
    if is_sweep(folder.parent):
        return evolve(run, label=f"{run.label} ({name(folder.parent)})")
    return evolve(run, label=name(folder))


def flatten(tables: Mapping[str, Any], separator: str) -> dict[str, Any]:
    """Return all values of nested tables by path."""
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        if isinstance(value, Mapping):
            inner = flatten(value, separator)
            flat |= {f"{key}{separator}{name}": one for name, one in inner.items()}
        else:
            flat[key] = value
    return flat


def scenario_of(path: Path) -> Scenario:
    """Return the scenario in the metadata of a run's Parquet file; by default `Scenario()`.

    Raises:
        BadInputError: this release does not understand the scenario.
        OSError, ValueError: the file cannot be read.
    """
    metadata = pq.read_schema(path).metadata or {}
    text = metadata.get(SCENARIO_KEY)
    data: dict[str, Any] = json.loads(text) if text else {}
    try:
        return parse_scenario(data)
    except BadInputError as error:
        raise not_a_run(path.parent, f"the scenario in {path.name}: {error}") from error


def is_sweep(folder: Path) -> bool:
    """Return whether a folder belongs to a sweep."""
    return (folder / SWEEP_FILE).is_file()


def single_run(folder: Path) -> Run:
    """Return the run in a folder; a run of a sweep keeps its label.

    Raises:
        BadInputError: the folder is not that of a finished run with trajectories, or the record of
            its point in a sweep cannot be read.
    """
    if not (folder / TRAJECTORIES_FILE).is_file():
        raise BadInputError("folder", str(folder), "the folder of a run, with trajectories.parquet")
    with reading(folder, TRAJECTORIES_FILE):
        scenario = scenario_of(folder / TRAJECTORIES_FILE)
    with reading(folder, TRIPS_FILE):
        pq.read_schema(folder / TRIPS_FILE)
    summary = read_summary(folder)
    if summary is None:
        raise not_a_run(folder, "its summary.json is missing or incomplete")
    point = folder / POINT_FILE
    label = _read_point(point).label if point.is_file() else summary.method
    if summary.ending == Ending.UNFINISHED.value:
        label += " (unfinished)"
    return Run(folder, label, summary.method, scenario, summary)


def runs_of(folders: Sequence[Path]) -> Iterator[Run]:
    """Yield the runs in folders of runs and sweeps.

    Raises:
        BadInputError: a folder has no finished run.
    """
    for folder in folders:
        if not is_sweep(folder):
            yield single_run(folder)
            continue
        points = sweep_runs(folder)
        if all(run.reason for run in points):
            raise BadInputError("folder", str(folder), "a sweep with a finished run")
        yield from points


def sweep_runs(out: Path) -> list[Run]:
    """Return the runs of a sweep, sorted by the names of their folders.

    Raises:
        BadInputError: the record of a point cannot be read.
    """
    return [_read_point(path) for path in sorted(out.glob(f"*/{POINT_FILE}"))]


def write_point(run: Run, folder: Path) -> None:
    """Write the record of a sweep's run to a folder."""
    data = {
        "schema": POINT_SCHEMA,
        "label": run.label,
        "method": run.method,
        "status": run.status,
        "reason": run.reason,
        "wall_s": run.wall_s,
        "plug_in": run.plug_in,
        "scenario": to_tables(run.scenario),
    }
    (folder / POINT_FILE).write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _read_point(path: Path) -> Run:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return Run(
            folder=path.parent,
            label=str(data["label"]),
            method=str(data["method"]),
            scenario=parse_scenario(data["scenario"]),
            summary=read_summary(path.parent),
            reason=str(data["reason"]),
            wall_s=float(data["wall_s"]),
            plug_in=str(data.get("plug_in", "")),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInputError(str(path), "invalid", f"the record of a point ({error})") from error
