"""Measure the delay after the deadline and the memory of plans for difficult requests.

    python benchmarks/hostile_requests.py [--solver NAME ...] [--instances N] [--seed N]
                                          [--json FILE]

Random grids with 2 to 60 vehicles: crowded, divided by obstacles, nearly full, with hundreds of
columns, or a single lane with one alcove; both motion modes, several sets of conflict kinds, one
target per vehicle or shared targets, deadlines of 0.2 to 4 s. Each request is planned in a new
process with compiled code loaded. The delay is wall time; memory is the peak of the process.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable
from itertools import product
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rich.progress import track

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.formation_table import BASE_CONFLICTS

OUT = Path(__file__).resolve().parents[1] / "docs" / "evidence" / "hostile-requests.json"
DEADLINES_S = (0.2, 0.5, 1.0, 2.0, 4.0)
CONFLICTS = {
    1: (("node", "edge"), BASE_CONFLICTS, (*BASE_CONFLICTS, "closing"), ("edge",)),
    2: (("geometric",), ("node", "edge"), ("geometric", "closing")),
}  # fmt: skip
MAX_VEHICLES, LIMIT_S = 60, 60.0


def crowded(rng: random.Random) -> tuple[Grid, int]:
    """Return a grid and a number of vehicles that leaves few empty cells."""
    grid = Grid(rng.randint(2, 12), rng.randint(2, 8))
    cells = grid.columns * grid.lanes
    return grid, min(MAX_VEHICLES, cells - rng.randint(1, max(1, cells // 4)))


def obstacles(rng: random.Random) -> tuple[Grid, int]:
    """Return a grid with obstacles, which may divide it, and a number of vehicles."""
    columns, lanes = rng.randint(3, 20), rng.randint(2, 8)
    cells = [*product(range(columns), range(lanes))]
    blocked = rng.sample(cells, int(len(cells) * rng.uniform(0.1, 0.5)))
    free = len(cells) - len(blocked)
    return Grid(columns, lanes, tuple(sorted(blocked))), rng.randint(2, min(MAX_VEHICLES, free))


def long_board(rng: random.Random) -> tuple[Grid, int]:
    """Return a grid with hundreds of columns, and a number of vehicles."""
    return Grid(rng.randint(100, 1000), rng.randint(1, 16)), rng.randint(2, MAX_VEHICLES)


def alcove(rng: random.Random) -> tuple[Grid, int]:
    """Return a single lane with one alcove beside it, and a number of vehicles."""
    columns = rng.randint(3, 12)
    place = rng.randrange(columns)
    blocked = tuple((column, 1) for column in range(columns) if column != place)
    return Grid(columns, 2, blocked), rng.randint(2, columns - 1)


def board(rng: random.Random) -> tuple[Grid, int]:
    """Return a grid of medium size, and a number of vehicles."""
    grid = Grid(rng.randint(4, 40), rng.randint(2, 8))
    return grid, rng.randint(2, min(MAX_VEHICLES, grid.columns * grid.lanes - 1))


FAMILIES: dict[str, Callable[[random.Random], tuple[Grid, int]]] = {
    "crowded": crowded,
    "obstacles": obstacles,
    "long": long_board,
    "alcove": alcove,
    "board": board,
}


def hostile_request(seed: int) -> tuple[str, PlanRequest]:
    """Return a random request and the name of its family."""
    rng = random.Random(seed)  # noqa: S311
    family = list(FAMILIES)[seed % len(FAMILIES)]
    grid, vehicles = FAMILIES[family](rng)
    free: list[Cell] = [*filter(grid.is_free, product(range(grid.columns), range(grid.lanes)))]
    starts = rng.sample(free, vehicles)
    targets = rng.sample(free, min(len(free), 400, vehicles + rng.choice((0, 0, vehicles))))
    kind = rng.choice(("own", "any", "half"))
    half = len(targets) // 2
    choices: dict[str, list[tuple[int, ...] | None]] = {
        "own": [(number,) for number in range(vehicles)],
        "any": [None] * vehicles,
        "half": [
            tuple(range(half) if number < half else range(half, len(targets)))
            for number in range(vehicles)
        ],
    }
    mode = rng.choice((1, 2))
    return family, PlanRequest(
        grid,
        1 if mode == 1 else 2,
        rng.choice(CONFLICTS[mode]),
        tuple(
            VehicleRequest(f"v{number}", start, eligible=each)
            for number, (start, each) in enumerate(zip(starts, choices[kind], strict=True))
        ),
        tuple(targets),
        rng.choice(DEADLINES_S),
    )


def answer(seed: int, solver: str | None, result: Connection) -> None:
    """Plan the request of a seed, and send the measurements."""
    family, request = hostile_request(seed)
    began_s = time.monotonic()
    response = plan(request, solver=solver)
    late_s = time.monotonic() - began_s - request.deadline_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    result.send(
        {
            "seed": seed,
            "family": family,
            "vehicles": len(request.vehicles),
            "deadline_s": request.deadline_s,
            "status": response.status,
            "cost": response.cost,
            "lower_bound": response.lower_bound,
            "solver": response.solver,
            "late_s": round(late_s, 3),
            "peak_mb": round(peak_mb),
        }
    )


def answered(seed: int, solver: str | None) -> dict[str, Any]:
    """Run `answer` in a new process; return its measurements, or how the process ended."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=answer, args=(seed, solver, sender))
    process.start()
    sender.close()
    try:
        found: dict[str, Any] = receiver.recv() if receiver.poll(LIMIT_S) else {"status": "hangs"}
    except EOFError:
        found = {"status": "error"}
    process.kill()
    process.join()
    return {"seed": seed, **found}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the number of requests by status, the longest delay and the largest peak memory."""
    timed = [row for row in rows if "late_s" in row]
    return {
        "requests": len(rows),
        "status": dict(Counter(row["status"] for row in rows)),
        "late_s": max(0.0, *(row["late_s"] for row in timed)),
        "peak_mb": max(row["peak_mb"] for row in timed),
    }


def main() -> int:
    """Measure; return 1 if a process failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--solver", nargs="*", default=["default"], help="solvers; `default`: none")
    parser.add_argument("--instances", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=OUT)
    options = parser.parse_args()
    BRANCHING.load()
    results = {}
    seeds = range(options.seed, options.seed + options.instances)
    for solver in options.solver:
        name = None if solver == "default" else solver
        rows = [answered(seed, name) for seed in track(seeds, solver, console=None)]
        results[solver] = {**summary(rows), "rows": rows}
        print(solver, summary(rows))  # noqa: T201
    options.json.write_text(json.dumps(results, indent=1) + "\n")
    failed = {"error", "hangs"}
    return int(any(row["status"] in failed for one in results.values() for row in one["rows"]))


if __name__ == "__main__":
    sys.exit(main())
