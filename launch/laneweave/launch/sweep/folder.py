"""The folder of a sweep.

    sweep.json              marks the folder; locked while a sweep is running in it
    results.parquet         one row for each point that was run
    LABEL-VOLUME-SEED/      one folder for each of them
        point.json          its settings, and what became of it
        summary.json        as of any run
        trips.parquet, events.jsonl
        trajectories.parquet    where it is kept
        log.txt                 of failed ones
    unfinished/             what is running

A point's folder appears whole or not at all: it is renamed when everything is in it.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from attrs import asdict, frozen

from laneweave.launch.methods import METHODS, affects, rank
from laneweave.launch.sweep.execution import LOG_FILE, Ended
from laneweave.launch.sweep.points import Point
from laneweave.launch.sweep.results import Row, write_results
from laneweave.protocol.config.loading import parse_scenario, to_tables
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.tables import Scenario

MARK_FILE, POINT_FILE, RESULTS_FILE = "sweep.json", "point.json", "results.parquet"
MARK = {"schema": "laneweave.sweep/1"}
POINT_SCHEMA = "laneweave.sweep.point/1"
DONE, FAILED = "done", "failed"
_ALWAYS_KEPT = ("summary.json", "trips.parquet", "events.jsonl")
_TRAJECTORIES = "trajectories.parquet"


@frozen
class PointRecord:
    """What a point's folder says about it."""

    label: str
    method: str
    status: str
    """`done` or `failed`."""
    reason: str
    """Why it failed; empty: it did not."""
    wall_s: float
    scenario: Scenario

    @property
    def order(self) -> tuple[tuple[int, str], float, int]:
        """By what points are sorted: label, volume, seed."""
        volume = self.scenario.demand.volume_veh_per_lane_h
        return rank(self.label), volume, self.scenario.seed


def read_record(folder: Path) -> PointRecord:
    """Return what a point's folder says.

    Raises:
        BadInputError: it is not the folder of a point.
    """
    path = folder / POINT_FILE
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return PointRecord(
            label=str(data["label"]),
            method=str(data["method"]),
            status=str(data["status"]),
            reason=str(data["reason"]),
            wall_s=float(data["wall_s"]),
            scenario=parse_scenario(data["scenario"]),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInputError(str(path), "something else", f"a point's record ({error})") from error


def read_summary(folder: Path) -> dict[str, Any] | None:
    """Return a run's summary, None when there is no whole one."""
    try:
        data = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) and "runtime" in data else None


def point_folders(out: Path) -> list[Path]:
    """Return the folders of all points of a sweep that have been run."""
    return sorted(path.parent for path in out.glob(f"*/{POINT_FILE}"))


class SweepFolder:
    """A sweep's folder, to be written to by one sweep at a time; use it as a context manager."""

    def __init__(self, out: Path) -> None:
        """Open a new, empty or interrupted sweep's folder.

        Raises:
            BadInputError: it holds something else, or another sweep is running in it.
        """
        self.out = out
        try:
            out.mkdir(parents=True, exist_ok=True)
            if not (out / MARK_FILE).is_file() and any(out.iterdir()):
                raise BadInputError("--out", str(out), "a new or empty folder, or that of a sweep")
            self._mark = (out / MARK_FILE).open("a+", encoding="utf-8")
        except OSError as error:
            raise BadInputError("--out", str(out), f"a folder ({error.strerror})") from error
        try:
            fcntl.flock(self._mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._mark.close()
            raise BadInputError("--out", str(out), "one sweep at a time") from error
        if self._mark.tell() == 0:
            self._mark.write(json.dumps(MARK) + "\n")
            self._mark.flush()
        shutil.rmtree(self.unfinished, ignore_errors=True)
        self._records = {path.name: read_record(path) for path in point_folders(out)}

    def __enter__(self) -> Self:
        """Return this folder."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Remove what is not finished, and let others in."""
        shutil.rmtree(self.unfinished, ignore_errors=True)
        self._mark.close()

    @property
    def unfinished(self) -> Path:
        """Where points are run."""
        return self.out / "unfinished"

    @property
    def records(self) -> Mapping[str, PointRecord]:
        """What is known of the points that were run, by name."""
        return self._records

    def check_settings(self, base: Scenario) -> None:
        """Check that what is recorded was run with the same settings, as far as they matter.

        Args:
            base: the scenario of this sweep, whatever its volume and seed.

        Raises:
            BadInputError: it was not.
        """
        for name, record in self._records.items():
            tables = to_tables(base)
            recorded = record.scenario
            tables["seed"] = recorded.seed
            tables["demand"]["volume_veh_per_lane_h"] = recorded.demand.volume_veh_per_lane_h
            where = f"as recorded in {self.out / name}; a sweep with other settings needs a new one"
            labelled = METHODS.get(record.label)
            if labelled is None or labelled.method != record.method:
                raise BadInputError("--out", str(self.out), f"a folder without {record.label}")
            expected = _flat(to_tables(labelled.settings(parse_scenario(tables))))
            for field, value in _flat(to_tables(recorded)).items():
                if expected[field] != value and affects(field, record.method):
                    raise BadInputError(field, expected[field], f"{value}, {where}")

    def is_finished(self, point: Point) -> bool:
        """Return whether a point is done, and everything of it that shall be kept is there."""
        record = self._records.get(point.name)
        folder = self.out / point.name
        return (
            record is not None
            and record.status == DONE
            and read_summary(folder) is not None
            and (folder / "trips.parquet").is_file()
            and (not point.keep_trajectories or (folder / _TRAJECTORIES).is_file())
        )

    def take(self, point: Point, ended: Ended) -> PointRecord:
        """Put a point that was run in its place, and the table of results next to it.

        Raises:
            CommandFailedError: it cannot be written.
        """
        record = PointRecord(
            label=point.label,
            method=point.method,
            status=FAILED if ended.problems else DONE,
            reason="; ".join(ended.problems),
            wall_s=round(ended.wall_s, 3),
            scenario=point.scenario,
        )
        kept = {*_ALWAYS_KEPT}
        if point.keep_trajectories:
            kept.add(_TRAJECTORIES)
        if ended.problems:
            kept.add(LOG_FILE)
        try:
            _keep_only(ended.folder, kept)
            text = json.dumps({"schema": POINT_SCHEMA, **asdict(record)}, indent=1)
            (ended.folder / POINT_FILE).write_text(text + "\n", encoding="utf-8")
            place = self.out / point.name
            if place.exists():
                shutil.rmtree(place)
            ended.folder.rename(place)
            self._records[point.name] = record
            self.write_results()
        except OSError as error:
            raise CommandFailedError(f"{self.out}: {error}") from error
        return record

    def write_results(self) -> None:
        """Write the table of all points that were run."""
        names = sorted(self._records, key=lambda name: self._records[name].order)
        rows = (_row(self._records[name], self.out / name) for name in names)
        write_results(rows, self.out / RESULTS_FILE)


def _row(record: PointRecord, folder: Path) -> Row:
    return Row(
        label=record.label,
        method=record.method,
        volume_veh_per_lane_h=record.scenario.demand.volume_veh_per_lane_h,
        seed=record.scenario.seed,
        status=record.status,
        reason=record.reason,
        wall_s=record.wall_s,
        summary=read_summary(folder) or {},
    )


def _flat(tables: Mapping[str, Any], parent: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{parent}{key}.")
        else:
            flat[f"{parent}{key}"] = value
    return flat


def _keep_only(folder: Path, names: Iterable[str]) -> None:
    kept = set(names)
    for path in folder.iterdir():
        if path.name in kept:
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
