"""The command line `laneweave`.

Exit status: 0 done; 1 the run failed or a promise was broken; 2 bad input, with one line on stderr
that names the field, the value and what is allowed.
"""

from __future__ import annotations

import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from laneweave.launch.cli import certs_commands, config_commands
from laneweave.launch.cli.options import check_jobs, parse_seeds
from laneweave.launch.cli.role_commands import (
    SOLVER_NAMES,
    SolverOption,
    agent,
    bridge,
    check_pace,
    coordinator,
    ping,
    router,
    watch,
)
from laneweave.launch.cli.status_command import status
from laneweave.launch.cli.study_commands import report, sweep
from laneweave.launch.methods import FORMATION
from laneweave.launch.run.logs import log_to_terminal
from laneweave.launch.run.run_folder import draw_own, new_folder
from laneweave.protocol.config.loading import load_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError
from laneweave.protocol.scenario.tables import Scenario

if TYPE_CHECKING:
    from laneweave.launch.run.outcome import Outcome

app = typer.Typer(
    name="laneweave",
    help="Formation control with lane preference for connected and automated vehicles.",
    add_completion=False,
    pretty_exceptions_enable=False,
)

TYPER_INTERRUPTED = 130
"""What typer makes of Ctrl-C."""
MISSING_SIM = "the simulation packages: install laneweave[sim]"
MISSING_WATCH = "the web server: install laneweave[watch]"
MISSING = {
    "distributed": "Dask: install laneweave[dask]",
    "osqp": "the solver of agents: install laneweave[agent]",
    "cryptography": "what makes certificates: install laneweave[certs]",
    "prometheus_client": "the package for metrics: install laneweave[metrics]",
    "starlette": MISSING_WATCH,
    "uvicorn": MISSING_WATCH,
    "websockets": MISSING_WATCH,
}
"""What to install, by the package that is not there; else it is `MISSING_SIM`."""


class TransportChoice(StrEnum):
    """How the roles of a run talk to each other."""

    zenoh = "zenoh"
    simulated = "simulated"


class Method(StrEnum):
    """How vehicles are controlled."""

    formation = FORMATION
    rule = "rule"
    lc2013 = "lc2013"


class Operation(StrEnum):
    """How formation control runs a stream; `paper`: formations as in the paper's simulation."""

    formations = "formations"
    paper = "paper"
    rolling = "rolling"


class Benchmark(StrEnum):
    """What `laneweave bench` measures."""

    runtime = "runtime"
    planner = "planner"
    tracker = "tracker"


class OutputFormat(StrEnum):
    """How a plan is printed."""

    json = "json"
    table = "table"


@app.command()
def run(
    scenario: Annotated[
        Path | None, typer.Argument(metavar="[SCENARIO.toml]", help="Default: the paper's road.")
    ] = None,
    volume: Annotated[
        float | None, typer.Option("--volume", help="Vehicles per lane and hour.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of everything random.")] = None,
    duration: Annotated[
        float | None, typer.Option("--duration", help="Seconds during which vehicles arrive.")
    ] = None,
    method: Annotated[
        Method, typer.Option("--method", help="How vehicles are controlled.")
    ] = Method.formation,
    operation: Annotated[
        Operation | None,
        typer.Option("--operation", help="Default: formation.operation of the scenario."),
    ] = None,
    solver: SolverOption = None,
    vehicles_per_process: Annotated[
        int | None, typer.Option("--vehicles-per-process", help="Agents that share a process.")
    ] = None,
    coordinators: Annotated[
        int | None, typer.Option("--coordinators", help="Coordinator candidates.")
    ] = None,
    transport: Annotated[TransportChoice, typer.Option("--transport")] = TransportChoice.zenoh,
    faults: Annotated[
        str | None,
        typer.Option("--faults", metavar="FILE|PRESET", help="Faults to inject: docs/FAULTS.md."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Default: a new folder in runs/.")
    ] = None,
    pace: Annotated[
        float | None,
        typer.Option("--pace", help="Most road seconds per second; default: runtime.max_pace."),
    ] = None,
    no_progress: Annotated[bool, typer.Option("--no-progress", help="Show no bar.")] = False,
) -> None:
    """Run a scenario on this machine and write its folder."""
    settings = load_scenario(
        scenario,
        seed=seed,
        demand__volume_veh_per_lane_h=volume,
        demand__duration_s=duration,
        formation__operation=operation.value if operation is not None else None,
        formation__solver=solver,
        runtime__vehicles_per_process=vehicles_per_process,
        runtime__coordinators=coordinators,
    )
    check_pace(pace)
    if method is not Method.formation:
        for option, value in (
            ("--operation", operation),
            ("--solver", solver),
            ("--vehicles-per-process", vehicles_per_process),
            ("--coordinators", coordinators),
            ("--faults", faults),
        ):
            if value is not None:
                raise BadInputError(option, str(value), f"none with --method {method.value}")
    if solver is not None and settings.formation.rolling:
        raise BadInputError("--solver", solver, "none with the rolling operation")
    show = not no_progress and sys.stderr.isatty()
    if method is Method.formation:
        outcome = _run_formations(settings, out, transport, faults, pace, show=show)
    else:
        outcome = _run_reference(settings, out, method, show=show)

    from laneweave.launch.run.outcome import print_outcome

    print_outcome(outcome, Console())
    if outcome.summary is not None:
        draw_own(outcome.folder)
    raise typer.Exit(outcome.exit_status)


def _run_formations(
    settings: Scenario,
    out: Path | None,
    transport: TransportChoice,
    faults: str | None,
    pace: float | None,
    *,
    show: bool,
) -> Outcome:
    from laneweave.agents.driving.trajectory import check_moves
    from laneweave.launch.faults.specification import load_faults
    from laneweave.launch.run.local_run import LocalRun
    from laneweave.protocol.config.participants import coordinator_names
    from laneweave.sim_bridge.road.demand import arrivals

    check_moves(settings)
    vehicles = {arrival.vehicle for arrival in arrivals(settings)}
    plan_of_faults = load_faults(faults, coordinator_names(settings), vehicles)
    folder = new_folder(out, settings, FORMATION)
    if transport is TransportChoice.simulated:
        from laneweave.launch.run.garbage_collection import collect_seldom
        from laneweave.launch.run.simulated_run import SimulatedRun

        collect_seldom()
        return SimulatedRun(settings, folder, FORMATION, plan_of_faults, show_progress=show).run()
    return LocalRun(settings, folder, FORMATION, plan_of_faults, show, pace).run()


def _run_reference(settings: Scenario, out: Path | None, method: Method, *, show: bool) -> Outcome:
    from laneweave.launch.run.reference_run import ReferenceRun, check_reference

    check_reference(settings, method.value)
    folder = new_folder(out, settings, method.value)
    return ReferenceRun(settings, folder, method.value, show_progress=show).run()


@app.command()
def plan(
    request: Annotated[Path, typer.Argument(metavar="REQUEST.json", help="- reads stdin.")],
    deadline: Annotated[
        float | None, typer.Option("--deadline", help="Seconds; overrides the request's.")
    ] = None,
    connect: Annotated[
        str | None, typer.Option("--connect", metavar="ENDPOINT", help="Ask a coordinator there.")
    ] = None,
    realm: Annotated[
        str | None, typer.Option("--realm", help="Realm of that coordinator; default: default.")
    ] = None,
    wait: Annotated[
        float, typer.Option("--wait", help="Seconds to wait for a router and a coordinator there.")
    ] = 0.0,
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="DEPLOYMENT.toml", help="Ask a coordinator of it."),
    ] = None,
    client: Annotated[
        str | None,
        typer.Option(
            "--client", metavar="NAME", help="As whom, where it is secured; default: plan."
        ),
    ] = None,
    output: Annotated[OutputFormat, typer.Option("--format")] = OutputFormat.json,
    solver: Annotated[
        str | None,
        typer.Option(
            "--solver", metavar="NAME", help=f"{SOLVER_NAMES}; overrides the request's solver."
        ),
    ] = None,
    draw: Annotated[
        Path | None,
        typer.Option(
            "--draw", metavar="FILE", help="Draw the answer: FILE.png, or FILE.gif that moves."
        ),
    ] = None,
    draw_road: Annotated[
        Path | None,
        typer.Option(
            "--draw-road",
            metavar="FILE",
            help="Draw how vehicles drive it: FILE.png or FILE.gif; road and vehicles: --config.",
        ),
    ] = None,
    explained: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Print what TAPPA does: assignments and constraint trees (--draw too).",
        ),
    ] = False,
) -> None:
    """Plan one request here, or ask a running coordinator."""
    from laneweave.launch.cli.plan_command import access_for, answer_request, explain_request

    settings = load_scenario(config)
    # A file that names no router describes the road alone.
    only_road = draw_road is not None and not (connect or settings.network.endpoint)
    access = access_for(connect, realm, None if only_road else config, client)
    if explained:
        if access is not None:
            raise BadInputError("--explain", "set", "only without --connect and --config")
        if solver not in (None, "tappa"):
            raise BadInputError("--solver", solver, "tappa, for --explain")
        if draw_road is not None:
            raise BadInputError("--draw-road", str(draw_road), "only without --explain")
        explain_request(request, deadline, draw)
        return
    # What would have no effect is a mistake of whoever asks.
    if access is None and wait:
        raise BadInputError("--wait", wait, "only with --connect or --config")
    answer_request(
        request,
        deadline,
        access,
        solver,
        as_table=output is OutputFormat.table,
        drawing=draw,
        road_drawing=draw_road,
        scenario=settings,
        wait_s=wait,
    )


app.add_typer(certs_commands.app, name="certs")
app.add_typer(config_commands.app, name="config")
for command in (router, ping, coordinator, agent, bridge, watch, status, sweep, report):
    app.command()(command)


@app.command()
def simulate(
    seeds: Annotated[
        str, typer.Option("--seeds", metavar="A:B", help="Seeds to run; B is not included.")
    ] = "0:100",
    profile: Annotated[
        str,
        typer.Option(
            "--profile", metavar="NAME", help="What goes wrong; an unknown name lists them."
        ),
    ] = "mixed",
    jobs: Annotated[
        int | None, typer.Option("--jobs", metavar="N", help="Processes; default: all cores.")
    ] = None,
    digest: Annotated[
        bool, typer.Option("--digest", help="Print a digest of everything that was delivered.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Tell the story of the first failed seed, or of one.")
    ] = False,
    no_progress: Annotated[bool, typer.Option("--no-progress", help="Show no bar.")] = False,
) -> None:
    """Simulate runs with far more faults than ever occur, and check each of them."""
    from laneweave.launch.fault_search import profiles, search

    chosen = profiles.profile_named(profile)
    numbers, count = parse_seeds(seeds), check_jobs(jobs)
    search.quiet_logs()
    show = not no_progress and sys.stderr.isatty()
    result = search.search(numbers, chosen, count, digest=digest, show=show)
    if verbose and (result.failed or len(numbers) == 1):
        seed = result.failed[0].seed if result.failed else numbers[0]
        for line in search.tell_story(seed, chosen):
            typer.echo(line)
    if digest:
        typer.echo(f"digest {result.digest}")
    for line in search.describe(result, chosen):
        typer.echo(line)
    raise typer.Exit(1 if result.failed else 0)


@app.command()
def bench(
    what: Annotated[Benchmark, typer.Argument(help="runtime, planner or tracker.")],
    vehicles: Annotated[
        str | None,
        typer.Option("--vehicles", help="Numbers with commas between; see below for defaults."),
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
    from laneweave.launch.cli import bench_command

    if what is Benchmark.planner:
        report = bench_command.measure_planner(
            vehicles, families, instances, seed, deadline, solver
        )
    elif what is Benchmark.tracker:
        report = bench_command.measure_tracker(instances, seed)
    else:
        report = bench_command.measure_runtime(vehicles, seconds, per_process, seed)
    report.show(as_json=as_json)


def main() -> None:
    """Run the command line with the arguments of this process."""
    # As Ctrl-C: files are completed and temporary folders removed. Roles have their own way.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(_status(sys.argv[1:]))


def _status(arguments: list[str]) -> int:
    log_to_terminal()
    command = typer.main.get_command(app)
    try:
        result: Any = command.main(
            arguments or ["--help"], prog_name="laneweave", standalone_mode=False
        )
    except (BadInputError, RefusedError) as error:
        return _refuse(str(error))
    except (typer.Abort, KeyboardInterrupt):
        sys.stderr.write("interrupted\n")
        return 1
    except typer.TyperException as error:
        # Unknown options and arguments; the library's own report takes several lines.
        return _refuse(getattr(error, "format_message", error.__str__)())
    except BrokenPipeError:
        return 1
    except CommandFailedError as error:
        sys.stderr.write(" ".join(str(error).split()) + "\n")
        return 1
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("laneweave"):
            raise
        missing = MISSING.get((error.name or "").partition(".")[0], MISSING_SIM)
        return _refuse(f"{error.name}: not installed; allowed: {missing}")
    if result == TYPER_INTERRUPTED:
        sys.stderr.write("interrupted\n")
        return 1
    return result if isinstance(result, int) else 0


def _refuse(line: str) -> int:
    sys.stderr.write(" ".join(line.split()) + "\n")
    return 2
