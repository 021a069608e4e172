"""Runs points, each in a process of its own: libsumo holds one simulation, and may crash.

The process reads its job from `job.json` in its folder, and writes the run's files there, last of
all `result.json`. A process that ends without a result is a failed run with a reason.
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
from typing import Any

from attrs import asdict, frozen

from laneweave.launch.run.roles import THREAD_LIMITS

JOB_FILE, RESULT_FILE, LOG_FILE = "job.json", "result.json", "log.txt"
POINT_PROCESS = "laneweave.launch.sweep.point_process"
POLL_S = 0.2
"""Period at which a worker checks whether the sweep was stopped."""
END_S = 10.0
"""Time that a process has to end after SIGTERM."""


@frozen
class Job:
    """The order for a process."""

    name: str
    method: str
    tables: dict[str, Any]
    """The scenario, as of `to_tables`."""
    keep_trajectories: bool


@frozen
class Ended:
    """A point that was run; its files are in `folder`."""

    name: str
    folder: Path
    problems: tuple[str, ...]
    """Why it failed; empty: it did not."""
    wall_s: float


class StoppedError(Exception):
    """The sweep was stopped before this run was finished."""


def run_in_process(job: Job, folder: Path, stopped: Callable[[], bool]) -> Ended:
    """Run a point in a new process and return its result.

    Args:
        job: the point.
        folder: where its files go; it is created.
        stopped: whether the sweep was stopped meanwhile.

    Raises:
        StoppedError: it was, and the process has ended.
        OSError: files or processes cannot be created.
    """
    if stopped():
        raise StoppedError(job.name)
    folder.mkdir(parents=True)
    (folder / JOB_FILE).write_text(json.dumps(asdict(job)), encoding="utf-8")
    began_s = time.monotonic()
    with (folder / LOG_FILE).open("wb") as log:
        process = subprocess.Popen(  # noqa: S603 - this package, with arguments of its own
            [sys.executable, "-m", POINT_PROCESS, str(folder), str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=_environment(folder),
            # Ctrl-C would reach the whole group; the sweep ends its processes itself.
            process_group=0,
        )
    follow(process, job.name, stopped)
    wall_s = time.monotonic() - began_s
    return Ended(job.name, folder, _problems(folder, process.returncode), wall_s)


def run_locally(
    jobs: Sequence[Job], unfinished: Path, workers: int
) -> Generator[Ended, None, None]:
    """Run all jobs on this machine, and yield each at its end; closing the generator ends them.

    Args:
        jobs: the points.
        unfinished: folder in which the points' folders are created.
        workers: number of processes at a time.

    Raises:
        OSError: files or processes cannot be created.
    """
    stop = threading.Event()
    pool = ThreadPoolExecutor(min(workers, max(1, len(jobs))), "point")
    try:
        futures = [
            pool.submit(run_in_process, job, unfinished / job.name, stop.is_set) for job in jobs
        ]
        for future in as_completed(futures):
            yield future.result()
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


def follow(process: subprocess.Popen[bytes], name: str, stopped: Callable[[], bool]) -> None:
    """Wait for a process; it has ended when this returns or raises.

    Args:
        process: the process.
        name: of its run.
        stopped: whether the result is no longer wanted.

    Raises:
        StoppedError: it is not, and the process was ended.
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
    """Return an environment: single-threaded linear algebra, temporary files in the folder."""
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
