"""Writing of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def write_atomically(path: Path, write: str | Callable[[Path], object]) -> None:
    """Write a file completely or not at all: readers never see a part of it.

    Args:
        path: the file, which is replaced if it exists.
        write: its text, or a function that writes the content to the path that it is given.
    """
    unfinished = path.with_suffix(".part")
    if isinstance(write, str):
        unfinished.write_text(write, encoding="utf-8")
    else:
        write(unfinished)
    unfinished.replace(path)
