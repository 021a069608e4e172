"""The measurements of `laneweave bench` and their output."""

from __future__ import annotations

import json
import re
import sys
from typing import Any

from attrs import frozen
from rich.console import Console
from rich.table import Table

from laneweave.coordinator.planning.request import checked_solver
from laneweave.launch.bench import planner as planner_bench
from laneweave.launch.bench import tracker as tracker_bench
from laneweave.launch.bench.runtime import bench_runtime, machine, runtime_table
from laneweave.protocol.config.loading import load_scenario
from laneweave.protocol.errors import BadInputError

_PLANNER_SIZES, _RUNTIME_SIZES = "6,9,12,18,24,36", "30,60,90"


@frozen
class Report:
    """What a benchmark measured."""

    benchmark: str
    rows: list[dict[str, Any]]
    table: Table

    def show(self, *, as_json: bool) -> None:
        """Print it."""
        if as_json:
            result = {"benchmark": self.benchmark, "machine": machine(), "results": self.rows}
            sys.stdout.write(json.dumps(result, indent=2) + "\n")
        else:
            Console().print(self.table)


def measure_planner(
    vehicles: str | None,
    families: str,
    instances: int,
    seed: int,
    deadline_s: float,
    solver: str,
) -> Report:
    """Measure plans for formations of some families and numbers of vehicles.

    Raises:
        BadInputError: a family, a number or a solver is not known.
    """
    checked_solver(solver, "--solver")
    sizes = _counts(_PLANNER_SIZES if vehicles is None else vehicles)
    chosen = families.split(",")
    if not set(chosen) <= set(planner_bench.FAMILIES):
        known = ", ".join(planner_bench.FAMILIES)
        raise BadInputError("--families", families, f"some of {known}, with commas between")
    rows = list(
        planner_bench.bench_planner(
            sizes, chosen, instances=instances, seed=seed, deadline_s=deadline_s, solver=solver
        )
    )
    return Report("planner", rows, planner_bench.planner_table(rows))


def measure_runtime(vehicles: str | None, seconds: float, per_process: int, seed: int) -> Report:
    """Measure roads with some numbers of vehicles.

    Raises:
        BadInputError: a number is not known.
    """
    rows = [
        bench_runtime(count, seconds=seconds, per_process=per_process, seed=seed)
        for count in _counts(_RUNTIME_SIZES if vehicles is None else vehicles)
    ]
    return Report("runtime", rows, runtime_table(rows))


def measure_tracker(instances: int, seed: int) -> Report:
    """Measure a tick of tracking, on `instances` recorded episodes of each situation."""
    rows = tracker_bench.bench_tracker(load_scenario(None), instances=instances, seed=seed)
    return Report("tracker", rows, tracker_bench.tracker_table(rows))


def _counts(text: str) -> list[int]:
    counts = text.split(",")
    if not all(re.fullmatch(r"[1-9][0-9]?|1[0-9][0-9]|200", count) for count in counts):
        raise BadInputError("--vehicles", text, "numbers from 1 to 200 with commas between")
    return [int(count) for count in counts]
