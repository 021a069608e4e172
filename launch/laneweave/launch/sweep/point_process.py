"""The process of one point: `python -m laneweave.launch.sweep.point_process FOLDER PARENT`."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

from laneweave.launch.run.logs import log_to_terminal
from laneweave.launch.run.roles import collect_rarely
from laneweave.launch.sweep.execution import JOB_FILE, RESULT_FILE
from laneweave.launch.sweep.run_point import run_method
from laneweave.protocol.config.loading import parse_scenario
from laneweave.protocol.files import write_atomically
from laneweave.protocol.runtime.processes import die_with_parent


def main(folder: Path, parent: int) -> None:
    """Run the job in a folder; whatever goes wrong ends this process with a status and a log.

    Args:
        folder: holds `job.json`.
        parent: process id of the one who ordered it; without it there is nobody to run for.
    """
    # As Ctrl-C: files are completed and temporary folders removed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    die_with_parent()
    if os.getppid() != parent:
        sys.exit("nobody waits for this run")
    log_to_terminal()
    collect_rarely()
    job = json.loads((folder / JOB_FILE).read_text(encoding="utf-8"))
    outcome = run_method(parse_scenario(job["tables"]), job["method"], folder)
    write_atomically(folder / RESULT_FILE, json.dumps({"problems": outcome.problems}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
