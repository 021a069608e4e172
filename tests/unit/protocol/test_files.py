"""Writing files whole, and appending to a file that other processes append to."""

from __future__ import annotations

import errno
import re
import signal
from pathlib import Path
from resource import RLIM_INFINITY, RLIMIT_FSIZE, setrlimit
from unittest.mock import Mock

import pytest

from laneweave.protocol.files import append, write_atomically


def test_two_writers_append_in_turn(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    with path.open("ab", buffering=0) as one, path.open("ab", buffering=0) as other:
        append(one, b"1\n")
        append(other, b"2\n")
        append(one, b"3\n")
    assert path.read_bytes() == b"1\n2\n3\n"


def test_a_line_that_does_not_fit_on_the_disk_is_not_there_in_part(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with path.open("ab", buffering=0) as file:
            append(file, b"first\n")
            setrlimit(RLIMIT_FSIZE, (8, RLIM_INFINITY))
            with pytest.raises(OSError, match="No space left"):
                append(file, b"second\n")
            append(file, b"3\n")
    finally:
        setrlimit(RLIMIT_FSIZE, (RLIM_INFINITY, RLIM_INFINITY))
        signal.signal(signal.SIGXFSZ, before)
    assert path.read_bytes() == b"first\n3\n"


@pytest.mark.parametrize("error", [OSError, RuntimeError, KeyboardInterrupt])
def test_what_ends_writing_leaves_the_file_as_it_was(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "file.txt"
    write_atomically(path, "first")

    def fail(part: Path) -> None:
        part.write_text("half", encoding="utf-8")
        raise error

    with pytest.raises(error):
        write_atomically(path, fail)
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_text(encoding="utf-8") == "first"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "full"), "[Errno 28] full: '{path}'"),
        (OSError("encoder error -2"), "encoder error -2"),
        (FileNotFoundError(errno.ENOENT, "gone", "input.txt"), "[Errno 2] gone: 'input.txt'"),
    ],
)
def test_errors_of_the_disk_name_the_file(tmp_path: Path, error: OSError, said: str) -> None:
    path = tmp_path / "file.txt"
    with pytest.raises(OSError, match=f"^{re.escape(said.format(path=path))}$"):
        write_atomically(path, Mock(side_effect=error))


def test_files_that_differ_in_their_suffix_are_written_at_once(tmp_path: Path) -> None:
    """One writer begins while the other one has not finished."""

    def write_both(part: Path) -> None:
        part.write_text("outer", encoding="utf-8")
        write_atomically(tmp_path / "run.mcap", "inner")

    write_atomically(tmp_path / "run.xml", write_both)
    assert (tmp_path / "run.xml").read_text(encoding="utf-8") == "outer"
    assert (tmp_path / "run.mcap").read_text(encoding="utf-8") == "inner"
