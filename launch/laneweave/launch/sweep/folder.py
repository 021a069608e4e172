"""The folder of a sweep.

    sweep.json              marks the folder; locked while a sweep is running in it
    results.parquet         one row for each point that was run
    LABEL-VOLUME-SEED/      one folder for each of them
        point.json          its settings and result
        summary.json        as of any run
        trips.parquet, events.jsonl
        trajectories.parquet    if it is kept
        log.txt                 if the point failed
    unfinished/             points that are running

A point's folder appears atomically: it is renamed when all its files are written.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from laneweave.launch.recordings.results_over_seeds import flatten, write_results
from laneweave.launch.recordings.runs import (
    SWEEP_FILE,
    Run,
    sweep_runs,
    write_point,
)
from laneweave.launch.run_methods import METHODS, affects
from laneweave.launch.sweep.execution import LOG_FILE, PointResult, kept_files
from laneweave.launch.sweep.points import Point
from laneweave.protocol.config.loading import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import read_summary

RESULTS_FILE = "results.parquet"
SCHEMA = {"schema": "laneweave.sweep/1"}


class SweepFolder:
    """A sweep's folder, written by one sweep at a time; use it as a context manager."""

    def __init__(self, out: Path) -> None:
        """Open the folder of a new or an interrupted sweep.

        Raises:
            BadInputError: it holds something else, or another sweep runs in it.
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
        """Remove unfinished points, and release the folder."""
        shutil.rmtree(self.unfinished, ignore_errors=True)
        self._mark.close()

    @property
    def unfinished(self) -> Path:
        """Folder in which points run."""
        return self.out / "unfinished"

    @property
    def runs(self) -> Mapping[str, Run]:
        """The points that were run, by name."""
        return self._runs

    def check_settings(self, base: Scenario) -> None:
        """Check that the recorded points were run with the same settings.

        Args:
            base: the scenario of this sweep; its volume and seed are ignored.

        Raises:
            BadInputError: a setting that affects their method was different.
        """
        for name, run in self._runs.items():
            labelled = METHODS.get(run.label)
            if labelled is None or labelled.method != run.method:
                raise BadInputError("--out", str(self.out), f"a folder without {run.label}")
            tables = to_tables(base)
            tables["seed"] = run.scenario.seed
            tables["demand"]["volume_veh_per_lane_h"] = run.volume_veh_per_lane_h
            expected = flatten(to_tables(labelled.settings(parse_scenario(tables))), ".")
            recorded = flatten(to_tables(run.scenario), ".")
            where = f"as recorded in {self.out / name}; a sweep with other settings needs a new one"
            for field in dict.fromkeys([*recorded, *expected]):
                value, own = recorded.get(field), expected.get(field)
                if value != own and affects(field, run.method):
                    raise BadInputError(field, own, f"{value}, {where}")

    def is_finished(self, point: Point) -> bool:
        """Return whether a point is done, with all files that are to be kept."""
        run = self._runs.get(point.name)
        return (
            run is not None
            and not run.reason
            and run.summary is not None
            and (run.folder / "trips.parquet").is_file()
            and (not point.keep_trajectories or run.has_trajectories)
        )

    def add(self, result: PointResult) -> Run:
        """Move a point that was run into the folder, and update the table of results.

        Raises:
            CommandFailedError: it cannot be written.
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
        """Write the table of all points that were run."""
        runs = sorted(self._runs.values(), key=lambda run: run.order)
        write_results(runs, self.out / RESULTS_FILE)
