"""The folder of a sweep.

    sweep.json              identifies the folder; locked while a sweep is running
    results.parquet         one row per completed point
    LABEL-VOLUME-SEED/      one folder per completed point
        point.json          settings and result
        summary.json, trips.parquet, events.jsonl
        trajectories.parquet    if it is kept
        log.txt                 if the point failed
    unfinished/             folders of running points

The folder of a point appears atomically: it is renamed after all its files have been written.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from attrs import evolve

from laneweave.launch.recordings.files import TRIPS_FILE
from laneweave.launch.recordings.results_over_seeds import write_results
from laneweave.launch.recordings.runs import SWEEP_FILE, Run, settings_of, sweep_runs, write_point
from laneweave.launch.run_methods import REFERENCE_METHODS, labelled
from laneweave.launch.sweep.execution import LOG_FILE, PointResult, kept_files
from laneweave.launch.sweep.points import Point, with_volume
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import read_summary

RESULTS_FILE = "results.parquet"
SCHEMA = {"schema": "laneweave.sweep/1"}


class SweepFolder:
    """Context manager for the folder of a sweep; only one sweep at a time may write to it."""

    def __init__(self, out: Path) -> None:
        """Open the folder of a new or an interrupted sweep.

        Raises:
            BadInputError: the folder has other content, or another sweep is running in it.
        """
        self.out = out
        try:
            out.mkdir(parents=True, exist_ok=True)
            if not (out / SWEEP_FILE).is_file() and any(out.iterdir()):
                raise BadInputError("--out", str(out), "a new or empty folder, or that of a sweep")
            self._mark = (out / SWEEP_FILE).open("a+", encoding="utf-8")
        except OSError as error:
            raise BadInputError("--out", str(out), f"a folder ({error.strerror})") from error
        try:
            fcntl.flock(self._mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._mark.close()
            raise BadInputError("--out", str(out), "one sweep at a time") from error
        if self._mark.tell() == 0:
            self._mark.write(json.dumps(SCHEMA) + "\n")
            self._mark.flush()
        shutil.rmtree(self.unfinished, ignore_errors=True)
        self._runs = {run.folder.name: run for run in sweep_runs(out)}

    def __enter__(self) -> Self:
        """Return this folder."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove unfinished points and release the folder."""
        shutil.rmtree(self.unfinished, ignore_errors=True)
        self._mark.close()

    @property
    def unfinished(self) -> Path:
        """Folder of the running points."""
        return self.out / "unfinished"

    @property
    def runs(self) -> Mapping[str, Run]:
        """Completed points by name."""
        return self._runs

    def check_settings(self, base: Scenario) -> None:
        """Check that the completed points have the same settings as this sweep.

        Args:
            base: scenario of this sweep; its volume and seed are ignored.

        Raises:
            BadInputError: a setting that affects the method of a point differs.
        """
        for name, run in self._runs.items():
            method = labelled(run.label)
            if method.method != run.method:
                raise BadInputError("--out", str(self.out), f"a folder without {run.label}")
            installed = REFERENCE_METHODS.origin(run.method)
            if installed and run.plug_in and installed != run.plug_in:
                allowed = f"{run.plug_in}, which made {self.out / name}; or a new folder"
                raise BadInputError(f"version of {run.label}", installed, allowed)
            wanted = evolve(with_volume(base, run.volume_veh_per_lane_h), seed=run.scenario.seed)
            expected = settings_of(method.settings(wanted), run.method)
            recorded = settings_of(run.scenario, run.method)
            where = f"as recorded in {self.out / name}; other settings require a new folder"
            for field in dict.fromkeys([*recorded, *expected]):
                value, own = recorded.get(field), expected.get(field)
                if value != own:
                    raise BadInputError(field, own, f"{value}, {where}")

    def is_finished(self, point: Point) -> bool:
        """Return whether a point has succeeded and all files that it should keep exist."""
        run = self._runs.get(point.name)
        return run is not None and not run.reason and self.has_files(point)

    def has_files(self, point: Point) -> bool:
        """Return whether all files that a point should keep exist."""
        run = self._runs.get(point.name)
        return (
            run is not None
            and run.summary is not None
            and (run.folder / TRIPS_FILE).is_file()
            and (not point.keep_trajectories or run.has_trajectories)
        )

    def add(self, result: PointResult) -> Run:
        """Move a completed point into the folder, and update the table of results.

        Raises:
            CommandFailedError: the folder cannot be written.
        """
        point = result.point
        run = Run(
            folder=self.out / point.name,
            label=point.label,
            method=point.method,
            scenario=point.scenario,
            summary=read_summary(result.folder),
            reason="; ".join(result.problems),
            wall_s=round(result.wall_s, 3),
            plug_in=REFERENCE_METHODS.origin(point.method),
        )
        kept = (*kept_files(point), LOG_FILE) if result.problems else kept_files(point)
        try:
            for path in result.folder.iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
                elif path.name not in kept:
                    path.unlink()
            write_point(run, result.folder)
            if run.folder.exists():
                shutil.rmtree(run.folder)
            result.folder.rename(run.folder)
            self._runs[point.name] = run
            self.write_results()
        except OSError as error:
            raise CommandFailedError(f"{self.out}: {error}") from error
        return run

    def write_results(self) -> None:
        """Write the table of all completed points."""
        runs = sorted(self._runs.values(), key=lambda run: run.order)
        write_results(runs, self.out / RESULTS_FILE)
