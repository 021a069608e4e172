"""The points of a sweep as tasks of a Dask cluster that is there already.

Workers need laneweave and nothing else: no shared disk. A point's few files come back as the result
of its task, and the client writes them. Each task starts a process of its own, as on this machine,
since a worker may run several tasks in one process and SUMO may take its process along.
"""

from __future__ import annotations

import asyncio
import tempfile
import uuid
from collections.abc import Generator, Sequence
from pathlib import Path

from attrs import frozen
from distributed import Client, Event, Future, as_completed, connect

from laneweave.launch.sweep.execution import Ended, Job, run_in_process
from laneweave.protocol.errors import BadInputError

CONNECT_S = 10.0
RETURNED = ("summary.json", "trips.parquet", "events.jsonl", "log.txt")


@frozen
class Returned:
    """What a task brings back."""

    problems: tuple[str, ...]
    wall_s: float
    files: dict[str, bytes]


def run_on_dask(
    jobs: Sequence[Job], unfinished: Path, address: str
) -> Generator[Ended, None, None]:
    """Run all jobs on a cluster, and yield each when it has ended; close this to end them.

    Args:
        jobs: the points.
        unfinished: folder in which the points' folders are made, on this side.
        address: of the cluster's scheduler.

    Raises:
        BadInputError: no scheduler answers there.
        OSError: files cannot be written.
    """
    sweep = f"laneweave-{uuid.uuid4().hex}"
    # A client that finds nobody complains about it once more when it is collected.
    try:
        asyncio.run(_greet(address))
    except (OSError, ValueError) as error:
        raise BadInputError("--dask", address, "a Dask scheduler that answers") from error
    with Client(address, timeout=CONNECT_S, set_as_default=False, name=sweep) as client:
        stop = Event(sweep, client=client)
        try:
            futures = {
                client.submit(run_as_task, job, sweep, key=f"{job.name}-{sweep}", pure=False): job
                for job in jobs
            }
            for future in as_completed(futures, loop=client.loop):
                yield _received(future, futures[future], unfinished)
        finally:
            # Tasks that wait are given up with their futures; those that run look for this.
            stop.set()


def run_as_task(job: Job, sweep: str) -> Returned:
    """Run a point on a worker (the task)."""
    stop = Event(sweep)
    with tempfile.TemporaryDirectory(prefix="laneweave-point-") as temporary:
        ended = run_in_process(job, Path(temporary) / job.name, stop.is_set)
        names = [*RETURNED, *(["trajectories.parquet"] if job.keep_trajectories else [])]
        paths = [ended.folder / name for name in names]
        files = {path.name: path.read_bytes() for path in paths if path.is_file()}
    return Returned(ended.problems, ended.wall_s, files)


async def _greet(address: str) -> None:
    comm = await connect(address, timeout=CONNECT_S)
    await comm.close()


def _received(future: Future[Returned], job: Job, unfinished: Path) -> Ended:
    """Write what a task brought back; one that failed is a failed run."""
    folder = unfinished / job.name
    folder.mkdir(parents=True)
    if future.status != "finished":
        error = future.exception() if future.status == "error" else None
        reason = f"{type(error).__name__}: {error}" if error is not None else str(future.status)
        future.release()
        return Ended(job.name, folder, (f"its task failed: {' '.join(reason.split())}",), 0.0)
    returned = future.result()
    # The cluster need not keep it any longer.
    future.release()
    for name, content in returned.files.items():
        (folder / name).write_bytes(content)
    return Ended(job.name, folder, returned.problems, returned.wall_s)
