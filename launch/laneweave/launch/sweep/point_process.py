"""The process of one point: `python -m laneweave.launch.sweep.point_process FOLDER PARENT`."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

from laneweave.launch.run.logs import log_to_terminal
from laneweave.launch.run.reference_run import ReferenceRun
from laneweave.launch.run.roles import tune_garbage_collector
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.launch.run_methods import FORMATION
from laneweave.launch.sweep.execution import JOB_FILE, RESULT_FILE
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.files import write_atomically
from laneweave.protocol.runtime.processes import die_with_parent, raise_interrupts


def main(folder: Path, parent: int) -> None:
    """Run the job in a folder; on failure, this process exits with an error status and a log.

    Args:
        folder: folder with `job.json`.
        parent: id of the process that started this one; this process exits when it does.
    """
    # Handle these like Ctrl-C, to complete files and remove temporary folders.
    raise_interrupts(signal.SIGTERM, signal.SIGHUP)
    die_with_parent(parent)
    log_to_terminal()
    tune_garbage_collector()
    job = json.loads((folder / JOB_FILE).read_text(encoding="utf-8"))
    scenario, method = parse_scenario(job["tables"]), job["method"]
    run = (
        SimulatedRun(scenario, folder, show_progress=False)
        if method == FORMATION
        else ReferenceRun(scenario, folder, method, show_progress=False)
    )
    problems = run.run().or_interrupt().problems
    write_atomically(folder / RESULT_FILE, json.dumps({"problems": problems}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
