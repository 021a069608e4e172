"""Cost of the conflict kind `closing`: `python benchmarks/closing.py [--json FILE]`.

The same formations are planned with and without this kind. CPU time of one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.exact.arrays import move_arrays
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.planner import FAMILIES
from laneweave.protocol.lattice import Cell

OUT = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "closing.json"
SIZES = {"block": (6,), "following": (6, 9, 12), "geometric": (6, 9, 12)}
CLOSING = ConflictModel(("closing",))
INSTANCES = 60
DEADLINE_S = 20.0


def closes_up(paths: Sequence[Sequence[Cell]]) -> bool:
    """Return whether two vehicles close up in any step."""
    steps = zip(*map(pairwise, paths), strict=True)
    return any(CLOSING.kind(a, b) is not None for moves in steps for a, b in combinations(moves, 2))


def measured(name: str, vehicles: int) -> dict[str, Any]:
    """Return the figures of all instances of a size without and with `closing`.

    closing_up: plans without `closing` in which two vehicles close up.
    """
    free = FAMILIES[name]
    kept = attrs.evolve(free, conflicts=(*free.conflicts, "closing"))
    costs, times_ms, proven, closing_up = [], [], [0, 0], 0
    for seed in range(INSTANCES):
        cost, time_ms = [], []
        for index, family in enumerate((free, kept)):
            request = family.request(seed, vehicles, DEADLINE_S)
            # Compute the arrays again, so that neither request profits from the other.
            move_arrays.cache_clear()
            began = time.thread_time()
            response = plan(request, solver="branching")
            time_ms.append((time.thread_time() - began) * 1e3)
            if response.cost is None:
                raise RuntimeError(f"no plan for {name}, {vehicles}, seed {seed}")
            cost.append(response.cost)
            proven[index] += response.status == "optimal"
            closing_up += index == 0 and closes_up(response.paths)
        costs.append(cost)
        times_ms.append(time_ms)
    cost_of, ms_of = np.array(costs), np.array(times_ms)
    more = cost_of[:, 1] - cost_of[:, 0]
    return {
        "conflicts": name,
        "vehicles": vehicles,
        "instances": INSTANCES,
        "proven": proven,
        "closing_up": closing_up,
        "cost": cost_of.sum(axis=0).tolist(),
        "costlier": int((more > 0).sum()),
        "more_steps_p50": float(np.median(more)),
        "more_steps_mean": round(float(more.mean()), 2),
        "more_steps_max": int(more.max()),
        "cpu_ms_p50": np.round(np.median(ms_of, axis=0), 1).tolist(),
        "cpu_ms_mean": np.round(ms_of.mean(axis=0), 1).tolist(),
        "cpu_ms_p95": np.round(np.percentile(ms_of, 95, axis=0), 1).tolist(),
        "cpu_factor_p50": round(float(np.median(ms_of[:, 1] / ms_of[:, 0])), 2),
    }


def rows() -> Iterator[dict[str, Any]]:
    """Yield one row for each family and size."""
    for name, sizes in SIZES.items():
        for vehicles in sizes:
            yield measured(name, vehicles)


def main() -> None:
    """Measure, print rows, and write them to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=OUT, help="output file")
    out: Path = parser.parse_args().json
    BRANCHING.load()
    results = []
    for row in rows():
        results.append(row)
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
    out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
