"""Experiments and points whose results are kept in a file.

`run_missing` runs experiments one after the other (hosts.py, resilience.py). `run_points` runs
points with several seeds each, in parallel (roads.py, surprises.py).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from attrs import frozen

from laneweave.protocol.files import write_atomically


def run_missing(
    runs: Mapping[str, Callable[[Path], dict[str, Any]]], only: Sequence[str] | None, record: Path
) -> list[dict[str, Any]]:
    """Run the experiments without a result, or the requested ones; return their results.

    Args:
        runs: functions that run the experiments in a folder, by name of the experiment.
        only: names of the requested experiments; None: those without a result.
        record: JSON file of all results; the folders are beside this file.
    """
    record.parent.mkdir(parents=True, exist_ok=True)
    known = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}
    chosen = [name for name in runs if (name in only if only else name not in known)]
    for name in chosen:
        folder = record.parent.resolve() / re.sub(r"[^\w-]+", "-", name)
        shutil.rmtree(folder, ignore_errors=True)
        known[name] = runs[name](folder)
        others = {name: known[name] for name in known if name not in runs}
        ordered = {name: known[name] for name in runs if name in known} | others
        record.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")
        print(name, json.dumps(known[name]), flush=True)  # noqa: T201
    return [known[name] for name in chosen]


class Point(Protocol):
    """Settings that are run with several seeds."""

    @property
    def name(self) -> str:
        """Name of the point in the record."""

    @property
    def seeds(self) -> int:
        """Number of seeds."""


P = TypeVar("P", bound=Point)


@frozen
class Job(Generic[P]):
    """One run of a point."""

    point: P
    seed: int

    @property
    def key(self) -> str:
        """Name of the run in the record."""
        return f"{self.point.name} seed {self.seed}"


def jobs_of(
    points: Iterable[P], only: Sequence[str] = (), seeds: int | None = None
) -> list[Job[P]]:
    """Return the runs of the points whose names contain one of the texts, seed by seed.

    Args:
        points: the points.
        only: the texts; empty: all points.
        seeds: maximum number of seeds of a point; None: no limit.
    """
    chosen = [one for one in points if not only or any(text in one.name for text in only)]
    counts = [one.seeds if seeds is None else min(seeds, one.seeds) for one in chosen]
    return [
        Job(one, seed)
        for seed in range(1, max(counts, default=0) + 1)
        for one, count in zip(chosen, counts, strict=True)
        if seed <= count
    ]


def run_points(
    points: Sequence[P],
    drive: Callable[[Job[P]], dict[str, Any]],
    record: Path,
    description: str | None,
    *,
    hidden: Iterable[str] = (),
    alone: Callable[[P], bool] = lambda _: False,
) -> int:
    """Read the options of the command, run the missing jobs, and record their results.

    Args:
        points: all points, in the order of the record.
        drive: runs a job in a process of its own, and returns its results.
        record: JSON file of all results.
        description: what the command does; None: not given.
        hidden: results that are recorded but not printed, with point and seed.
        alone: returns whether a point uses both cores, so that its runs follow each other.

    Returns:
        The exit status: 1 if a run failed.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--only", nargs="+", default=(), help="points whose names contain a text")
    parser.add_argument("--again", action="store_true", help="repeat finished runs")
    parser.add_argument("--seeds", type=int, help="number of seeds; default: that of the point")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="parallel runs")
    parser.add_argument("--out", type=Path, default=record.parent, help=f"folder of {record.name}")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    record, failed = options.out / record.name, False
    known = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}
    order, not_shown = [one.key for one in jobs_of(points)], {"point", "seed", *hidden}
    jobs = jobs_of(points, options.only, options.seeds)
    jobs = [job for job in jobs if options.again or job.key not in known]
    for part, workers in ((False, options.jobs), (True, 1)):
        # libsumo runs one simulation per process.
        with ProcessPoolExecutor(
            workers, multiprocessing.get_context("spawn"), max_tasks_per_child=1
        ) as pool:
            waiting = {pool.submit(drive, job): job for job in jobs if alone(job.point) == part}
            for done in as_completed(waiting):
                job = waiting[done]
                if (error := done.exception()) is not None:
                    sys.stderr.write(f"{job.key}: {error!r}\n")
                    failed = True
                    continue
                row = known[job.key] = done.result()
                rows = {key: known[key] for key in [*order, *known] if key in known}
                write_atomically(record, json.dumps(rows, indent=1) + "\n")
                shown = " ".join(f"{key}={row[key]}" for key in row if key not in not_shown)
                sys.stderr.write(f"{time.strftime('%H:%M:%S')} {job.key} {shown}\n")
    return int(failed)


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Discard the log of a run."""
    with Path(os.devnull).open("w", encoding="utf-8") as sink, contextlib.redirect_stdout(sink):
        yield
