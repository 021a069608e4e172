"""Cost of faults: the table of docs/EVALUATION_FAULTS.md, "Under faults".

    python benchmarks/resilience.py [--only NAME ...] [--out FOLDER]

Each experiment is one `laneweave run` with a faults file: real processes, or for the rolling
operation all roles over the simulated network, where results repeat exactly. The figures are read
from the run's folder and written to FOLDER/resilience.json; they include the failures that the run
itself reports (overlaps, vehicles that did not leave). Finished experiments are kept, unless
`--only` names them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from attrs import frozen

from experiments import run_missing
from laneweave.protocol.wire.events import (
    CARETAKER_TOOK_OVER,
    PART_CLOSED,
    PLAN_EVENTS,
    PLAN_MADE,
)

HERE = Path(__file__).resolve().parent
TIMEOUT_S = 3600.0


@frozen
class Experiment:
    """A run with faults."""

    name: str
    faults: str | None
    """A preset, or a file in `benchmarks/faults`."""
    options: tuple[str, ...] = ()


REAL_TIME = ("--pace", "1")


def demand(volume: int, duration_s: int, operation: str = "formations") -> tuple[str, ...]:
    """Return the options for a volume in vehicles/(lane h) and the duration of the arrivals."""
    flow = ("--volume", f"{volume}", "--seed", "1", "--duration", f"{duration_s}")
    return ("--operation", operation, *flow)


def rolling(name: str, faults: str | None, duration_s: int = 200) -> Experiment:
    """Return an experiment of the rolling operation at 1600 vehicles/(lane h), simulated."""
    options = (*demand(1600, duration_s, "rolling"), "--transport", "simulated")
    return Experiment(f"rolling-{name}", faults, options)


def breakdown(operation: str, volume: int) -> Experiment:
    """Return an experiment in which a vehicle breaks down and the leader is killed then."""
    options = demand(volume, 330, operation)
    return Experiment(f"breakdown-{operation}-{volume}", "breakdown-leader-killed.toml", options)


EXPERIMENTS = (
    Experiment("undisturbed", None, demand(1600, 200)),
    Experiment("loss-10", "lossy10", demand(1600, 200)),
    Experiment("loss-30", "loss-30.toml", demand(1600, 200)),
    Experiment("loss-50", "lossy50", demand(1600, 200)),
    Experiment("blackout", "blackout", demand(1600, 200)),
    Experiment("blackout-from-start", "blackout-from-start.toml", demand(1600, 200)),
    Experiment("agents-killed", "agents-killed.toml", demand(1600, 300)),
    Experiment("everything", "everything", demand(1600, 200)),
    # Times are measured on a road that is not full, so that both cores have spare capacity.
    Experiment("router-killed", "router-killed-10-times.toml", (*demand(1000, 300), *REAL_TIME)),
    Experiment("leader-killed", "leader-killed-50-times.toml", (*demand(1000, 300), *REAL_TIME)),
    Experiment("leader-stopped", "leader-stopped-30-times.toml", (*demand(600, 560), *REAL_TIME)),
    *(breakdown("rolling", volume) for volume in (1000, 1450, 1800)),
    *(breakdown("formations", volume) for volume in (1000, 1450)),
    rolling("undisturbed", None),
    rolling("loss-10", "lossy10"),
    rolling("loss-30", "loss-30.toml"),
    rolling("loss-50", "lossy50"),
    rolling("blackout", "blackout"),
    rolling("agents-killed", "agents-killed.toml", 300),
    rolling("everything", "everything"),
)


def run(experiment: Experiment, folder: Path) -> dict[str, Any]:
    """Run an experiment and return its figures."""
    command = [str(Path(sys.executable).parent / "laneweave"), "run", "--no-progress"]
    command += [*experiment.options, "--out", str(folder)]
    if experiment.faults is not None:
        path = HERE / "faults" / experiment.faults
        command += ["--faults", str(path) if path.exists() else experiment.faults]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)  # noqa: S603
    failures = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
    (folder / "stderr.txt").write_text(done.stderr, encoding="utf-8")
    return {"status": done.returncode, "failures": failures} | figures(folder)


def figures(folder: Path) -> dict[str, Any]:
    """Return the figures of a run's folder."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    trips = pq.read_table(folder / "trips.parquet").to_pylist()
    kinds: Counter[str] = Counter()
    plans: Counter[int] = Counter()
    killed: set[str] = set()
    closed_s: float | None = None
    planned_s: float | None = None
    for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines():
        event = json.loads(line)
        kinds[event["kind"]] += 1
        if event["kind"] == PLAN_MADE:
            plans[event["formation"]] += 1
        if event["kind"] == PART_CLOSED and closed_s is None:
            closed_s = event["t_s"]
        if event["kind"] in PLAN_EVENTS and closed_s is not None and planned_s is None:
            planned_s = event["t_s"]
        if event["kind"] == CARETAKER_TOOK_OVER:
            killed.add(event["vehicle"])
    others = [
        trip for trip in trips if trip["vehicle"] not in killed and trip["left_s"] is not None
    ]
    vehicles, failover = summary["vehicles"], summary["failover"]
    return {
        "overlaps": summary["safety"]["overlaps"],
        "demanded": vehicles["demanded"],
        "left": vehicles["left"],
        "on_lane_percent": _percent(vehicles["on_preferred_lane"], vehicles["left"]),
        "others": len(others),
        "others_on_lane_percent": _percent(
            sum(trip["final_lane"] == trip["preferred_lane"] for trip in others), len(others)
        ),
        "travel_time_s": summary["travel_time_s"]["mean"],
        "min_gap_m": summary["safety"]["min_gap_m"],
        "dropped": summary["messages"]["dropped_by_faults"],
        "real_time_factor": summary["runtime"]["real_time_factor"],
        "formations_planned": len(plans),
        "replanned": sum(plans.values()) - len(plans),
        "leader_recovery_s": _spread(failover["recovery_s"]),
        "plan_recovery_s": _spread(failover.get("plan_recovery_s", [])),
        "stopped": sum(one["stopped"] for one in summary["obstacles"] or ()),
        "planned_after_s": None
        if closed_s is None or planned_s is None
        else round(planned_s - closed_s, 2),
        "events": dict(kinds),
    }


def _percent(part: int, whole: int) -> float | None:
    return 100.0 * part / whole if whole else None


def _spread(values: list[float]) -> dict[str, float | int]:
    if not values:
        return {"count": 0}
    p50, p99 = np.percentile(values, [50, 99], method="higher")
    return {"count": len(values), "p50": float(p50), "p99": float(p99), "max": max(values)}


def main() -> None:
    """Run the requested experiments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    runs = {experiment.name: partial(run, experiment) for experiment in EXPERIMENTS}
    parser.add_argument("--only", nargs="+", choices=runs)
    parser.add_argument("--out", type=Path, default=Path("runs/resilience"), help="folder")
    arguments = parser.parse_args()
    run_missing(runs, arguments.only, arguments.out / "resilience.json")


if __name__ == "__main__":
    main()
