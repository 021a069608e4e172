"""The files of a run, and errors for those that cannot be read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.summary import SUMMARY_FILE

TRAJECTORIES_FILE: Final = "trajectories.parquet"
TRIPS_FILE: Final = "trips.parquet"
TICKS_FILE: Final = "ticks.parquet"
EVENTS_FILE: Final = "events.jsonl"


def not_a_run(folder: Path, why: object) -> BadInputError:
    """Return the error for a folder that is not that of a finished run."""
    return BadInputError("folder", str(folder), f"the folder of a finished run ({why})")


@contextmanager
def reading(folder: Path, file: str) -> Iterator[None]:
    """Convert errors in reading a file of a run to a `BadInputError` that names the file.

    Raises:
        BadInputError: the file is missing, damaged, or has unexpected content.
    """
    try:
        yield
    except BadInputError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        if (folder / SUMMARY_FILE).is_file() and not (folder / file).exists():
            kept = "a run that kept this file"
            if file == TRAJECTORIES_FILE:
                kept += "; in a sweep: --keep-trajectories all"
            raise BadInputError(file, f"none in {folder}", kept) from error
        why = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        raise not_a_run(folder, f"{file} cannot be read: {why}") from error
