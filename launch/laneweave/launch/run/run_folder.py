"""Folders of new runs, and names of new folders."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario

LOG_FILE = "log.jsonl"


@contextmanager
def new_folder(out: Path | None, settings: Scenario, method: str) -> Iterator[Path]:
    """Yield a new or empty folder; remove a new one if the run is rejected or interrupted early.

    Raises:
        BadInputError: the folder is not empty, or cannot be created.
    """
    volume = f"{settings.demand.volume_veh_per_lane_h:g}"
    folder = out or timestamped_folder(f"{method}-{volume}-seed{settings.seed}")
    existed = _claim(folder)
    try:
        yield folder
    except (BadInputError, KeyboardInterrupt):
        files = list(folder.iterdir())
        if files == [folder / LOG_FILE] and not files[0].stat().st_size:
            files[0].unlink()
            if not existed:
                folder.rmdir()
        raise


def timestamped_folder(prefix: str) -> Path:
    """Return the path of a folder in runs/ that does not exist: the prefix, date and time."""
    base = folder = Path("runs") / f"{prefix}-{time.strftime('%Y%m%d-%H%M%S')}"
    copies = 1
    while folder.exists():
        copies += 1
        folder = base.with_name(f"{base.name}-{copies}")
    return folder


def _claim(folder: Path) -> bool:
    """Create a folder, or claim an empty one; return whether it existed."""
    try:
        existed = folder.is_dir()
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise BadInputError("--out", str(folder), "a new or empty folder")
        # If two runs start simultaneously, the second one fails here.
        (folder / LOG_FILE).touch(exist_ok=False)
    except FileExistsError as error:
        raise BadInputError("--out", str(folder), "a new or empty folder") from error
    except OSError as error:
        raise BadInputError("--out", str(folder), f"a folder ({error.strerror})") from error
    return existed
