"""The parts of the evaluation: the sweep in rounds, the trials, the report."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from statistics import fmean

from attrs import frozen

from evaluation.evidence import Evidence, read_evidence, setting_of, write_evidence
from evaluation.pictures import draw_pictures
from evaluation.points import JAMMED, Key, SeedKey, run_rows
from evaluation.programme import FORMATIONS, points_of
from evaluation.trials import (
    TRIALS,
    Trial,
    agreement_rows,
    cost_rows,
    factor_rows,
    is_finished,
    run_trial,
)
from laneweave.launch.recordings.runs import Run, is_sweep, runs_of
from laneweave.launch.sweep.execution import StoppedError, run_locally
from laneweave.launch.sweep.folder import SweepFolder
from laneweave.launch.sweep.points import Point
from laneweave.launch.sweep.sweep import run_sweep
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.summary import Ending

SWEEP_FOLDER = "sweep"
PICTURES = "evaluation-*.png"


def say(text: str) -> None:
    """Write a line of progress to stderr."""
    sys.stderr.write(f"{time.strftime('%H:%M:%S')} {text}\n")
    sys.stderr.flush()


@frozen
class Rounds:
    """A sweep in rounds: each round runs the methods at the volumes with one seed."""

    labels: Collection[str]
    volumes: Collection[float]
    """In vehicles/(lane h)."""
    seeds: Sequence[int]
    duration_s: float
    """Duration of the arrivals at each point."""
    jobs: int
    """Number of parallel processes."""
    end_s: float | None
    """Latest expected end of a round (`time.monotonic`); None: no limit. The expected duration of
    a method at a volume is 0 before its first run there."""

    def run(self, out: Path) -> bool:
        """Run the unfinished rounds; return whether formation control kept its guarantees.

        Raises:
            BadInputError: the folder belongs to another sweep.
            CommandFailedError: files or processes cannot be created.
        """
        base = load_scenario(None, demand__duration_s=self.duration_s)
        with SweepFolder(out / SWEEP_FOLDER) as folder:
            folder.check_settings(base)
            planned = {
                seed: [point for point in points_of(base, seed) if self._includes(point)]
                for seed in self.seeds
            }
            for seed, all_points in planned.items():
                points = [point for point in all_points if not _has_run(folder, point)]
                if not points:
                    continue
                expected_s = _expected_s(folder.runs.values(), points, self.jobs)
                left_s = math.inf if self.end_s is None else self.end_s - time.monotonic()
                if expected_s > left_s:
                    say(
                        f"seed {seed} is likely to take {expected_s / 60.0:.0f} min, the budget "
                        f"leaves {max(0.0, left_s) / 60.0:.0f} min; the next call continues with it"
                    )
                    break
                say(f"sweep, seed {seed}")
                run_sweep(points, folder, partial(run_locally, workers=self.jobs), show=True)
            return not any(
                run.reason
                for points in planned.values()
                for point in points
                if point.label in FORMATIONS and (run := folder.runs.get(point.name)) is not None
            )

    def _includes(self, point: Point) -> bool:
        return point.label in self.labels and point.volume_veh_per_lane_h in self.volumes


def _has_run(folder: SweepFolder, point: Point) -> bool:
    """Return whether the result of a point is recorded, so that it is not run again.

    A jam or an overlap of a reference method is a result: it would happen again.
    """
    run = folder.runs.get(point.name)
    if run is None or point.label in FORMATIONS:
        return folder.is_finished(point)
    return _has_result(run) and folder.has_files(point)


def _has_result(run: Run) -> bool:
    """Return whether a run was neither stopped nor crashed."""
    return run.summary is not None and run.summary.ending in (Ending.COMPLETE.value, *JAMMED)


def _expected_s(runs: Iterable[Run], points: Iterable[Point], jobs: int) -> float:
    """Return how long points are likely to take: as with other seeds, where there are any.

    Args:
        runs: the runs so far.
        points: the points.
        jobs: number of parallel processes.
    """
    known: dict[Key, list[float]] = {}
    for run in runs:
        if run.wall_s is not None and _has_result(run):
            known.setdefault((run.label, run.volume_veh_per_lane_h), []).append(run.wall_s)
    expected_s = [
        fmean(times_s)
        for point in points
        if (times_s := known.get((point.label, point.volume_veh_per_lane_h)))
    ]
    return max(sum(expected_s) / jobs, max(expected_s, default=0.0))


def run_trials(part: str, out: Path, root: Path, jobs: int) -> bool:
    """Run the trials of a part; return whether all succeeded.

    Args:
        part: `zenoh`, `speed` or `length`.
        out: the evaluation's folder.
        root: root folder of the repository.
        jobs: maximum number of parallel trials; trials that are not `is_shared` run alone.
    """
    stop = threading.Event()

    def complete(trial: Trial) -> bool:
        say(f"{part}: {trial.command}")
        try:
            run_trial(trial, out, root, stop.is_set)
        except CommandFailedError as error:
            say(f"FAILED: {error}")
            return False
        except StoppedError:
            say(f"FAILED: {trial.command}: stopped before its end")
            return False
        return True

    waiting = [trial for trial in TRIALS if trial.part == part and not is_finished(trial, out)]
    ended = [complete(trial) for trial in waiting if not trial.is_shared]
    with ThreadPoolExecutor(jobs) as pool:
        try:
            ended += pool.map(complete, [trial for trial in waiting if trial.is_shared])
        finally:
            stop.set()
    return all(ended)


def collect(
    out: Path,
    sweeps: Iterable[Path],
    labels: Collection[str],
    images: Path,
    needed: Collection[SeedKey] = (),
) -> Evidence:
    """Return the evidence of the existing runs, and draw their figures.

    Args:
        out: the evaluation's folder.
        sweeps: folders of other sweeps; empty: the sweep in `out`, if there is one.
        labels: labels of the rows; figures show all runs.
        images: folder of the figures.
        needed: as in `draw_pictures`.

    Raises:
        BadInputError: a folder contains no sweep, or the runs cannot be compared.
        OSError, ValueError, KeyError: a run's files cannot be read.
    """
    folders = list(sweeps) or [path for path in (out / SWEEP_FOLDER,) if is_sweep(path)]
    for folder in folders:
        if not is_sweep(folder):
            raise BadInputError("--sweeps", str(folder), "folders of sweeps")
    evidence = Evidence(
        agreements=tuple(agreement_rows(out)),
        factors=tuple(factor_rows(out)),
        costs=tuple(cost_rows(out)),
    )
    if not folders:
        return evidence
    runs = list(runs_of(folders))
    rows = [row for row in run_rows(runs) if row.label in labels]
    pictures = draw_pictures(runs, images, needed)
    return evidence.updated_with(
        Evidence(setting=setting_of(runs), runs=tuple(rows), pictures=pictures)
    )


def refresh(
    out: Path,
    sweeps: Iterable[Path],
    labels: Collection[str],
    docs: Path,
    *,
    add_runs: bool = False,
) -> None:
    """Bring docs/evidence/evaluation.json and the figures up to date.

    Parts and labels without runs in the folders keep the recorded values.

    Args:
        out: the evaluation's folder.
        sweeps: as in `collect`.
        labels: as in `collect`.
        docs: folder of the documents.
        add_runs: keep recorded runs of other seeds and volumes, and figures that show some of
            them (`draw_pictures`).

    Raises:
        BadInputError, OSError, ValueError, KeyError: as in `collect`.
    """
    path = docs / "evidence" / "evaluation.json"
    recorded = read_evidence(path)
    needed = [(*row.key, row.seed) for row in recorded.runs] if add_runs else ()
    new = collect(out, sweeps, labels, docs / "images", needed)
    evidence = recorded.updated_with(new, add_runs=add_runs)
    write_evidence(evidence, path)
    if new.runs:
        names = {picture.name for picture in evidence.pictures}
        for picture in (docs / "images").glob(PICTURES):
            if picture.name not in names:
                picture.unlink()
