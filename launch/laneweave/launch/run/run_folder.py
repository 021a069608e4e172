"""The folder of a run: a new one, and the report in it."""

from __future__ import annotations

import time
from pathlib import Path

from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.scenario.tables import Scenario


def new_folder(out: Path | None, settings: Scenario, method: str) -> Path:
    """Return a folder that holds no other run.

    Raises:
        BadInputError: it does, or it cannot be made.
    """
    if out is None:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        volume = f"{settings.demand.volume_veh_per_lane_h:g}"
        base = Path("runs") / f"{method}-{volume}-seed{settings.seed}-{stamp}"
        out = base
        copies = 1
        while out.exists():
            copies += 1
            out = base.with_name(f"{base.name}-{copies}")
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise BadInputError("--out", str(out), "a new or empty folder")
        # Two runs that begin at the same time: the second one fails here.
        (out / "log.jsonl").touch(exist_ok=False)
    except FileExistsError as error:
        raise BadInputError("--out", str(out), "a new or empty folder") from error
    except OSError as error:
        raise BadInputError("--out", str(out), f"a folder ({error.strerror})") from error
    return out


def draw_own(folder: Path) -> None:
    """Draw the pictures and write the page of the run that has just ended.

    Raises:
        CommandFailedError: they cannot be written.
    """
    from laneweave.launch.report.build import report_run
    from laneweave.launch.report.runs import single_run

    try:
        report_run(single_run(folder))
    except OSError as error:
        raise CommandFailedError(f"{folder}: pictures not drawn: {error}") from error
