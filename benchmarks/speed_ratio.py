"""Measure the CPU time of a simulated run, relative to an earlier commit.

    python benchmarks/speed_ratio.py [--base COMMIT] [--rounds N] [--operation NAME]
                                     [--volume VEH_PER_LANE_H] [--duration S] [--limit RATIO]

Both commits run with the same demand, alternately, each time in a new process with the libraries of
this interpreter. Imports do not count. Prints the median ratio of the rounds; the exit status is 1
if it is above the limit. At the default volume, formations are planned without compiled code, which
the earlier commit would have to compile first.
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
with tempfile.TemporaryDirectory() as folder:
    for seconds in (1.0, duration):  # the first run loads what is loaded when it is needed
        began_s = time.process_time()
        laneweave.run(
            out=f"{folder}/{seconds}",
            transport="simulated",
            seed=77,
            demand__volume_veh_per_lane_h=volume,
            demand__duration_s=seconds,
            formation__operation=operation,
            **({"formation__solver": "tappa"} if operation == "formations" else {}),
        )
        spent_s = time.process_time() - began_s
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


def cpu_s(folder: Path, arguments: Sequence[str]) -> float:
    """Return the CPU time of a run with the code in a folder [s]."""
    found = os.pathsep.join(str(folder / part) for part in PARTS)
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", PROGRAM, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": found, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        check=True,
        text=True,
        timeout=LIMIT_S,
    )
    return float(done.stdout.splitlines()[-1])


def main() -> int:
    """Measure; return 1 if the ratio is above the limit."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--base", default=BASE, metavar="COMMIT")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--operation", default="formations")
    parser.add_argument("--volume", default="500")
    parser.add_argument("--duration", default="40")
    parser.add_argument("--limit", type=float, default=1.2)
    options = parser.parse_args()
    run = options.operation, options.volume, options.duration
    with tempfile.TemporaryDirectory() as base:
        unpack(options.base, Path(base))
        pairs = [(cpu_s(Path(base), run), cpu_s(ROOT, run)) for _ in range(options.rounds)]
    ratio = statistics.median(now / before for before, now in pairs)
    each = ", ".join(f"{now:.2f} / {before:.2f} s" for before, now in pairs)
    print(f"{ratio:.3f} of the CPU time of {options.base} ({each})")  # noqa: T201
    return int(ratio > options.limit)


if __name__ == "__main__":
    sys.exit(main())
