"""The commands that run one role each: `router`, `ping`, `coordinator`, `agent`, `bridge`.

Each imports what it needs when it runs: an agent starts without SUMO, a coordinator without OSQP.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from laneweave.launch.run_folder import draw_own, new_folder
from laneweave.protocol.access import access_of
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario import Scenario, load_scenario

METHOD = "formation"
"""How a bridge's vehicles are controlled, as its summary says."""
RULE, LC2013 = "rule", "lc2013"
"""Reference methods."""

ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="DEPLOYMENT.toml", help="Scenario and network.")
]
RealmEndpoint = Annotated[
    str | None, typer.Option("--endpoint", help="Zenoh endpoint; overrides the configuration.")
]


def router(config: ConfigOption = None, endpoint: RealmEndpoint = None) -> None:
    """Run the Zenoh router of a deployment."""
    from laneweave.protocol.zenoh_transport import run_router

    network = _deployment(config, endpoint).network
    run_router(network.listen or (network.endpoint,), network.lease_s)


def ping(config: ConfigOption = None, endpoint: RealmEndpoint = None) -> None:
    """Open a session at a router and close it: the health check of a deployment."""
    from laneweave.protocol.zenoh_transport import ZenohTransport

    access = access_of(_deployment(config, endpoint), "observer.ping")
    ZenohTransport(access, lambda _: None).close()


def coordinator(
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    name: Annotated[str, typer.Option("--name", help="Rank: the lowest name leads.")] = "c1",
) -> None:
    """Run a coordinator candidate; it also answers plan requests."""
    from laneweave.coordinator.process import run_coordinator
    from laneweave.protocol.topics import NAME_PATTERN, NAME_RULE

    if not NAME_PATTERN.fullmatch(name):
        raise BadInputError("--name", name, NAME_RULE)
    run_coordinator(_deployment(config, endpoint), name, workers_at_once=True)


def agent(
    vehicles: Annotated[
        list[str] | None, typer.Argument(metavar="[VEHICLE]...", help="Default: all announced.")
    ] = None,
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    shard: Annotated[
        str, typer.Option("--shard", metavar="I/N", help="Take every N-th announced vehicle.")
    ] = "0/1",
) -> None:
    """Run the agents of named vehicles, or of all that are announced."""
    from laneweave.agents.host import Shard
    from laneweave.agents.process import run_agents
    from laneweave.agents.trajectory import check_moves
    from laneweave.protocol.topics import NAME_PATTERN, NAME_RULE

    for vehicle in vehicles or ():
        if not NAME_PATTERN.fullmatch(vehicle):
            raise BadInputError("VEHICLE", vehicle, NAME_RULE)
    settings = _deployment(config, endpoint)
    check_moves(settings)
    if vehicles:
        run_agents(settings, access_of(settings, f"vehicle.{vehicles[0]}"), vehicles)
        return
    index, _, count = shard.partition("/")
    digits = index.isdecimal() and count.isdecimal() and len(shard) < 20
    if not digits or int(index) >= int(count):
        raise BadInputError("--shard", shard, "I/N with 0 <= I < N")
    access = access_of(settings, f"fleet.{index}")
    run_agents(settings, access, (), Shard(int(index), int(count)))


def bridge(
    config: ConfigOption = None,
    endpoint: RealmEndpoint = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR")] = None,
    pace: Annotated[
        float | None, typer.Option("--pace", help="Road seconds per second; default 1.")
    ] = 1.0,
) -> None:
    """Run the simulated world of a deployment."""
    from laneweave.launch.outcome import complete_summary, print_outcome
    from laneweave.sim_bridge.process import run_bridge

    check_pace(pace)
    settings = _deployment(config, endpoint)
    folder = new_folder(out, settings, METHOD)
    run_bridge(settings, folder, METHOD, pace)
    outcome = complete_summary(folder, problems=())
    print_outcome(outcome, Console())
    draw_own(folder)
    # A role that was asked to end did what it was asked, however far the run had come.
    asked_to_end = outcome.summary is not None and outcome.summary["ending"] == "interrupted"
    broken = outcome.summary is None or outcome.summary["safety"]["overlaps"]
    raise typer.Exit(1 if broken else 0 if asked_to_end else outcome.exit_status)


def check_pace(pace: float | None) -> None:
    """Check the option `--pace`.

    Raises:
        BadInputError: it is too slow or too fast.
    """
    if pace is not None and not 0.01 <= pace <= 1000:
        raise BadInputError("--pace", pace, "[0.01, 1000]")


def _deployment(config: Path | None, endpoint: str | None) -> Scenario:
    settings = load_scenario(config, network__endpoint=endpoint)
    if not settings.network.endpoint:
        raise BadInputError(
            "network.endpoint", "", "an endpoint, in the configuration or with --endpoint"
        )
    return settings
