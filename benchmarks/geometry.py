"""Cost and benefit of conflict tables: `python benchmarks/geometry.py [--json FILE]`.

The same formations are planned in mode 2 with footprints, with the table for any delay, and with
tables for limited lateness. CPU time of one thread. Also measures the minimum gap between bodies
whose moves do not conflict, with the paper's kinds and with footprints; `--only nearest` measures
only these gaps.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from conflict_drawing import conflict
from laneweave.agents.driving.trajectory import move_profile
from laneweave.coordinator.planning.conflict_kinds import PAPER_KINDS, ConflictModel, Pair
from laneweave.coordinator.planning.exact.cliques import clique_patterns
from laneweave.coordinator.planning.geometry.conflict_table import conflict_table
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import formation_request
from laneweave.protocol.lattice import displacements
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import cell_state
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, pose_of

OUT = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "geometry.json"
MODELS: dict[str, BodyGeometry | None] = {
    "footprints": None,
    "any delay": BodyGeometry(),
    "0.5 s late": BodyGeometry(lateness_s=0.5),
    "on time": BodyGeometry(lateness_s=0.0),
}
ALLOWING: dict[str, tuple[str, ...]] = {
    "node, edge, special-1": PAPER_KINDS[:3],
    "node, edge, special-1, special-4": (*PAPER_KINDS[:3], "special-4"),
    "node, edge, special-1 to special-4": PAPER_KINDS,
    "geometric: footprints": ("geometric",),
}
VEHICLES = (6, 9, 12)
INSTANCES = 20
DEADLINE_S = 10.0


def measured(vehicles: int) -> Iterator[dict[str, Any]]:
    """Yield one row for each model; `cheaper` counts instances cheaper than with footprints."""
    reference: list[int] = []
    for name, geometry in MODELS.items():
        costs, times_ms, proven = [], [], 0
        for seed in range(INSTANCES):
            request = formation_request(seed, vehicles=vehicles, mode=2, deadline_s=DEADLINE_S)
            request = attrs.evolve(request, geometry=geometry)
            began = time.thread_time()
            response = plan(request, solver="branching")
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
    """Return the time to compute each table and its cliques, which are cached."""
    times_ms = {}
    for name, geometry in MODELS.items():
        if geometry is not None:
            conflict_table.cache_clear()
            clique_patterns.cache_clear()
            began = time.thread_time()
            clique_patterns(2, ConflictModel(["geometric"], conflict_table(geometry)))
            times_ms[name] = round((time.thread_time() - began) * 1e3, 1)
    return times_ms


def nearest() -> list[dict[str, Any]]:
    """Return the minimum gap [m] of moves of mode 2 that a model allows, for each lateness.

    The moves are those of agents in the default scenario, without tracking errors; gaps are bumper
    to bumper between the turned bodies, negative if they overlap.
    """
    tick_s, move_s = Scenario().runtime.tick_s, Scenario().timing.move_s
    ticks_late = {f"{late_s:g} s": round(late_s / tick_s) for late_s in (0.0, 0.5, move_s)}
    gaps_m = {
        pair: _gaps_m(pair, max(ticks_late.values()))
        for pair in product(product(range(3), range(-2, 3)), displacements(2), displacements(2))
        if pair[0] > (0, 0)  # the others follow by exchanging the vehicles
    }
    return [
        {"conflicts": name}
        | {
            late: round(
                min(
                    float(gaps[len(gaps) // 2 - ticks : len(gaps) // 2 + ticks + 1].min())
                    for pair, gaps in gaps_m.items()
                    if not conflict(pair, *kinds)
                ),
                2,
            )
            for late, ticks in ticks_late.items()
        }
        for name, kinds in ALLOWING.items()
    ]


def _gaps_m(pair: Pair, max_late: int) -> NDArray[np.float64]:
    """Return the minimum gap (2 n + 1,) with B up to n ticks early or late."""
    scenario = Scenario()
    own, body = (scenario, scenario.vehicle), scenario.vehicle.size_m
    a, b = (
        np.pad(move_profile(*own, *step).states, ((max_late, max_late), (0, 0)), mode="edge")
        + cell_state(scenario.lattice, cell, 0.0)
        for cell, step in (((0, 0), pair[1]), (pair[0], pair[2]))
    )
    gaps = np.full(2 * max_late + 1, np.inf)
    for late in range(-max_late, max_late + 1):
        one, other = (a[late:], b[: len(b) - late]) if late > 0 else (a[: len(a) + late], b[-late:])
        near = np.abs(one[:, 3] - other[:, 3]) < sum(body) / 2.0
        for x, y in zip(one[near], other[near], strict=True):
            found = Bodies({"a": pose_of(x), "b": pose_of(y)}, *body).min_gaps().gap_m
            gaps[late + max_late] = min(gaps[late + max_late], found)
    return gaps


def main() -> None:
    """Measure, print rows, and write them to a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=OUT, help="output file")
    parser.add_argument(
        "--only", choices=["nearest"], help="measure only these gaps; keep the other results"
    )
    given = parser.parse_args()
    out: Path = given.json
    if given.only:
        results: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
    else:
        BRANCHING.load()
        results = {"table_ms": table_times_ms(), "results": []}
        for vehicles in VEHICLES:
            for row in measured(vehicles):
                results["results"].append(row)
                sys.stdout.write(json.dumps(row) + "\n")
    results["nearest_m"] = nearest()
    out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
