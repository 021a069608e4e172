"""The commands that run one role each: `router`, `ping`, `coordinator`, `agent`, `bridge`, `watch`.

Each imports what it needs when it runs: an agent starts without SUMO, a coordinator without OSQP.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import structlog
import typer
from rich.console import Console

from laneweave.launch.deploy.deployments import load_deployment
from laneweave.launch.methods import FORMATION
from laneweave.launch.run.logs import LogFormat, LogLevel, log_role
from laneweave.launch.run.run_folder import draw_own, new_folder
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import Observe, unobserved
from laneweave.protocol.scenario.tables import SOLVERS, Scenario
from laneweave.protocol.security.rights import access_of

log = structlog.get_logger(__name__)

ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="DEPLOYMENT.toml", help="Scenario and network.")
]
RealmEndpoint = Annotated[
    str | None, typer.Option("--endpoint", help="Zenoh endpoint; overrides the configuration.")
]
MetricsOption = Annotated[
    str | None,
    typer.Option(
        "--metrics",
        metavar="HOST:PORT",
        help="Show metrics over HTTP there; overrides the configuration.",
    ),
]
SOLVER_NAMES = " or ".join(SOLVERS)
SolverOption = Annotated[
    str | None,
    typer.Option("--solver", metavar="NAME", help=f"{SOLVER_NAMES}; default: formation.solver."),
]
LogOption = Annotated[
    LogFormat, typer.Option("--log", envvar="LANEWEAVE_LOG", help="How to log to stderr.")
]
LevelOption = Annotated[
    LogLevel | None,
    typer.Option(
        "--log-level",
        envvar="LANEWEAVE_LOG_LEVEL",
        help="What to log; default: warning as text, info as JSON.",
    ),
]


def router(
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    metrics: MetricsOption = None,
    log_format: LogOption = LogFormat.text,
    log_level: LevelOption = None,
) -> None:
    """Run the Zenoh router of a deployment."""
    from laneweave.protocol.security.rights import guard_of
    from laneweave.protocol.transports.zenoh.transport import run_router

    settings = load_deployment(config, endpoint, observation__metrics=metrics)
    network, guard = settings.network, guard_of(settings)
    with _as_role("router", "router", settings, log_format, log_level) as observe:
        run_router(
            network.listens_at,
            network.lease_s,
            told_by="network.listen" if network.listen else "network.endpoint",
            guard=guard,
            observe=observe,
        )


def ping(config: ConfigOption = None, endpoint: RealmEndpoint = None) -> None:
    """Open a session at a router and close it: the health check of a deployment."""
    from laneweave.protocol.transports.zenoh.transport import ZenohTransport

    access = access_of(load_deployment(config, endpoint), "observer.ping")
    ZenohTransport(access, lambda _: None).close()


def coordinator(
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    name: Annotated[str, typer.Option("--name", help="Rank: the lowest name leads.")] = "c1",
    solver: SolverOption = None,
    metrics: MetricsOption = None,
    log_format: LogOption = LogFormat.text,
    log_level: LevelOption = None,
) -> None:
    """Run a coordinator candidate; it also answers plan requests."""
    from laneweave.coordinator.process import run_coordinator
    from laneweave.protocol.validators import NAME_PATTERN, NAME_RULE

    if not NAME_PATTERN.fullmatch(name):
        raise BadInputError("--name", name, NAME_RULE)
    settings = load_deployment(
        config, endpoint, observation__metrics=metrics, formation__solver=solver
    )
    with _as_role("coordinator", name, settings, log_format, log_level) as observe:
        run_coordinator(settings, name, observe=observe, workers_at_once=True)


def agent(
    vehicles: Annotated[
        list[str] | None, typer.Argument(metavar="[VEHICLE]...", help="Default: all announced.")
    ] = None,
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", help="Take every N-th announced vehicle."),
    ] = None,
    fleet: Annotated[
        str | None,
        typer.Option("--fleet", metavar="NAME", help="Take those of a fleet in security.fleets."),
    ] = None,
    metrics: MetricsOption = None,
    log_format: LogOption = LogFormat.text,
    log_level: LevelOption = None,
) -> None:
    """Run the agents of named vehicles, or of all that are announced."""
    from laneweave.agents.driving.trajectory import check_moves
    from laneweave.agents.process import run_agents
    from laneweave.launch.deploy.assigned_vehicles import crew_of

    settings = load_deployment(config, endpoint, observation__metrics=metrics)
    check_moves(settings)
    crew = crew_of(settings.security, vehicles or (), shard, fleet)
    access = access_of(settings, crew.identity)
    with _as_role("agent", crew.identity, settings, log_format, log_level) as observe:
        run_agents(settings, access, crew.vehicles, crew.shard, observe=observe)


def bridge(
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR")] = None,
    pace: Annotated[
        float | None, typer.Option("--pace", help="Road seconds per second; default 1.")
    ] = 1.0,
    metrics: MetricsOption = None,
    log_format: LogOption = LogFormat.text,
    log_level: LevelOption = None,
) -> None:
    """Run the simulated world of a deployment."""
    from laneweave.launch.run.outcome import complete_summary, print_outcome
    from laneweave.sim_bridge.process import run_bridge

    check_pace(pace)
    settings = load_deployment(config, endpoint, observation__metrics=metrics)
    with _as_role("bridge", "bridge", settings, log_format, log_level) as observe:
        folder = new_folder(out, settings, FORMATION)
        run_bridge(settings, folder, FORMATION, pace, observe=observe)
    outcome = complete_summary(folder, problems=())
    print_outcome(outcome, Console())
    draw_own(folder)
    # A role that was asked to end did what it was asked, however far the run had come.
    asked_to_end = outcome.summary is not None and outcome.summary["ending"] == "interrupted"
    broken = outcome.summary is None or outcome.summary["safety"]["overlaps"]
    raise typer.Exit(1 if broken else 0 if asked_to_end else outcome.exit_status)


def watch(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="A run's folder; default: the deployment."),
    ] = None,
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    listen: Annotated[
        str, typer.Option("--listen", metavar="HOST:PORT", help="Port 0: any that is free.")
    ] = "127.0.0.1:8080",
) -> None:
    """Serve a page that shows a deployment's road live, or a recorded run, until Ctrl-C."""
    from laneweave.launch.watch.process import watch_live, watch_recorded

    if folder is None:
        watch_live(load_deployment(config, endpoint), listen, typer.echo)
        return
    for option, value in (("--config", config), ("--endpoint", endpoint)):
        if value is not None:
            raise BadInputError(option, value, "nothing beside DIR, which needs no network")
    watch_recorded(folder, listen, typer.echo)


def check_pace(pace: float | None) -> None:
    """Check the option `--pace`.

    Raises:
        BadInputError: it is too slow or too fast.
    """
    if pace is not None and not 0.01 <= pace <= 1000:
        raise BadInputError("--pace", pace, "[0.01, 1000]")


@contextmanager
def _as_role(
    role: str, name: str, settings: Scenario, form: LogFormat, level: LogLevel | None
) -> Iterator[Observe]:
    """Log as a role, and show its metrics if the deployment wants them."""
    log_role(role, name, form, level)
    network, address = settings.network, settings.observation.metrics
    log.info("starting", endpoint=network.endpoint, realm=network.realm, metrics=address)
    if not address:
        yield unobserved
        return
    from laneweave.launch.observe.metrics_server import shown_metrics

    with shown_metrics(address, role=role, name=name, realm=network.realm) as observe:
        yield observe
