"""Writing files: atomically, or in place such that an error changes nothing."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path


def write_atomically(path: Path, write: str | Callable[[Path], object]) -> None:
    """Write or replace a file atomically: readers never see a partial file.

    Whatever interrupts this leaves no other file; of two processes that write the same file, the
    last one succeeds.

    Args:
        path: the file.
        write: its text, or a function that writes its content to a given path.

    Raises:
        OSError: the disk is full, or fails; the file is as before, and the error names it.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        if isinstance(write, str):
            part.write_text(write, encoding="utf-8")
        else:
            write(part)
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(part)):
            error.filename = str(path)
        raise


def append(file: io.FileIO, data: bytes) -> None:
    """Append to a file to which other processes may append; after an error, nothing is added.

    Args:
        file: opened unbuffered, for appending.
        data: the new content, which readers see as a whole.

    Raises:
        OSError: the disk is full, or fails.
    """
    written_bytes = file.write(data)
    if written_bytes < len(data):
        file.truncate(file.tell() - written_bytes)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def overwrite(file: io.FileIO, begin: int, data: bytes) -> None:
    """Replace the content of a file from a position on; after an error, the file is as before.

    Args:
        file: opened unbuffered, for reading and writing.
        begin: the position.
        data: the new content.

    Raises:
        OSError: the disk is full, or fails.
    """
    file.seek(begin)
    before = file.read()
    file.seek(begin)
    written_bytes, failed = 0, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    try:
        written_bytes = file.write(data)
    except OSError as error:
        failed = error
    if written_bytes < len(data):
        file.seek(begin)
        file.write(before)  # the disk still has its blocks
        file.truncate(begin + len(before))
        raise failed
    file.truncate(begin + len(data))
