"""The points of a sweep as tasks on an existing Dask cluster.

Workers need laneweave, but no shared disk: tasks return their points' files, and the client writes
them. As in local sweeps, each task starts a process, because a worker may run several tasks in
one process, and SUMO may crash.
"""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Generator, Sequence
from pathlib import Path

from attrs import evolve
from distributed import Client, Event, Future, as_completed, connect

from laneweave.launch.sweep.execution import LOG_FILE, PointResult, kept_files, run_in_process
from laneweave.launch.sweep.points import Point
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.temporary_folders import temporary_folder

CONNECT_S = 10.0


TaskResult = tuple[PointResult, dict[str, bytes]]
"""Result of a task: the point's result on the worker, and the contents of its files."""


def run_on_dask(
    points: Sequence[Point], unfinished: Path, address: str
) -> Generator[PointResult, None, None]:
    """Run all points on a cluster and yield their results; closing the generator stops them.

    Args:
        points: the points.
        unfinished: folder on this machine for the folders of the points.
        address: address of the scheduler.

    Raises:
        BadInputError: there is no scheduler at the address.
        OSError: files cannot be written.
    """
    sweep = f"laneweave-{uuid.uuid4().hex}"
    # Check first: an unconnected client logs another error when it is garbage-collected.
    try:
        asyncio.run(_check_connection(address))
    except (OSError, ValueError) as error:
        raise BadInputError("--dask", address, "the address of a Dask scheduler") from error
    with Client(address, timeout=CONNECT_S, set_as_default=False, name=sweep) as client:
        stop = Event(sweep, client=client)
        try:
            futures = {
                client.submit(
                    run_as_task, point, sweep, key=f"{point.name}-{sweep}", pure=False
                ): point
                for point in points
            }
            for future in as_completed(futures, loop=client.loop):
                yield _received(future, futures[future], unfinished)
        finally:
            # Queued tasks are cancelled with their futures; running tasks check this event.
            stop.set()


def run_as_task(point: Point, sweep: str) -> TaskResult:
    """Run a point on a worker, as a Dask task."""
    stop = Event(sweep)
    with temporary_folder("point") as temporary:
        result = run_in_process(point, temporary / point.name, stop.is_set)
        paths = (result.folder / name for name in (*kept_files(point), LOG_FILE))
        return result, {path.name: path.read_bytes() for path in paths if path.is_file()}


async def _check_connection(address: str) -> None:
    comm = await connect(address, timeout=CONNECT_S)
    await comm.close()


def _received(future: Future[TaskResult], point: Point, unfinished: Path) -> PointResult:
    """Write the files that a task returned; a failed task is a failed run."""
    folder = unfinished / point.name
    folder.mkdir(parents=True)
    if future.status != "finished":
        error = future.exception() if future.status == "error" else None
        reason = f"{type(error).__name__}: {error}" if error is not None else str(future.status)
        future.release()
        return PointResult(point, folder, (f"its task failed: {' '.join(reason.split())}",), 0.0)
    result, files = future.result()
    # Allow the cluster to drop the result.
    future.release()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return evolve(result, folder=folder)
