"""Commands that run a role of a deployment, check its router, or show its road.

A command imports its dependencies when it runs: an agent starts without SUMO, a coordinator without
OSQP.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import structlog
import typer
from rich.console import Console

from laneweave.launch.cli.options import (
    Config,
    Endpoint,
    Level,
    Log,
    Metrics,
    RunFolder,
    Solver,
    load_deployment,
    reject_unused_options,
)
from laneweave.launch.run.logs import LogFormat, LogLevel, log_role
from laneweave.launch.run.run_folder import new_folder
from laneweave.launch.run_methods import FORMATION
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import Observe, unobserved
from laneweave.protocol.runtime.processes import stop_signal_received
from laneweave.protocol.scenario.deployment_fields import check_pace
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of

log = structlog.get_logger(__name__)

DRAIN_S = 5.0
"""Default of `--drain`: longer than the default deadline of a request (4 s), and with the time to
exit shorter than the 10 s after which container engines kill a process."""
MAX_DRAIN_S = 3600.0
"""Longest deadline of a request."""


def router(
    config: Config = None,
    endpoint: Endpoint = None,
    metrics: Metrics = None,
    log_format: Log = LogFormat.text,
    log_level: Level = None,
) -> None:
    """Run the Zenoh router of a deployment."""
    from laneweave.protocol.security.access_control import guard_of
    from laneweave.protocol.transports.zenoh.transport import run_router

    settings = load_deployment(config, endpoint, observation__metrics=metrics)
    network, guard = settings.network, guard_of(settings)
    with _as_role("router", "router", settings, log_format, log_level) as observe:
        run_router(
            network.listens_at,
            network.lease_s,
            field="network.listen" if network.listen else "network.endpoint",
            guard=guard,
            observe=observe,
        )


def ping(config: Config = None, endpoint: Endpoint = None) -> None:
    """Check the health of a router: it must accept a session."""
    from laneweave.protocol.transports.zenoh.transport import ZenohTransport

    access = access_of(load_deployment(config, endpoint), "observer.ping")
    ZenohTransport(access, lambda _: None).close()


def coordinator(
    config: Config = None,
    endpoint: Endpoint = None,
    name: Annotated[
        str, typer.Option("--name", help="The coordinator with the lowest name leads.")
    ] = "c1",
    solver: Solver = None,
    drain: Annotated[
        float,
        typer.Option(
            "--drain",
            metavar="SECONDS",
            help="Time after SIGTERM or Ctrl-C to answer pending plan requests; a second signal "
            "ends at once.",
        ),
    ] = DRAIN_S,
    metrics: Metrics = None,
    log_format: Log = LogFormat.text,
    log_level: Level = None,
) -> None:
    """Run a coordinator, which also answers plan requests."""
    from laneweave.coordinator.planning.plug_ins.registry import check_solver
    from laneweave.coordinator.process import run_coordinator
    from laneweave.protocol.names import NAME_PATTERN, NAME_RULE

    if not NAME_PATTERN.fullmatch(name):
        raise BadInputError("--name", name, NAME_RULE)
    if not 0.0 <= drain <= MAX_DRAIN_S:
        raise BadInputError("--drain", drain, f"[0, {MAX_DRAIN_S:g}]")
    settings = load_deployment(
        config, endpoint, observation__metrics=metrics, formation__solver=solver
    )
    check_solver(settings.formation.solver, "formation.solver")
    with _as_role("coordinator", name, settings, log_format, log_level) as observe:
        run_coordinator(settings, name, observe=observe, fork_workers=True, grace_s=drain)


def agent(
    vehicles: Annotated[
        list[str] | None, typer.Argument(metavar="[VEHICLE]...", help="Default: all announced.")
    ] = None,
    config: Config = None,
    endpoint: Endpoint = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", help="Drive every N-th announced vehicle."),
    ] = None,
    fleet: Annotated[
        str | None,
        typer.Option(
            "--fleet", metavar="NAME", help="Drive the vehicles of this fleet in security.fleets."
        ),
    ] = None,
    metrics: Metrics = None,
    log_format: Log = LogFormat.text,
    log_level: Level = None,
) -> None:
    """Run the agents of the named vehicles, or of all announced vehicles."""
    from laneweave.agents.driving.trajectory import check_moves
    from laneweave.agents.process import run_agents
    from laneweave.launch.deploy.assigned_vehicles import assigned_vehicles

    settings = load_deployment(config, endpoint, observation__metrics=metrics)
    check_moves(settings)
    assigned = assigned_vehicles(settings.security, vehicles or (), shard, fleet)
    access = access_of(settings, assigned.identity)
    with _as_role("agent", assigned.identity, settings, log_format, log_level) as observe:
        run_agents(settings, access, assigned.vehicles, assigned.shard, observe=observe)


def bridge(
    config: Config = None,
    endpoint: Endpoint = None,
    out: RunFolder = None,
    pace: Annotated[float | None, typer.Option("--pace", help="Road seconds per second.")] = 1.0,
    takeover: Annotated[
        bool,
        typer.Option("--takeover", help="Start even if another bridge drives a road in the realm."),
    ] = False,
    metrics: Metrics = None,
    log_format: Log = LogFormat.text,
    log_level: Level = None,
) -> None:
    """Run the simulated world of a deployment."""
    from laneweave.launch.observe.bridge_lookup import refuse_second_bridge
    from laneweave.launch.report.report import draw_report
    from laneweave.launch.run.outcome import complete_summary, print_outcome
    from laneweave.sim_bridge.process import run_bridge

    check_pace(pace, "--pace")
    settings = load_deployment(config, endpoint, observation__metrics=metrics)
    with (
        _as_role("bridge", "bridge", settings, log_format, log_level) as observe,
        new_folder(out, settings, FORMATION) as folder,
    ):
        if not takeover:
            refuse_second_bridge(access_of(settings, "bridge"))
        run_bridge(settings, folder, FORMATION, pace, observe=observe)
    outcome = complete_summary(folder, problems=(), interrupted=stop_signal_received())
    print_outcome(outcome, Console())
    if outcome.has_traffic:
        draw_report(folder)
    # A role stopped by a signal has not failed, even if its run is incomplete.
    raise typer.Exit(1 if outcome.problems else 0)


def watch(
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[DIR]", help="Folder of a run; default: the live road."),
    ] = None,
    config: Config = None,
    endpoint: Endpoint = None,
    listen: Annotated[
        str, typer.Option("--listen", metavar="HOST:PORT", help="Port 0: any free port.")
    ] = "127.0.0.1:8080",
    wait: Annotated[
        float | None,
        typer.Option(
            "--wait",
            metavar="SECONDS",
            help="Wait for a router that is not up yet; default: network.connect_timeout_s.",
        ),
    ] = None,
) -> None:
    """Serve a page that shows the road of a deployment or of a recorded run, until Ctrl-C."""
    from laneweave.launch.observe.observed import Expected
    from laneweave.launch.watch.process import watch_live, watch_recorded

    if folder is None:
        settings = load_deployment(config, endpoint, network__connect_timeout_s=wait)
        expected = Expected.of(settings, bridge=True, default=config is None)
        watch_live(settings, listen, typer.echo, expected)
        return
    unused = {"config": config, "endpoint": endpoint, "wait": wait}
    reject_unused_options("with DIR, which needs no network", **unused)
    watch_recorded(folder, listen, typer.echo)


@contextmanager
def _as_role(
    role: str, name: str, settings: Scenario, form: LogFormat, level: LogLevel | None
) -> Iterator[Observe]:
    """Configure the log of a role, and serve its metrics if an address is configured."""
    log_role(role, name, form, level)
    network, address = settings.network, settings.observation.metrics
    log.info("starting", endpoint=network.endpoint, realm=network.realm, metrics=address)
    if not address:
        yield unobserved
        return
    from laneweave.launch.observe.metrics_server import serve_metrics

    with serve_metrics(address, role=role, name=name, realm=network.realm) as observe:
        yield observe
