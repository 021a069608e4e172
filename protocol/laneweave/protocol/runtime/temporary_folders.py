"""Temporary folders that do not outlive their processes, even if these are killed.

A folder contains a file that its processes keep locked. The kernel releases the lock when the last
of them ends, however it ends; so a process that holds the lock alone may remove the folder. Process
ids would not do: they are reused, and containers that share a temporary folder number their own.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from laneweave.protocol.runtime.processes import interrupts_deferred

PREFIX = "laneweave-"
OWNER_FILE = ".laneweave-owner"
"""Locked file that marks a folder as temporary; folders without it are never removed."""


@contextlib.contextmanager
def temporary_folder(purpose: str = "") -> Iterator[Path]:
    """Yield a new temporary folder, and remove it at the end; `purpose` becomes part of its name.

    Folders of this user that processes have left behind when they were killed are removed first.
    """
    remove_abandoned()
    with contextlib.ExitStack() as closing:
        with interrupts_deferred():
            folder, descriptor = _create(purpose)
            closing.callback(os.close, descriptor)
            closing.callback(shutil.rmtree, folder, ignore_errors=True)
        yield folder


def hold_folder(folder: Path) -> None:
    """Keep a folder from being removed as abandoned for as long as this process lives.

    Raises:
        OSError: the folder has been removed.
    """
    fcntl.flock(os.open(folder / OWNER_FILE, os.O_RDONLY | os.O_CLOEXEC), fcntl.LOCK_SH)


def remove_abandoned() -> None:
    """Remove the temporary folders of this user whose processes have all ended."""
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*/{OWNER_FILE}"):
        # Not a folder of this user, or another process is removing it.
        with contextlib.suppress(OSError):
            _remove_if_abandoned(path)


def _remove_if_abandoned(path: Path) -> None:
    folder = path.parent
    if folder.is_symlink() or folder.lstat().st_uid != os.geteuid():
        return
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(descriptor)


def _create(purpose: str) -> tuple[Path, int]:
    """Create a folder; return it and the descriptor that holds the lock."""
    prefix = f"{PREFIX}{purpose}-" if purpose else PREFIX
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix))
        path = folder / OWNER_FILE
        # Until the file is locked, another process may consider the folder abandoned.
        with contextlib.suppress(FileNotFoundError):
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            fcntl.flock(descriptor, fcntl.LOCK_SH)
            if os.fstat(descriptor).st_nlink:
                return folder, descriptor
            os.close(descriptor)
