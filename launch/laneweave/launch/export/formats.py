"""The formats in which a run can be exported, and their files."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from laneweave.launch.export.recording import Recording
from laneweave.launch.recordings.runs import single_run
from laneweave.protocol.errors import BadInputError, CommandFailedError

FOLDER = "export"
"""Folder in that of a run for its exports."""
FCD_SUFFIXES = (".xml", ".xml.gz")


class Format(StrEnum):
    """A format of recorded runs."""

    fcd = "fcd"
    csv = "csv"
    mcap = "mcap"
    commonroad = "commonroad"


def export(
    run: Path,
    chosen: Format,
    out: Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
) -> list[Path]:
    """Write a run in a format; return the files.

    Args:
        run: the run's folder.
        chosen: the format.
        out: the file, or, for CSV, the folder of its files; None: in the folder `FOLDER` of the
            run, with the default name of the format.
        from_s: road time of the first tick; None: the beginning of the run.
        to_s: road time of the last tick; None: its end.

    Raises:
        BadInputError: the run cannot be read, or `out` does not fit.
        CommandFailedError: a file cannot be written.
        ModuleNotFoundError: the packages of the format are not installed.
    """
    try:
        return _write(run, chosen, out, from_s, to_s)
    except OSError as error:
        reason = error.strerror or error
        raise CommandFailedError(f"{error.filename or out or run}: {reason}") from error


def _write(
    run: Path, chosen: Format, out: Path | None, from_s: float | None, to_s: float | None
) -> list[Path]:
    # Each format imports its own packages.
    if chosen is Format.csv:
        from laneweave.launch.export.csv_tables import write_csv  # noqa: PLC0415

        return write_csv(run, _csv_folder(run, out), from_s, to_s)
    recording = Recording.read(run, from_s, to_s)
    if chosen is Format.fcd:
        from laneweave.launch.export.fcd import FCD_FILE, write_fcd  # noqa: PLC0415

        return write_fcd(recording, _file(out or run / FOLDER / FCD_FILE, *FCD_SUFFIXES))
    if chosen is Format.mcap:
        from laneweave.launch.export.mcap_file import MCAP_FILE, write_mcap  # noqa: PLC0415

        path = _file(out or run / FOLDER / MCAP_FILE, ".mcap")
        return write_mcap(recording, path, from_s, to_s)
    from laneweave.launch.export.commonroad_file import (  # noqa: PLC0415
        COMMONROAD_FILE,
        write_commonroad,
    )

    return write_commonroad(recording, _file(out or run / FOLDER / COMMONROAD_FILE, ".xml"))


def _csv_folder(run: Path, out: Path | None) -> Path:
    """Return the folder of CSV files.

    Raises:
        BadInputError: `run` is not the folder of a run, or `out` is a file or has the name of one.
    """
    single_run(run)
    path = out or run / FOLDER
    if path.is_file() or path.suffix == ".csv":
        raise BadInputError("--out", str(path), "a folder")
    return path


def _file(path: Path, *suffixes: str) -> Path:
    """Return a path with an allowed suffix, in a folder that exists.

    Raises:
        BadInputError: it is a folder, or has another suffix.
    """
    if path.is_dir() or not path.name.endswith(suffixes):
        raise BadInputError("--out", str(path), f"a file *{' or *'.join(suffixes)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
