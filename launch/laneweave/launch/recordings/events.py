"""Events of a recorded run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from laneweave.launch.recordings.files import EVENTS_FILE, reading

Event = Mapping[str, Any]
"""`t_s` (road time), `kind`, and the data of the kind."""


def read_events(folder: Path, *kinds: str, required: bool = False) -> Iterator[Event]:
    """Yield the events of a run in the order of the file; times may descend slightly.

    A last line that is being written, or was when the run was killed, is left out.

    Args:
        folder: folder of the run.
        kinds: kinds of the events; none: all.
        required: whether the file must exist; old recordings have none.

    Raises:
        BadInputError: the events cannot be read.
    """
    path = folder / EVENTS_FILE
    if not (required or path.is_file()):
        return
    with reading(folder, EVENTS_FILE), path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            try:
                event = json.loads(line)
            except ValueError:
                if line.endswith("\n"):
                    raise
                return
            if not _is_event(event):
                raise ValueError(f"not an event: {line[:80].strip()}")
            if not kinds or event["kind"] in kinds:
                yield event


def _is_event(value: object) -> bool:
    return (
        isinstance(value, dict)
        and isinstance(value.get("t_s"), int | float)
        and isinstance(value.get("kind"), str)
    )
