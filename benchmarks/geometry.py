"""What the conflict table costs or saves: `python benchmarks/geometry.py [--json FILE]`.

The same formations in mode 2 with footprints, with the table at any delay, and with the table for
vehicles that are at most so late. CPU time of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from laneweave.coordinator.planning import PlanRequest, checked_plan, warm_up
from laneweave.coordinator.planning.clearances import close_pairs
from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.geometry import Geometry
from laneweave.coordinator.planning.instances import formation_request
from laneweave.coordinator.planning.rows import row_patterns

OUT = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "geometry.json"
MODELS: dict[str, Geometry | None] = {
    "footprints": None,
    "any delay": Geometry(),
    "0.5 s late": Geometry(lateness_s=0.5),
    "on time": Geometry(lateness_s=0.0),
}
VEHICLES = (6, 9, 12)
INSTANCES = 20
DEADLINE_S = 10.0


def measured(vehicles: int) -> Iterator[dict[str, Any]]:
    """Yield one row for each model; `changed` counts instances cheaper than with footprints."""
    reference: list[int] = []
    for name, geometry in MODELS.items():
        costs, times_ms, proven = [], [], 0
        for seed in range(INSTANCES):
            request = formation_request(seed, vehicles=vehicles, mode=2, deadline_s=DEADLINE_S)
            request = attrs.evolve(request, geometry=geometry)
            began = time.thread_time()
            response = checked_plan(request, solver="branching")
            times_ms.append((time.thread_time() - began) * 1e3)
            proven += response.status == "optimal"
            costs.append(_cost(request, response.cost))
        reference = reference or costs
        yield {
            "vehicles": vehicles,
            "conflicts": name,
            "instances": INSTANCES,
            "proven": proven,
            "cost": sum(costs),
            "cheaper": sum(cost < before for cost, before in zip(costs, reference, strict=True)),
            "cpu_ms_p50": round(float(np.percentile(times_ms, 50)), 1),
            "cpu_ms_p95": round(float(np.percentile(times_ms, 95)), 1),
        }


def _cost(request: PlanRequest, cost: int | None) -> int:
    if cost is None:
        raise RuntimeError(f"no plan for {len(request.vehicles)} vehicles in {DEADLINE_S:g} s")
    return cost


def table_times_ms() -> dict[str, float]:
    """Return how long it takes to compute each table and its rows, which is done once."""
    times_ms = {}
    for name, geometry in MODELS.items():
        if geometry is not None:
            close_pairs.cache_clear()
            row_patterns.cache_clear()
            began = time.thread_time()
            row_patterns(2, ConflictModel(["geometric"], geometry))
            times_ms[name] = round((time.thread_time() - began) * 1e3, 1)
    return times_ms


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=OUT, help="where to write")
    out: Path = parser.parse_args().json
    warm_up()
    results: dict[str, Any] = {"table_ms": table_times_ms(), "results": []}
    for vehicles in VEHICLES:
        for row in measured(vehicles):
            results["results"].append(row)
            sys.stdout.write(json.dumps(row) + "\n")
    out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
