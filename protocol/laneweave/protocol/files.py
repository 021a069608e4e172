"""Atomic writing of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def write_atomically(path: Path, write: str | Callable[[Path], object]) -> None:
    """Write or replace a file atomically: readers never see a partial file.

    Args:
        path: the file.
        write: its text, or a function that writes its content to a given path.

    Raises:
        OSError: the disk is full, or fails; the file is as before.
    """
    part = path.with_suffix(".part")
    try:
        if isinstance(write, str):
            part.write_text(write, encoding="utf-8")
        else:
            write(part)
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
