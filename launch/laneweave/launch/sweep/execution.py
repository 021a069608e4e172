"""Execution of points in processes: libsumo supports one simulation per process and may crash.

A process reads its job from `job.json` in its folder, and writes the files of the run there,
`result.json` last. If the process exits without a result, the run has failed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from attrs import frozen

from laneweave.launch.recordings.files import EVENTS_FILE, TRAJECTORIES_FILE, TRIPS_FILE
from laneweave.launch.run.roles import THREAD_LIMITS
from laneweave.launch.sweep.points import Point
from laneweave.protocol.config.scenario_files import to_tables
from laneweave.protocol.summary import SUMMARY_FILE

JOB_FILE, RESULT_FILE, LOG_FILE = "job.json", "result.json", "log.txt"
POINT_PROCESS = "laneweave.launch.sweep.point_process"
POLL_S = 0.2
"""Period at which workers check whether the sweep has been stopped."""
END_S = 10.0
"""Grace period after SIGTERM before processes are killed."""


@frozen
class PointResult:
    """The result of a point; its files are in `folder`."""

    point: Point
    folder: Path
    problems: tuple[str, ...]
    """Reasons for a failure; empty: success."""
    wall_s: float


def kept_files(point: Point) -> tuple[str, ...]:
    """Return the names of the files to keep, besides `LOG_FILE` after a failure."""
    kept = (SUMMARY_FILE, TRIPS_FILE, EVENTS_FILE)
    return (*kept, TRAJECTORIES_FILE) if point.keep_trajectories else kept


class StoppedError(Exception):
    """The sweep was stopped before this run finished."""


def run_in_process(point: Point, folder: Path, stopped: Callable[[], bool]) -> PointResult:
    """Run a point in a process that writes to a new `folder`; stop it if `stopped` returns True.

    Raises:
        StoppedError: the sweep was stopped, and the process has exited.
        OSError: files or processes cannot be created.
    """
    if stopped():
        raise StoppedError(point.name)
    folder.mkdir(parents=True)
    job = {"method": point.method, "tables": to_tables(point.scenario)}
    (folder / JOB_FILE).write_text(json.dumps(job), encoding="utf-8")
    began_s = time.monotonic()
    with (folder / LOG_FILE).open("wb") as log:
        process = subprocess.Popen(  # noqa: S603 (no input from outside)
            [sys.executable, "-m", POINT_PROCESS, str(folder), str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=_environment(folder),
            # Shield the process from Ctrl-C: the sweep stops its processes.
            process_group=0,
        )
    wait_for_exit(process, point.name, stopped)
    wall_s = time.monotonic() - began_s
    return PointResult(point, folder, _problems(folder, process.returncode), wall_s)


def run_locally(
    points: Sequence[Point], unfinished: Path, workers: int
) -> Generator[PointResult, None, None]:
    """Run all points on this machine and yield their results; closing the generator stops them.

    Args:
        points: the points.
        unfinished: folder for the folders of the points.
        workers: maximum number of simultaneous processes.

    Raises:
        OSError: files or processes cannot be created.
    """
    stop = threading.Event()
    pool = ThreadPoolExecutor(min(workers, max(1, len(points))), "point")
    try:
        futures = [
            pool.submit(run_in_process, point, unfinished / point.name, stop.is_set)
            for point in points
        ]
        for future in as_completed(futures):
            yield future.result()
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


def wait_for_exit(process: subprocess.Popen[bytes], name: str, stopped: Callable[[], bool]) -> None:
    """Wait for the process of run `name`; end it if `stopped` returns True or an error is raised.

    Raises:
        StoppedError: the process was stopped.
    """
    try:
        while process.poll() is None:
            try:
                process.wait(POLL_S)
            except subprocess.TimeoutExpired:
                if stopped():
                    raise StoppedError(name) from None
    finally:
        _end(process)


def _environment(folder: Path) -> dict[str, str]:
    """Return the environment: one thread for linear algebra, temporary files in the folder."""
    limits = dict.fromkeys(THREAD_LIMITS, "1")
    return {**os.environ, **limits, "TMPDIR": str(folder.absolute())}


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        return
    process.terminate()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _problems(folder: Path, status: int) -> tuple[str, ...]:
    result = folder / RESULT_FILE
    if status == 0 and result.is_file():
        return tuple(json.loads(result.read_text(encoding="utf-8"))["problems"])
    if status < 0:
        try:
            name = signal.Signals(-status).name
        except ValueError:
            name = f"signal {-status}"
        return (f"its process was ended by {name}",)
    lines = (folder / LOG_FILE).read_text(encoding="utf-8", errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "no output")
    return (f"its process ended with status {status}: {last[:300]}",)
