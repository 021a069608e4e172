"""`laneweave bench`: benchmarks of this machine."""

from __future__ import annotations

import json
import re
from enum import StrEnum
from typing import Annotated, Any

import typer
from rich.console import Console

from laneweave.launch.cli.options import SOLVER_NAMES
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError, unknown_name


class Benchmark(StrEnum):
    """What a benchmark measures."""

    runtime = "runtime"
    planner = "planner"
    tracker = "tracker"


def bench(
    what: Annotated[Benchmark, typer.Argument(help="runtime, planner or tracker.")],
    vehicles: Annotated[
        str | None,
        typer.Option("--vehicles", help="Comma-separated vehicle counts; defaults: see above."),
    ] = None,
    per_process: Annotated[
        int, typer.Option("--vehicles-per-process", min=1, help="runtime: agents per process.")
    ] = 1,
    seconds: Annotated[
        float, typer.Option("--seconds", min=5.0, max=3600.0, help="runtime: measured road time.")
    ] = 60.0,
    faults: Annotated[
        str | None,
        typer.Option(
            "--faults", metavar="FILE|PRESET", help="runtime: faults to inject: docs/FAULTS.md."
        ),
    ] = None,
    families: Annotated[
        str,
        typer.Option(
            "--families", help="planner: some of node-edge, following, geometric, block, traffic."
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
        str, typer.Option("--solver", metavar="NAME", help=f"planner: {SOLVER_NAMES}.")
    ] = "branching",
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Benchmark runs with 30, 60 and 90 vehicles, plans for 6 to 36 vehicles, or the tracker."""
    from laneweave.coordinator.planning.plug_ins.registry import check_solver
    from laneweave.launch.bench.planner import FAMILIES, bench_planner, planner_table
    from laneweave.launch.bench.runtime import bench_runtime, machine, runtime_table
    from laneweave.launch.bench.tracker import bench_tracker, tracker_table

    if what is Benchmark.planner:
        check_solver(solver, "--solver")
        sizes, chosen = _parse_sizes(vehicles, "6,9,12,18,24,36"), families.split(",")
        for family in chosen:
            if family not in FAMILIES:
                allowed = f"some of {', '.join(FAMILIES)}, separated by commas"
                raise unknown_name("--families", family, FAMILIES, allowed)
        found = bench_planner(
            sizes, chosen, instances=instances, seed=seed, deadline_s=deadline, solver=solver
        )
        make_table = planner_table
    elif what is Benchmark.tracker:
        found = iter(bench_tracker(load_scenario(None), instances=instances, seed=seed))
        make_table = tracker_table
    else:
        sizes = _parse_sizes(vehicles, "30,60,90")
        found = (
            bench_runtime(size, seconds=seconds, per_process=per_process, seed=seed, faults=faults)
            for size in sizes
        )
        make_table = runtime_table
    rows: list[dict[str, Any]] = []
    failure: CommandFailedError | None = None
    try:
        rows.extend(found)
    except CommandFailedError as error:
        if not rows:
            raise
        failure = error  # what has been measured is printed
    if as_json:
        result = {"benchmark": what.value, "machine": machine(), "results": rows}
        typer.echo(json.dumps(result, indent=2))
    else:
        Console().print(make_table(rows))
    if failure is not None:
        raise failure


def _parse_sizes(text: str | None, default: str) -> list[int]:
    sizes = (default if text is None else text).split(",")
    if not all(re.fullmatch(r"[1-9][0-9]?|1[0-9][0-9]|200", size) for size in sizes):
        raise BadInputError("--vehicles", text, "numbers from 1 to 200, separated by commas")
    return [int(size) for size in sizes]
