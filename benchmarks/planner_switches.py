"""Effect of each improvement of TAPPA: `python benchmarks/planner_switches.py [--json FILE]`.

Formations of random traffic, and interlaced ones of 2 to 6 vehicles in blocks of four columns, are
planned with all improvements, with all but one, and by the literal algorithms. CPU time of one
thread. Each proven cost is compared with the one found by branching.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from laneweave.coordinator.planning.budget import Budget, Stopwatch
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.paper.assignments import Weights
from laneweave.coordinator.planning.paper.cbs import Improvements
from laneweave.coordinator.planning.paper.tappa import Tappa
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import MAX_NODES, plan
from laneweave.launch.bench.request_families import TRAFFIC_KINDS, block_request, traffic_request

OUT = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "planner-switches.json"
INSTANCES, FEWER_INSTANCES = 200, 60
"""Number of instances with all improvements, and without some."""
DEADLINE_S = 4.0


def interlaced_request(seed: int) -> PlanRequest:
    """Return an interlaced formation of 2 to 6 vehicles."""
    return block_request(seed, vehicles=2 + seed % 5, conflicts=TRAFFIC_KINDS)


FAMILIES: dict[str, Callable[[int], PlanRequest]] = {
    "interlaced": interlaced_request,
    "traffic": traffic_request,
}


def switch_settings() -> Iterator[tuple[str, Improvements]]:
    """Yield the name and the setting of each variant."""
    yield "all", Improvements()
    for field in attrs.fields(Improvements):
        yield f"without {field.name}", attrs.evolve(Improvements(), **{field.name: False})
    yield "none", Improvements.none()


def planned(request: PlanRequest, improvements: Improvements) -> tuple[float, int | None]:
    """Return CPU time [ms] and cost; the cost is None if it was not proven before the deadline."""
    stopwatch = Stopwatch(time.thread_time)
    budget = Budget(deadline_s=DEADLINE_S, max_nodes=MAX_NODES, stopwatch=stopwatch)
    weights = Weights.for_mode(request.mode)
    run = Tappa(request, request.problem(), weights, budget, improvements)
    run.run()
    return 1e3 * stopwatch.time_s, run.best.cost if run.finished and run.best is not None else None


def measured(family: str, name: str, improvements: Improvements, instances: int) -> dict[str, Any]:
    """Return one row.

    Raises:
        RuntimeError: a cost that is reported as optimal differs from the one found by branching.
    """
    times_ms, solved = [], 0
    for seed in range(instances):
        request = FAMILIES[family](seed)
        cpu_ms, cost = planned(request, improvements)
        times_ms.append(cpu_ms)
        solved += cost is not None
        if cost is not None and cost != plan(request).cost:
            raise RuntimeError(f"{family}, seed {seed}, {name}: {cost} is not optimal")
    p50, p95, maximum = np.percentile(times_ms, [50, 95, 100]).tolist()
    return {
        "family": family,
        "improvements": name,
        "instances": instances,
        "solved": solved,
        "cpu_ms_p50": round(p50, 1),
        "cpu_ms_p95": round(p95, 1),
        "cpu_ms_max": round(maximum, 1),
    }


def main() -> None:
    """Measure, print rows, and write them to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=OUT, metavar="FILE", help="output file")
    options = parser.parse_args()
    BRANCHING.load()
    rows = []
    for family in FAMILIES:
        for name, improvements in switch_settings():
            instances = INSTANCES if improvements == Improvements() else FEWER_INSTANCES
            rows.append(measured(family, name, improvements, instances))
            sys.stdout.write(json.dumps(rows[-1]) + "\n")
            sys.stdout.flush()
    options.json.write_text(
        json.dumps({"deadline_s": DEADLINE_S, "results": rows}, indent=1) + "\n"
    )


if __name__ == "__main__":
    main()
