"""Measure how fast runs are, relative to an earlier commit.

    python benchmarks/speed_ratio.py [--base COMMIT] [--rounds N] [--operation NAME]
                                     [--volume VEH_PER_LANE_H] [--duration S] [--limit RATIO]
                                     [--vehicles-per-process N] [--compiled]

Both commits run with the same demand, alternately, each time in a new process with the libraries of
this interpreter. A simulated run takes CPU time, without imports; with --vehicles-per-process,
processes over Zenoh take seconds per second of road time. Prints the median ratio of the rounds;
the exit status is 1 if it is above the limit. Formations are planned by TAPPA, which needs no
compiled code; with --compiled by the default solver, which the earlier commit compiles first.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BASE = "31659603"
"""Commit to compare with: the last one in which formations sorted into the parallel structure."""
PARTS = ("protocol", "coordinator", "agents", "sim_bridge", "launch")
LIMIT_S = 600.0
PROGRAM = """
import sys, tempfile, time
import laneweave
import laneweave.launch.library.runs
operation, volume, duration = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
per_process, compiled = int(sys.argv[4]), int(sys.argv[5])
more = {"formation__solver": "tappa"} if operation == "formations" and not compiled else {}
if per_process:
    more |= {"runtime__vehicles_per_process": per_process, "runtime__max_pace": 20.0}
else:
    more |= {"transport": "simulated"}
with tempfile.TemporaryDirectory() as folder:
    for seconds in (1.0, duration):  # the first run loads what is loaded when it is needed
        began_s = time.process_time()
        summary = laneweave.run(
            out=f"{folder}/{seconds}",
            seed=77,
            demand__volume_veh_per_lane_h=volume,
            demand__duration_s=seconds,
            formation__operation=operation,
            **more,
        )
        spent_s = time.process_time() - began_s
        if per_process:
            spent_s = 1.0 / summary.runtime.real_time_factor
print(spent_s)
"""


def unpack(commit: str, folder: Path) -> None:
    """Write the files of a commit into a folder.

    Raises:
        subprocess.CalledProcessError: this is not a clone with this commit.
    """
    command = ["git", "archive", "--format=tar", commit, *PARTS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, check=True)  # noqa: S603
    with tarfile.open(fileobj=BytesIO(done.stdout)) as archive:
        archive.extractall(folder, filter="data")


COMPILE = """
import sys
from laneweave.launch.cli.main import main
sys.argv = ["laneweave", "compile"]
main()
"""


def output_of(program: str, folder: Path, arguments: Sequence[str] = ()) -> str:
    """Return what a program prints that runs with the code in a folder."""
    found = os.pathsep.join(str(folder / part) for part in PARTS)
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", program, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": found, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        check=True,
        text=True,
        timeout=LIMIT_S,
    )
    return done.stdout


def spent_s(folder: Path, arguments: Sequence[str]) -> float:
    """Return the CPU time of a run [s], or the time per second of road time."""
    return float(output_of(PROGRAM, folder, arguments).splitlines()[-1])


def main() -> int:
    """Measure; return 1 if the ratio is above the limit."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--base", default=BASE, metavar="COMMIT")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--operation", default="formations")
    parser.add_argument("--volume", default="500")
    parser.add_argument("--duration", default="40")
    parser.add_argument("--limit", type=float, default=1.2)
    parser.add_argument("--vehicles-per-process", type=int, default=0, metavar="N")
    parser.add_argument("--compiled", action="store_true")
    options = parser.parse_args()
    per_process, compiled = options.vehicles_per_process, options.compiled
    demand = options.operation, options.volume, options.duration
    run = *demand, str(per_process), str(int(compiled))
    with tempfile.TemporaryDirectory() as base:
        unpack(options.base, Path(base))
        if compiled:
            output_of(COMPILE, Path(base))
        pairs = [(spent_s(Path(base), run), spent_s(ROOT, run)) for _ in range(options.rounds)]
    ratio = statistics.median(now / before for before, now in pairs)
    each = ", ".join(f"{now:.3f} / {before:.3f} s" for before, now in pairs)
    what = "time per second of road time" if per_process else "CPU time"
    print(f"{ratio:.3f} of the {what} of {options.base} ({each})")  # noqa: T201
    return int(ratio > options.limit)


if __name__ == "__main__":
    sys.exit(main())
