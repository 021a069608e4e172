"""The points of a sweep on this machine: so many processes at a time."""

from __future__ import annotations

import threading
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from laneweave.launch.sweep.execution import Ended, Job, run_in_process


def run_locally(
    jobs: Sequence[Job], unfinished: Path, workers: int
) -> Generator[Ended, None, None]:
    """Run all jobs, and yield each when it has ended; close this to end them.

    Args:
        jobs: the points.
        unfinished: folder in which the points' folders are made.
        workers: processes at a time.

    Raises:
        OSError: files or processes cannot be made.
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
