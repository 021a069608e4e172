"""One point in a process of its own: libsumo holds one simulation, and may take its process along.

The process finds its job in `job.json` of its folder, writes the run's files there, and last of all
`result.json`. Whatever else becomes of it is a failed run with a reason.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from attrs import asdict, frozen

from laneweave.launch.run.roles import THREAD_LIMITS

JOB_FILE, RESULT_FILE, LOG_FILE = "job.json", "result.json", "log.txt"
POINT_PROCESS = "laneweave.launch.sweep.point_process"
LOOK_S = 0.2
"""How often a worker looks whether the sweep has been ended."""
END_S = 10.0
"""How long a process gets to end in good order."""


@frozen
class Job:
    """What a process is told to do."""

    name: str
    method: str
    tables: dict[str, Any]
    """The scenario, as `to_tables` gives it."""
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
    """What ordered this run was ended before it was finished."""


def run_in_process(job: Job, folder: Path, stopped: Callable[[], bool]) -> Ended:
    """Run a point and return what became of it.

    Args:
        job: the point.
        folder: where its files go; it is made.
        stopped: whether the sweep has been ended meanwhile.

    Raises:
        StoppedError: it has, and the process with it.
        OSError: files or processes cannot be made.
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
            # Ctrl-C reaches the whole group: the sweep ends its processes, in order.
            process_group=0,
        )
    follow(process, job.name, stopped)
    wall_s = time.monotonic() - began_s
    return Ended(job.name, folder, _problems(folder, process.returncode), wall_s)


def follow(process: subprocess.Popen[bytes], name: str, stopped: Callable[[], bool]) -> None:
    """Wait until a process has ended; it has when this returns or raises.

    Args:
        process: what is waited for.
        name: of its run.
        stopped: whether nobody waits for it any more.

    Raises:
        StoppedError: nobody does, and it was ended.
    """
    try:
        while process.poll() is None:
            try:
                process.wait(LOOK_S)
            except subprocess.TimeoutExpired:
                if stopped():
                    raise StoppedError(name) from None
    finally:
        _end(process)


def _environment(folder: Path) -> dict[str, str]:
    """Linear algebra on one thread, and temporary files where they vanish with the folder."""
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
    last = next((line.strip() for line in reversed(lines) if line.strip()), "no word")
    return (f"its process ended with status {status}: {last[:300]}",)
