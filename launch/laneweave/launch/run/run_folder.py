"""Folders of new runs, and names of new folders."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from attrs import evolve

from laneweave.launch.recordings.files import (
    EVENTS_FILE,
    TICKS_FILE,
    TRAJECTORIES_FILE,
    TRIPS_FILE,
)
from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError
from laneweave.protocol.files import write_atomically
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import (
    SUMMARY_FILE,
    Ending,
    RunSummary,
    read_summary,
    write_summary,
)
from laneweave.protocol.wire.events import ENTERED

LOG_FILE = "log.jsonl"
"""Log of all processes of a run, which keep it locked: a folder is used by one run at a time."""
ROUTER_READY_FILE = "router.ready"
"""File in the temporary folder of a run that exists once the router listens."""
EARLY_FILES = frozenset(
    (LOG_FILE, EVENTS_FILE, SUMMARY_FILE, TICKS_FILE, TRAJECTORIES_FILE, TRIPS_FILE)
)
"""Files that an interrupted run may have before a vehicle enters."""
FOLDER_RULE = "a new or empty folder"


@contextmanager
def new_folder(out: Path | None, settings: Scenario, method: str) -> Iterator[Path]:
    """Yield a new or empty folder, or one that only an interrupted start has left behind.

    If the run is rejected, or interrupted before it writes results, the folder is as before,
    but without what an interrupted start had left.

    Raises:
        BadInputError: the folder is not empty, is used by another run, or cannot be created.
    """
    volume = f"{settings.demand.volume_veh_per_lane_h:g}"
    folder = out or timestamped_folder(f"{method}-{volume}-seed{settings.seed}")
    existed, log = _claim(folder)
    try:
        yield folder
    except (BadInputError, RefusedError, CommandFailedError, KeyboardInterrupt):
        files = list(folder.iterdir())
        if files == [folder / LOG_FILE]:
            files[0].unlink()
            if not existed:
                folder.rmdir()
        raise
    finally:
        os.close(log)


def timestamped_folder(prefix: str) -> Path:
    """Return the path of a folder in runs/ that does not exist: the prefix, date and time."""
    base = folder = Path("runs") / f"{prefix}-{time.strftime('%Y%m%d-%H%M%S')}"
    copies = 1
    while folder.exists():
        copies += 1
        folder = base.with_name(f"{base.name}-{copies}")
    return folder


def _claim(folder: Path) -> tuple[bool, int]:
    """Lock the log of a folder and empty the folder.

    Returns whether it existed, and the log's descriptor.
    """
    try:
        existed = folder.is_dir()
        folder.mkdir(parents=True, exist_ok=True)
        if not _is_unused(folder):
            raise BadInputError("--out", str(folder), FOLDER_RULE)
        log = os.open(folder / LOG_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            _lock(log, fcntl.LOCK_EX)
        except BlockingIOError as error:
            os.close(log)
            allowed = f"{FOLDER_RULE}; another run uses this one"
            raise BadInputError("--out", str(folder), allowed) from error
        for path in folder.iterdir():
            if path.name != LOG_FILE:
                path.unlink()
        os.ftruncate(log, 0)
        # The processes of this run lock it, too.
        _lock(log, fcntl.LOCK_SH)
    except FileExistsError as error:
        raise BadInputError("--out", str(folder), FOLDER_RULE) from error
    except OSError as error:
        raise BadInputError("--out", str(folder), f"a folder ({error.strerror})") from error
    return existed, log


def _lock(descriptor: int, kind: int) -> None:
    """Lock a file, if its file system has locks.

    Raises:
        BlockingIOError: another process has locked it.
    """
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        pass


def _is_unused(folder: Path) -> bool:
    """Return whether a folder is empty, or was left by a run that ended before a vehicle entered.

    Raises:
        OSError: the folder or a file cannot be read.
    """
    names = {path.name for path in folder.iterdir()}
    if EVENTS_FILE not in names:
        return names <= {LOG_FILE}
    if not names <= EARLY_FILES:
        return False
    for line in (folder / EVENTS_FILE).read_text("utf-8", "replace").splitlines():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            if json.loads(line)["kind"] == ENTERED:
                return False
    if not (folder / SUMMARY_FILE).exists():
        return True
    summary = read_summary(folder)
    return summary is not None and summary.ending in (
        Ending.INTERRUPTED.value,
        Ending.UNFINISHED.value,
    )


def repair_run(folder: Path) -> RunSummary:
    """Complete the files of a run whose process was killed, and return its summary.

    Raises:
        BadInputError: the folder is not that of a killed run: it has no summary, the run has ended,
            or it goes on.
    """
    summary = read_summary(folder)
    if summary is None:
        allowed = "the folder of a run that was killed after its first seconds"
        raise BadInputError("DIR", str(folder), allowed)
    if summary.ending != Ending.UNFINISHED.value:
        raise BadInputError("DIR", f"{folder} ({summary.ending})", "a run that was killed")
    try:
        with (folder / LOG_FILE).open("rb+") as log:
            _lock(log.fileno(), fcntl.LOCK_EX)
            events = folder / EVENTS_FILE
            lines = events.read_bytes()
            if not lines.endswith(b"\n"):
                write_atomically(events, lines[: lines.rfind(b"\n") + 1].decode())
            summary = evolve(summary, ending=Ending.INTERRUPTED.value)
            write_summary(folder, summary)
    except BlockingIOError as error:
        raise BadInputError("DIR", f"{folder} (in use)", "a run that was killed") from error
    except OSError as error:
        raise BadInputError("DIR", f"{folder} ({error})", "a run that was killed") from error
    return summary
