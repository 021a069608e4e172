"""`laneweave status`: state and health of a deployment."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from enum import StrEnum
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from laneweave.launch.cli.options import Config, Endpoint, load_deployment
from laneweave.launch.observe.findings import Findings
from laneweave.launch.observe.observed import AGENT, BRIDGE, COORDINATOR, FLEET, Expected
from laneweave.launch.observe.observer import Observer
from laneweave.launch.observe.process_view import label_of
from laneweave.launch.observe.road_view import Coordinator, RoadView
from laneweave.launch.observe.status import LISTENED, TOKENS, Status, status_of
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.names import NAME_PATTERN, NAME_RULE
from laneweave.protocol.scenario.deployment_fields import parse_shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of
from laneweave.protocol.wire.topics import Keys

WAIT_S = 0.1
"""Maximum wait for a message before checking again whether to stop listening."""


class Role(StrEnum):
    """Role of the process whose health is checked."""

    coordinator = COORDINATOR
    bridge = BRIDGE
    agent = AGENT


def status(
    config: Config = None,
    endpoint: Endpoint = None,
    realm: Annotated[str | None, typer.Option("--realm", help="Realm to observe.")] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.1, max=60.0, help="Time to listen.")
    ] = 2.0,
    role: Annotated[Role | None, typer.Option("--role", help="Check one process only.")] = None,
    name: Annotated[
        str | None,
        typer.Option("--name", help="Name of the coordinator, or of the agent's vehicle."),
    ] = None,
    shard: Annotated[
        str | None, typer.Option("--shard", metavar="I/N", help="Shard of the agents.")
    ] = None,
    no_bridge: Annotated[
        bool,
        typer.Option(
            "--no-bridge", help="No road need be there: before its start, or a service alone."
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Listen to a deployment and print its state; exit with status 1 if it is unhealthy."""
    settings = load_deployment(config, endpoint, network__realm=realm)
    everything = Expected.of(settings, bridge=not no_bridge, default=config is None)
    process, expected = _expected(everything, role, name, shard)
    found = listen(settings, seconds, expected, process)
    if as_json:
        typer.echo(json.dumps(found.to_dict(), indent=2))
    elif process is None:
        show(found, Console())
    elif found.healthy:
        typer.echo("healthy")
    if found.findings:
        raise CommandFailedError(f"not healthy: {'; '.join(map(str, found.findings))}")


def _expected(
    everything: Expected, role: Role | None, name: str | None, shard: str | None
) -> tuple[str | None, Expected]:
    """Return the process to check, if it is only one, and what of `everything` should be there."""
    if shard is not None:
        if role is not Role.agent or name is not None:
            raise BadInputError("--shard", shard, "only with --role agent and without --name")
        part = parse_shard(shard, "--shard")
        fleets = everything.fleets.items()
        fleet = next((one for one, members in fleets if members == part), part.name)
        return label_of(FLEET, fleet), Expected(fleets={fleet: part})
    if name is not None and (role in (None, Role.bridge) or not NAME_PATTERN.fullmatch(name)):
        raise BadInputError("--name", name, f"only with --role coordinator or agent: {NAME_RULE}")
    if name is None and role in (Role.coordinator, Role.agent):
        also = ", or --shard I/N" if role is Role.agent else ""
        raise BadInputError("--name", "", f"the name of the process to check{also}")
    match role:
        case Role.coordinator:
            return label_of(COORDINATOR, name or ""), Expected(coordinators=(name or "",))
        case Role.agent:
            return label_of(AGENT, name or ""), Expected(vehicles=(name or "",))
        case Role.bridge:
            return BRIDGE, Expected(bridge=True)
        case None:
            return None, everything


def listen(
    settings: Scenario, seconds: float, expected: Expected, process: str | None = None
) -> Status:
    """Listen to a deployment and return its status.

    Args:
        settings: the deployment.
        seconds: listening time; a check of one process stops once nothing is wrong with it.
        expected: what should be there.
        process: role and name of the only process to check; None: all.

    Raises:
        BadInputError: there is no router at the endpoint.
    """
    from laneweave.protocol.transports.zenoh.transport import ZenohTransport

    network = settings.network
    observer = Observer(Keys(network.realm), topics=LISTENED, tokens=TOKENS)
    access, view = access_of(settings, "observer.status"), observer.view
    with contextlib.closing(ZenohTransport(access, observer.inbox.put)) as transport:
        began_s = now_s = time.monotonic()
        end_s = began_s + seconds
        findings = Findings(expected, began_s, network.election_s, process)
        observer.subscribe(transport)
        while now_s < end_s:
            for event in observer.receive(min(WAIT_S, end_s - now_s)):
                now_s = time.monotonic()
                view.update(event, now_s)
                if now_s >= end_s:
                    break  # a flood of messages must not extend the time
            now_s = time.monotonic()
            found = findings.look(view, now_s, time.time(), last=True)
            if process is not None and not found and _suffices(process, view):
                break
    found = findings.look(view, now_s, time.time(), last=True)
    return status_of(
        view, found, began_s, now_s, network.election_s, network.endpoint, network.realm
    )


def _suffices(process: str, view: RoadView) -> bool:
    """Return whether what was received suffices to conclude that a process is healthy."""
    if not process.startswith(FLEET):
        return True
    # The bridge says which vehicles have no agents.
    return bool(view.processes.road_statuses) or (view.census is not None and bool(view.states))


def show(found: Status, console: Console) -> None:
    """Print a status as a table."""
    table = Table(show_header=False, box=None, pad_edge=False)
    for row in _rows(found):
        table.add_row(*map(escape, row))
    console.print(table)


def _rows(found: Status) -> Iterator[tuple[str, str]]:
    """Yield names and values; what was not seen has no row."""
    yield "health", "healthy" if found.healthy else "not healthy"
    for finding in found.findings:
        yield finding.process, finding.what
    yield "realm", found.realm
    yield "endpoint", found.endpoint
    yield "listened", f"{found.listened_s:.1f} s"
    yield "leader", found.leader or "none"
    if found.term is not None:
        yield "term", f"{found.term}"
    if len(found.claims) > 1:
        yield "claim to lead", ", ".join(found.claims)
    for one in found.candidates:
        yield f"candidate {one.coordinator}", _candidate(one)
    yield from _road_rows(found)
    for topic, rate in found.messages_per_s.items():
        yield f"{topic} messages", f"{rate:.1f}/s"


def _road_rows(found: Status) -> Iterator[tuple[str, str]]:
    plans, road, vehicles = found.plans, found.road, found.vehicles
    yield "plans in force", f"{plans.in_force}"
    if plans.operation is not None:
        yield "operation", plans.operation
    if plans.formations is not None:
        with_plan = f"{plans.formations_with_plan} of {plans.formations}"
        yield "closed formations with a plan", with_plan
    if road is None:
        yield "road", "none"
        return
    yield "road", "ended" if road.ended else "advances"
    yield "road time", f"{road.t_s:.1f} s"
    if not road.ended:
        yield "pace", f"{road.pace or 0.0:.1f}"
    yield "vehicles demanded", f"{road.demanded}"
    yield "vehicles entered", f"{road.entered}"
    yield "vehicles left", f"{road.left}"
    yield "vehicles on the road", f"{road.on_road}"
    yield "with an agent", f"{vehicles.attended}"
    yield "without an agent", f"{vehicles.unattended}"
    yield "not heard from", f"{vehicles.unheard}"
    yield "agents", f"{vehicles.agents}"


def _candidate(one: Coordinator) -> str:
    if one.heard_s_ago is None:
        return "not heard from"
    leads = ", claims to lead" if one.leading else ""
    token = "" if one.token else ", without a token"
    return f"term {one.term}, heard {one.heard_s_ago:.2f} s ago{leads}{token}"
