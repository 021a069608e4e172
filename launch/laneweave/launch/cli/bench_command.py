"""`laneweave bench`: benchmarks of this machine."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from laneweave.launch.cli.options import SOLVER_NAMES


class Benchmark(StrEnum):
    """Subject of a benchmark."""

    runtime = "runtime"
    planner = "planner"
    tracker = "tracker"


def bench(
    what: Annotated[Benchmark, typer.Argument(help="runtime, planner or tracker.")],
    vehicles: Annotated[
        str | None,
        typer.Option("--vehicles", help="Comma-separated numbers; see above for the defaults."),
    ] = None,
    per_process: Annotated[
        int, typer.Option("--vehicles-per-process", min=1, help="runtime: agents per process.")
    ] = 1,
    seconds: Annotated[
        float, typer.Option("--seconds", min=5.0, max=3600.0, help="runtime: road time measured.")
    ] = 60.0,
    families: Annotated[
        str,
        typer.Option(
            "--families", help="planner: of node-edge, following, geometric, block, traffic."
        ),
    ] = "node-edge,following,geometric",
    instances: Annotated[
        int,
        typer.Option(
            "--instances",
            min=1,
            max=10_000,
            help="planner: per formation size; tracker: episodes per situation.",
        ),
    ] = 20,
    deadline: Annotated[
        float, typer.Option("--deadline", min=0.01, max=3600.0, help="planner: s per instance.")
    ] = 4.0,
    solver: Annotated[
        str, typer.Option("--solver", metavar="NAME", help=f"planner: {SOLVER_NAMES}, alone.")
    ] = "branching",
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure this machine: roads of 30, 60 and 90 vehicles, plans for 6 to 36, or tracking."""
    from laneweave.launch.bench import measurements

    if what is Benchmark.planner:
        report = measurements.measure_planner(vehicles, families, instances, seed, deadline, solver)
    elif what is Benchmark.tracker:
        report = measurements.measure_tracker(instances, seed)
    else:
        report = measurements.measure_runtime(vehicles, seconds, per_process, seed)
    report.show(as_json=as_json)
