"""The runs that a report is about."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from attrs import evolve, frozen

from laneweave.launch.drawing.figures import scenario_of
from laneweave.launch.methods import rank
from laneweave.launch.sweep.folder import DONE, MARK_FILE, point_folders, read_record, read_summary
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.tables import Scenario


@frozen
class Run:
    """A run that has ended."""

    folder: Path
    label: str
    """Its method with settings, as sweeps name it; of other runs the method."""
    scenario: Scenario
    summary: dict[str, Any]
    """Empty for a failed run that left none."""
    reason: str = ""
    """Why it failed; empty: it did not."""

    @property
    def volume_veh_per_lane_h(self) -> float:
        """The demand on each lane."""
        return self.scenario.demand.volume_veh_per_lane_h

    @property
    def has_trajectories(self) -> bool:
        """Whether its trajectories were kept."""
        return (self.folder / "trajectories.parquet").is_file()

    @property
    def order(self) -> tuple[tuple[int, str], float, int]:
        """By what runs are sorted: label, volume, seed."""
        return rank(self.label), self.volume_veh_per_lane_h, self.scenario.seed


@frozen
class Comparison:
    """Runs of one or several labels and volumes, sorted."""

    runs: tuple[Run, ...]
    failed: tuple[Run, ...]

    @classmethod
    def of(cls, runs: Iterable[Run]) -> Comparison:
        """Sort runs; those that cannot be told apart are named by their folders."""
        listed = list(runs)
        counts = Counter(run.order for run in listed)
        named = [
            evolve(run, label=run.folder.resolve().name) if counts[run.order] > 1 else run
            for run in listed
        ]
        named.sort(key=lambda run: run.order)
        return cls(
            tuple(run for run in named if not run.reason),
            tuple(run for run in named if run.reason),
        )

    @property
    def labels(self) -> tuple[str, ...]:
        """All labels, in their order."""
        return tuple(dict.fromkeys(run.label for run in self.runs))

    @property
    def volumes(self) -> tuple[float, ...]:
        """All volumes in vehicles/(lane h), ascending."""
        return tuple(sorted({run.volume_veh_per_lane_h for run in self.runs}))

    def at(self, label: str, volume_veh_per_lane_h: float) -> tuple[Run, ...]:
        """Return the runs of a label at a volume, one for each seed."""
        return tuple(
            run
            for run in self.runs
            if run.label == label and run.volume_veh_per_lane_h == volume_veh_per_lane_h
        )

    def shown(self, label: str, volume_veh_per_lane_h: float) -> Run | None:
        """Return the run that stands for a label at a volume: the first with trajectories."""
        runs = self.at(label, volume_veh_per_lane_h)
        return next((run for run in runs if run.has_trajectories), None)

    def busiest(self, label: str) -> Run | None:
        """Return the run that shows a label at its highest volume with trajectories."""
        found = (self.shown(label, volume) for volume in reversed(self.volumes))
        return next((run for run in found if run is not None), None)


def is_sweep(folder: Path) -> bool:
    """Return whether a folder is that of a sweep."""
    return (folder / MARK_FILE).is_file()


def single_run(folder: Path) -> Run:
    """Return the run in a folder.

    Raises:
        BadInputError: it is not the folder of a finished run with trajectories.
    """
    if not (folder / "trajectories.parquet").is_file():
        raise BadInputError("DIR", str(folder), "the folder of a run, with trajectories.parquet")
    try:
        scenario = scenario_of(folder / "trajectories.parquet")
    except (OSError, ValueError) as error:
        raise _not_a_run(folder, error) from error
    summary = read_summary(folder)
    if summary is None:
        raise _not_a_run(folder, "its summary.json is missing or not whole")
    return Run(folder, str(summary.get("method", "run")), scenario, summary)


def runs_of(folders: Sequence[Path]) -> Iterator[Run]:
    """Yield the runs in some folders, which are those of runs and sweeps.

    Raises:
        BadInputError: a folder is neither, or a sweep has no finished run.
    """
    for folder in folders:
        if not is_sweep(folder):
            yield single_run(folder)
            continue
        points = point_folders(folder)
        records = [(path, read_record(path)) for path in points]
        if not any(record.status == DONE for _, record in records):
            raise BadInputError("DIR", str(folder), "a sweep with a finished run")
        for path, record in records:
            summary = read_summary(path) or {}
            yield Run(path, record.label, record.scenario, summary, record.reason)


def _not_a_run(folder: Path, why: object) -> BadInputError:
    return BadInputError("DIR", str(folder), f"the folder of a finished run ({why})")
