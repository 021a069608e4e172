"""`laneweave run`: run a scenario on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from laneweave.launch.cli.corridor_command import CORRIDOR_HELP, Begin, End, Scale
from laneweave.launch.cli.options import (
    Duration,
    NoProgress,
    RunFolder,
    ScenarioArgument,
    Solver,
    reject_unused_options,
    shows_progress,
)
from laneweave.launch.run_methods import FORMATION, LC2013, RULE, SUMO_HAS_DEMAND, checked_method
from laneweave.protocol.config.scenario_files import load_scenario, scenario_of
from laneweave.protocol.errors import NO_VALUE, BadInputError
from laneweave.protocol.scenario.deployment_fields import check_pace
from laneweave.protocol.scenario.fields import Scenario

if TYPE_CHECKING:
    from laneweave.launch.run.live_page import LivePage
    from laneweave.launch.run.outcome import Outcome


RECORDED_ONLY = "it runs faster than real time; `laneweave watch DIR` shows its recording"
COMPARED_ROUTES = 4
"""Number of pairs of entrance and destination whose trips are printed."""


class Transport(StrEnum):
    """Network between the roles of a run."""

    zenoh = "zenoh"
    simulated = "simulated"


class Operation(StrEnum):
    """Operation of formation control; `paper`: formations as in the paper's simulation."""

    formations = "formations"
    paper = "paper"
    rolling = "rolling"


def run(
    scenario: ScenarioArgument = None,
    volume: Annotated[
        float | None, typer.Option("--volume", help="Vehicles per lane per hour.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of all random draws.")] = None,
    duration: Duration = None,
    method: Annotated[
        str,
        typer.Option(
            "--method", metavar="NAME", help=f"{FORMATION}, {RULE}, {LC2013}, or a plug-in."
        ),
    ] = FORMATION,
    operation: Annotated[
        Operation | None,
        typer.Option("--operation", help="Default: formation.operation of the scenario."),
    ] = None,
    solver: Solver = None,
    vehicles_per_process: Annotated[
        int | None, typer.Option("--vehicles-per-process", help="Number of agents per process.")
    ] = None,
    coordinators: Annotated[
        int | None, typer.Option("--coordinators", help="Number of coordinators.")
    ] = None,
    transport: Annotated[
        Transport | None,
        typer.Option("--transport", help="Default: zenoh; simulated: virtual time, reproducible."),
    ] = None,
    faults: Annotated[
        str | None,
        typer.Option("--faults", metavar="FILE|PRESET", help="Faults to inject: docs/FAULTS.md."),
    ] = None,
    sumocfg: Annotated[
        Path | None,
        typer.Option("--sumocfg", help="SUMO simulation of which laneweave drives a corridor."),
    ] = None,
    corridor: Annotated[
        str | None,
        typer.Option("--corridor", metavar="FIRST_EDGE:LAST_EDGE", help=CORRIDOR_HELP),
    ] = None,
    begin: Begin = None,
    end: End = None,
    scale: Scale = None,
    compare: Annotated[
        bool,
        typer.Option("--compare", help="Also let SUMO drive alone, and compare (with --sumocfg)."),
    ] = False,
    gui: Annotated[
        bool, typer.Option("--gui", help="Show the run in sumo-gui (extra: gui).")
    ] = False,
    out: RunFolder = None,
    pace: Annotated[
        float | None,
        typer.Option("--pace", help="Mean road seconds per second; default: runtime.max_pace."),
    ] = None,
    endpoint: Annotated[
        str | None,
        typer.Option("--endpoint", help="Endpoint of the router; default: network.endpoint."),
    ] = None,
    watch: Annotated[
        bool,
        typer.Option(
            "--watch",
            help="Serve a page that shows the road during the run, in real time without --pace.",
        ),
    ] = False,
    watch_listen: Annotated[
        str | None,
        typer.Option(
            "--watch-listen",
            metavar="HOST:PORT",
            help="Address of this page; implies --watch. Default: 127.0.0.1:8080 or a free port.",
        ),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Draw the figures and report.html.")
    ] = True,
    no_progress: NoProgress = False,
) -> None:
    """Run a scenario on this machine, and write the results to a folder."""
    window = {"begin_s": begin, "end_s": end, "scale": scale}
    tables = corridor_scenario(scenario, sumocfg, corridor, seed, duration, **window)
    if tables:
        reject_unused_options("with --sumocfg", operation=operation, solver=solver)
    else:
        reject_unused_options("without --sumocfg", begin=begin, end=end, scale=scale)
    overrides = {
        "seed": seed,
        "demand__volume_veh_per_lane_h": volume,
        "demand__duration_s": None if tables else duration,
        "formation__operation": operation.value if operation is not None else None,
        "formation__solver": solver,
        "runtime__vehicles_per_process": vehicles_per_process,
        "runtime__coordinators": coordinators,
        "network__endpoint": endpoint,
        "sumo__gui": gui or None,
    }
    settings = scenario_of(tables, **overrides) if tables else load_scenario(scenario, **overrides)
    _check_sumo_options(settings, volume, compare=compare)
    check_pace(pace, "--pace")
    show = shows_progress(no_progress)
    checked_method(method, "--method")
    live = {"watch": "given" if watch else None, "watch_listen": watch_listen}
    if method == FORMATION:
        if settings.formation.planner != settings.formation.solver:
            reject_unused_options("with the rolling operation", solver=solver)
        if transport is Transport.simulated:
            reject_unused_options("with --transport simulated", pace=pace, endpoint=endpoint)
            reject_unused_options(f"with --transport simulated: {RECORDED_ONLY}", **live)
    else:
        allowed = "formation with a SUMO simulation; --compare adds SUMO alone"
        if settings.sumo.config:
            raise BadInputError("--method", method, allowed)
        reject_unused_options(
            f"with --method {method}",
            operation=operation,
            solver=solver,
            vehicles_per_process=vehicles_per_process,
            coordinators=coordinators,
            faults=faults,
            pace=pace,
            transport=transport,
            gui=gui or None,
            endpoint=endpoint,
        )
        reject_unused_options(f"with --method {method}: {RECORDED_ONLY}", **live)
    from laneweave.launch.library.runs import perform_run

    shown = watch or watch_listen is not None
    # A run with a live page needs no second one.
    hint = None if tables or shown else _watch_command(scenario)

    def announce(endpoint: str) -> None:
        more = "" if hint is None else f" ({hint} --endpoint {endpoint})"
        warn(f"endpoint: {endpoint}{more}")

    def warn(line: str) -> None:
        typer.echo(line, err=True)

    if shown and pace is None:
        pace = min(1.0, settings.runtime.max_pace)
    with _live_page(watch_listen, shown=shown) as page:
        with _faults_as_option():
            outcome = perform_run(
                settings,
                out=out,
                method=method,
                transport=None if transport is None else transport.value,
                faults=faults,
                pace=pace,
                show_progress=show,
                announce=announce,
                warn=warn,
                start_page=None if page is None else page.start,
            )
        drawn = _finish(outcome, report=report)
        if page is not None:
            page.end(f"{outcome.ending}, report at {drawn}" if drawn else outcome.ending)
    if compare and outcome.summary is not None and outcome.summary.ending == "complete":
        _compare(settings, outcome.folder, show=show)
    raise typer.Exit(outcome.exit_status)


@contextmanager
def _faults_as_option() -> Iterator[None]:
    """Name the option in errors about the argument `faults` of the library."""
    try:
        yield
    except BadInputError as error:
        if error.field != "faults":
            raise
        raise error.of("--faults") from error


def _check_sumo_options(settings: Scenario, volume: float | None, *, compare: bool) -> None:
    """Check options that need a SUMO simulation or its window, or have no effect on one.

    Raises:
        BadInputError: an option would be ignored.
        CommandFailedError: there is no screen for the window.
    """
    if settings.sumo.gui:
        from laneweave.sim_bridge.sumo.simulation import check_screen

        check_screen()
    if volume is not None and settings.sumo.config:
        raise BadInputError("--volume", volume, SUMO_HAS_DEMAND)
    if compare and not settings.sumo.config:
        raise BadInputError("--compare", "given", "none without a SUMO simulation (--sumocfg)")


def _finish(outcome: Outcome, *, report: bool) -> Path | None:
    """Print the outcome of a run and draw its report; return the path of the page, if any."""
    from laneweave.launch.run.outcome import print_outcome

    print_outcome(outcome, Console())
    if not report or not outcome.has_traffic:
        return None
    from laneweave.launch.report.report import draw_report

    try:
        return draw_report(outcome.folder)
    except KeyboardInterrupt:
        if outcome.interrupted:
            return None  # already reported
        raise


@contextmanager
def _live_page(listen: str | None, *, shown: bool) -> Iterator[LivePage | None]:
    """Yield the live page of a run and print its address; None if it is not wanted."""
    if not shown:
        yield None
        return
    from laneweave.launch.run.live_page import LivePage

    with LivePage.open(listen) as page:
        typer.echo(f"live page: {page.address}", err=True)
        yield page


def _watch_command(scenario: Path | None) -> str:
    """Return the command that shows the road of this run, but for the endpoint."""
    return "laneweave watch" + ("" if scenario is None else f" --config {scenario}")


def _compare(settings: Scenario, folder: Path, *, show: bool) -> None:
    """Let SUMO drive alone, and print how long trips take with both."""
    from rich.progress import Progress

    from laneweave.launch.report.corridor_comparison import PAGE_FILE, compare

    with Progress(console=Console(stderr=True), disable=not show) as bar:
        task = bar.add_task("SUMO alone", total=1.0)
        routes = compare(settings, folder, lambda share: bar.update(task, completed=share))
    for one in routes[:COMPARED_ROUTES]:
        own, alone = (
            f"{count} of {one.vehicles}"
            + ("" if mean is None else f" in {mean:.1f} s")
            + (f", {wrong} arrived elsewhere," if wrong else "")
            for mean, count, wrong in zip(one.mean_s, one.arrived, one.elsewhere, strict=True)
        )
        typer.echo(f"{one.entrance} to {one.destination}: {own} with laneweave, {alone} with SUMO")
    typer.echo(f"comparison: {folder / PAGE_FILE}")


def corridor_scenario(
    scenario: Path | None,
    sumocfg: Path | None,
    corridor: str | None,
    seed: int | None,
    duration_s: float | None,
    **window: float | None,
) -> dict[str, Any]:
    """Return the tables of the scenario of a corridor; none if it is not given by options.

    Raises:
        BadInputError: an option is missing, or there is no such corridor.
    """
    if sumocfg is None and corridor is None:
        return {}
    if sumocfg is None or corridor is None:
        missing = "--sumocfg" if sumocfg is None else "--corridor"
        raise BadInputError(missing, NO_VALUE, "both --sumocfg and --corridor, or none")
    if scenario is not None:
        allowed = "none with --sumocfg: table sumo of the file names the simulation"
        raise BadInputError("SCENARIO.toml", str(scenario), allowed)
    from laneweave.launch.cli.corridor_command import corridor_tables, time_window
    from laneweave.sim_bridge.corridors.scenario_tables import remarks
    from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor

    departures = time_window(**window, duration_s=duration_s)
    own_seed = Scenario().seed if seed is None else seed
    found = read_corridor(sumocfg, corridor, departures, own_seed)
    tables = corridor_tables(found, sumocfg, departures)
    for remark in remarks(found, tables):
        typer.echo(remark, err=True)
    return tables
