"""`laneweave sweep`: make many runs; `report`: report them; `repair`: complete killed ones."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from laneweave.launch.cli.options import (
    ContinuedFolder,
    Duration,
    Jobs,
    ScenarioArgument,
    Seeds,
    check_jobs,
    parse_seeds,
)
from laneweave.launch.drawing.figures import FigureFormat
from laneweave.launch.run.run_folder import repair_run, timestamped_folder
from laneweave.launch.run_methods import METHODS, KeepTrajectories
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError

VOLUMES = "1000,1150,1300,1450,1600"
"""The paper's volumes (Section 5.2.3), in vehicles/(lane h)."""


def sweep(
    scenario: ScenarioArgument = None,
    methods: Annotated[
        str,
        typer.Option(
            "--methods", metavar="LIST", help=f"Some of {', '.join(METHODS)}, and plug-ins."
        ),
    ] = "formation",
    volumes: Annotated[
        str | None,
        typer.Option(
            "--volumes",
            metavar="LIST",
            help=f"Vehicles per lane per hour. Default: {VOLUMES}; none on a corridor of SUMO.",
        ),
    ] = None,
    seeds: Seeds = "1:4",
    duration: Duration = None,
    jobs: Jobs = None,
    out: ContinuedFolder = None,
    keep_trajectories: Annotated[
        KeepTrajectories, typer.Option("--keep-trajectories", help="Runs to keep them for.")
    ] = KeepTrajectories.first_seed,
    dask: Annotated[
        str | None,
        typer.Option(
            "--dask", metavar="ADDRESS", help="Run on the Dask cluster of this scheduler."
        ),
    ] = None,
    no_progress: Annotated[bool, typer.Option("--no-progress", help="Show no progress.")] = False,
) -> None:
    """Run methods x volumes x seeds in parallel, in virtual time; skip finished runs."""
    from laneweave.launch.run_methods import parse_methods
    from laneweave.launch.sweep.execution import run_locally
    from laneweave.launch.sweep.folder import SweepFolder
    from laneweave.launch.sweep.points import plan_points, sweep_volumes
    from laneweave.launch.sweep.sweep import Runner, print_results, run_sweep
    from laneweave.sim_bridge.recording.trips import WARM_UP_S

    base = load_scenario(scenario, demand__duration_s=duration)
    points = plan_points(
        base,
        parse_methods(methods),
        sweep_volumes(volumes, base, VOLUMES),
        parse_seeds(seeds),
        keep_trajectories,
    )
    run: Runner
    if dask is None:
        run = partial(run_locally, workers=check_jobs(jobs))
    else:
        if jobs is not None:
            raise BadInputError("--jobs", jobs, "only without --dask")
        from laneweave.launch.sweep.dask_workers import run_on_dask

        run = partial(run_on_dask, address=dask)
    with SweepFolder(out or timestamped_folder("sweep")) as folder:
        folder.check_settings(base)
        if base.demand.duration_s <= WARM_UP_S:
            warning = f"{base.demand.duration_s:g} s of arrivals give no travel times"
            typer.echo(f"{warning}, which leave out the first {WARM_UP_S:g} s", err=True)
        failed = run_sweep(points, folder, run, show=not no_progress)
        print_results(points, folder, Console())
    sys.stdout.flush()
    raise typer.Exit(1 if failed else 0)


def report(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of runs and sweeps.")
    ],
    formation: Annotated[
        int | None,
        typer.Option(
            "--formation",
            metavar="N",
            help="Formation whose path map is drawn; default: the one with the most moves.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder for a comparison; default: a new one in runs/.",
        ),
    ] = None,
    figures: Annotated[
        FigureFormat,
        typer.Option("--figures", help="Format of figures; SVG and PDF: beside those of the page."),
    ] = FigureFormat.PNG,
) -> None:
    """Write figures and a page for each finished run, and for a sweep or several runs together.

    Runs of a method are averaged if they differ only in volume and seed.
    """
    from laneweave.launch.recordings.runs import Comparison, is_sweep, runs_of, single_run
    from laneweave.launch.report.report import REPORT_DPI, report_comparison, report_run

    if out is not None and len(folders) == 1:
        raise BadInputError("--out", str(out), "only with several folders")
    runs = list(runs_of(folders))
    try:
        for folder in folders:
            if not is_sweep(folder):
                page = report_run(
                    single_run(folder),
                    formation=formation,
                    dpi=REPORT_DPI,
                    file_format=figures,
                )
                typer.echo(f"{page}: written")
        if len(folders) > 1 or is_sweep(folders[0]):
            if len(folders) == 1:
                out = folders[0]
            place = out or timestamped_folder("report")
            title = "laneweave: " + ", ".join(folder.resolve().name for folder in folders)
            page = report_comparison(
                Comparison.of(runs),
                place,
                title,
                formation=formation,
                file_format=figures,
            )
            typer.echo(f"{page}: written")
    except OSError as error:
        raise CommandFailedError(f"the report cannot be written: {error}") from error


def repair(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of runs.", show_default=False)
    ],
) -> None:
    """Complete the files of runs whose process was killed.

    Everything until a few seconds before remains: the summary of that time, which then says
    `interrupted`, and the rows of all files.
    """
    for folder in folders:
        summary = repair_run(folder)
        typer.echo(f"{folder}: complete until {summary.simulated_s:g} s of road time")
