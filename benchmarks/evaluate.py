"""Run the evaluation and update its pages, docs/EVALUATION_*.md.

    python benchmarks/evaluate.py [--only PART ...] [--labels LABEL ...] [--volumes V ...]
                [--seeds A:B] [--add-runs] [--budget MINUTES] [--jobs N] [--duration S]
                [--sweeps DIR ...] [--out DIR]

zenoh      three points of the sweep over Zenoh with a process per vehicle, and simulated
speed      real-time factors of three deployments
length     cost of a vehicle on 1 km and on 10 km of road
stability  how a disturbance of speed propagates: benchmarks/stability.py
sweep      every method at every volume, one seed after the other
report     docs/evidence/evaluation.json, figures in docs/images, tables in the pages
faults     benchmarks/resilience.py, over an hour; only on request

Finished parts are kept: the same command continues where it stopped. With --labels the sweep runs
only these methods, and the report replaces only their rows; with --add-runs it keeps those of other
seeds and volumes, so that the runs of one version may be made on several days. With --budget the
sweep starts no seed that would not finish in time, by the durations of the runs so far. The exit
status is 1 if a run of formation control violates a guarantee or does not finish.
"""

from __future__ import annotations

import argparse
import math
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from evaluation.conduct import Rounds, refresh, run_trials, say
from evaluation.programme import DURATION_S, LABELS, SEEDS, VOLUMES
from laneweave.launch.cli.options import check_jobs, parse_seeds
from laneweave.protocol.errors import BadInputError, CommandFailedError

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PARTS = ("zenoh", "speed", "length", "stability", "sweep", "report", "faults")
"""In the order in which they run: the sweep uses the remaining time."""
ON_REQUEST = ("faults",)
REPORT_S = 300.0
"""Part of the budget reserved for the report."""


def parse_names(option: str, names: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return the given names in the order of the known ones.

    Raises:
        BadInputError: a name is not known.
    """
    for name in names:
        if name not in known:
            raise BadInputError(option, name, "some of " + ", ".join(known))
    return tuple(name for name in known if name in names)


def parse_volumes(texts: Sequence[str]) -> tuple[float, ...]:
    """Return volumes of the evaluation.

    Raises:
        BadInputError: a volume is not one of the evaluation.
    """
    names = {f"{volume:g}": volume for volume in VOLUMES}
    return tuple(names[name] for name in parse_names("--volumes", texts, tuple(names)))


def parse_positive(option: str, text: str, unit: str) -> float:
    """Return a positive number.

    Raises:
        BadInputError: the text is not a positive number.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise BadInputError(option, text, f"a positive number of {unit}")
    return value


def run_faults(out: Path) -> bool:
    """Run the fault experiments and store their results; return whether they finished."""
    folder = out / "faults"
    script = Path(__file__).with_name("resilience.py")
    done = subprocess.run([sys.executable, str(script), "--out", str(folder)], check=False)  # noqa: S603
    if done.returncode == 0:
        shutil.copyfile(folder / "resilience.json", DOCS / "evidence" / "resilience.json")
    return done.returncode == 0


def run_script(script: Path) -> bool:
    """Run a script of this repository without options; return whether it succeeded."""
    return subprocess.run([sys.executable, str(script)], check=False).returncode == 0  # noqa: S603


def run(arguments: argparse.Namespace) -> bool:
    """Run the requested parts; return whether all of them succeeded.

    Raises:
        BadInputError: an option or a folder is not valid.
        CommandFailedError: files or processes cannot be created.
    """
    parts, out = parse_names("--only", arguments.only, PARTS), Path(arguments.out)
    labels = parse_names("--labels", arguments.labels, LABELS)
    end_s = None
    if arguments.budget is not None:
        budget_s = 60.0 * parse_positive("--budget", arguments.budget, "minutes")
        end_s = time.monotonic() + budget_s - (REPORT_S if "report" in parts else 0.0)
    rounds = Rounds(
        labels=labels,
        volumes=parse_volumes(arguments.volumes),
        seeds=parse_seeds(arguments.seeds),
        duration_s=parse_positive("--duration", arguments.duration, "seconds"),
        jobs=check_jobs(arguments.jobs),
        end_s=end_s,
    )
    good = True
    for part in parts:
        if part == "sweep":
            good &= rounds.run(out)
        elif part == "report":
            say("report")
            refresh(out, arguments.sweeps, labels, DOCS, add_runs=arguments.add_runs)
            good &= run_script(DOCS / "generate.py")
        elif part == "stability":
            say("stability")
            good &= run_script(Path(__file__).with_name("stability.py"))
        elif part == "faults":
            say("faults")
            good &= run_faults(out) and run_script(DOCS / "generate.py")
        else:
            good &= run_trials(part, out, ROOT, rounds.jobs)
    return good


def main() -> int:
    """Run, and return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="PART",
        default=[part for part in PARTS if part not in ON_REQUEST],
        help=", ".join(PARTS),
    )
    parser.add_argument(
        "--labels", nargs="+", metavar="LABEL", default=LABELS, help=", ".join(LABELS)
    )
    volumes = [f"{volume:g}" for volume in VOLUMES]
    parser.add_argument(
        "--volumes", nargs="+", metavar="V", default=volumes, help=", ".join(volumes)
    )
    parser.add_argument("--seeds", default=f"{SEEDS[0]}:{SEEDS[-1] + 1}", help="seeds of the sweep")
    parser.add_argument(
        "--add-runs",
        action="store_true",
        help="report: keep recorded runs of other seeds and volumes",
    )
    parser.add_argument("--duration", default=f"{DURATION_S:g}", help="duration of arrivals [s]")
    parser.add_argument(
        "--jobs",
        type=int,
        help="parallel processes of the sweep and of trials that share cores; default: all cores",
    )
    parser.add_argument("--budget", metavar="MINUTES", help="total duration; default: no limit")
    parser.add_argument(
        "--sweeps", nargs="+", type=Path, default=[], metavar="DIR",
        help="report: folders of sweeps instead of OUT/sweep",
    )  # fmt: skip
    parser.add_argument(
        "--out", default="runs/evaluation", metavar="DIR", help="folder of the runs"
    )
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return 0 if run(parser.parse_args()) else 1
    except BadInputError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except (CommandFailedError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; the same command resumes\n")
        return 1


if __name__ == "__main__":
    sys.exit(main())
