"""`laneweave road`: close parts of lanes of a running deployment, and open them again."""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, Annotated

import typer

from laneweave.launch.cli.options import Config, Endpoint, load_deployment
from laneweave.protocol.errors import CommandFailedError, RefusedError
from laneweave.protocol.wire.road_requests import (
    CLOSE,
    OPEN,
    PartOfLane,
    RoadRequest,
    RoadResponse,
)

if TYPE_CHECKING:
    from laneweave.protocol.scenario.fields import Scenario

road = typer.Typer(
    help="Close parts of lanes of a running deployment, and open them again.",
    add_completion=False,
    pretty_exceptions_enable=False,
)

ANSWER_S = 10.0
"""Time within which the bridge answers a request that does not wait for vehicles."""
FIND_S, PAUSE_S = 1.0, 0.05
"""Time for which a bridge is looked for; pause between two queries."""
LONGEST_WAIT_S = 3600.0

Lane = Annotated[int, typer.Option("--lane", metavar="N", help="Lane; 0 is the rightmost.")]
Realm = Annotated[str | None, typer.Option("--realm", help="Realm of the road.")]
Name = Annotated[
    str,
    typer.Option("--name", metavar="NAME", help="Name of the operator in a secured deployment."),
]


@road.command("close")
def close(
    lane: Lane,
    from_m: Annotated[float, typer.Option("--from", metavar="M", help="Where the part begins.")],
    to_m: Annotated[float, typer.Option("--to", metavar="M", help="Where the lane is open again.")],
    for_s: Annotated[
        float | None,
        typer.Option(
            "--for", metavar="S", help="Seconds of road time; default: until it is opened."
        ),
    ] = None,
    clear_s: Annotated[
        float,
        typer.Option(
            "--clear",
            metavar="S",
            help="Seconds of road time for which vehicles may leave the part first, at most.",
        ),
    ] = 20.0,
    config: Config = None,
    endpoint: Endpoint = None,
    realm: Realm = None,
    name: Name = "operator",
) -> None:
    """Close a part of a lane as soon as no vehicle is in it, or could not stop before it.

    Exit with status 1 if vehicles are still there when --clear has passed: the lane stays open.
    """
    request = RoadRequest(
        action=CLOSE, lane=lane, from_m=from_m, to_m=to_m, for_s=for_s, clear_s=clear_s
    )
    settings = load_deployment(config, endpoint, network__realm=realm)
    response = ask(settings, name, request)
    for part in response.parts:
        until = "it is opened" if part.until_s is None else f"{part.until_s:.1f} s"
        typer.echo(f"{_part(part)} is closed from {response.t_s:.1f} s until {until}")
    if response.leave_m is not None:
        names = ", ".join(response.nearer) or "none"
        typer.echo(f"vehicles within {response.leave_m:.0f} m before it may have to stop: {names}")


@road.command("open")
def open_again(
    lane: Lane,
    from_m: Annotated[
        float, typer.Option("--from", metavar="M", help="Default: the start of the road.")
    ] = 0.0,
    to_m: Annotated[
        float | None, typer.Option("--to", metavar="M", help="Default: the end of the road.")
    ] = None,
    config: Config = None,
    endpoint: Endpoint = None,
    realm: Realm = None,
    name: Name = "operator",
) -> None:
    """Open all closed parts of a lane again that overlap the one from --from to --to."""
    place = {} if to_m is None else {"to_m": to_m}
    request = RoadRequest(action=OPEN, lane=lane, from_m=from_m, **place)
    response = ask(load_deployment(config, endpoint, network__realm=realm), name, request)
    for part in response.parts:
        typer.echo(f"{_part(part)} is open again from {response.t_s:.1f} s")


def _part(part: PartOfLane) -> str:
    return f"lane {part.lane}, {part.from_m:g} to {part.to_m:g} m,"


def ask(settings: Scenario, name: str, request: RoadRequest) -> RoadResponse:
    """Send a request to the bridge of a deployment, and return its answer.

    Args:
        settings: the deployment.
        name: name of the operator; in a secured deployment its certificate is `operator.NAME`.
        request: the request.

    Raises:
        BadInputError: there is no router at the endpoint.
        RefusedError: the request is not valid on this road.
        CommandFailedError: the bridge has refused the request, or has not answered in time.
    """
    from laneweave.protocol.runtime.queries import INVALID, JSON, Refusal, format_of
    from laneweave.protocol.security.access_control import access_of
    from laneweave.protocol.transports.zenoh.transport import connect_blocking
    from laneweave.protocol.wire.identities import Identity
    from laneweave.protocol.wire.topics import ROAD_REQUEST, Keys, Party

    network = settings.network
    access = access_of(settings, Identity(Party.OPERATOR, name).common_name)
    clears_s = request.clear_s / min(settings.runtime.max_pace, 1.0)
    wait_s = min(ANSWER_S + (2.0 * clears_s if request.action == CLOSE else 0.0), LONGEST_WAIT_S)
    where = f"{network.endpoint}, realm {network.realm}"
    with contextlib.closing(connect_blocking(access, lambda _: None)) as transport:
        key = Keys(network.realm).key(ROAD_REQUEST)
        payload = JSON.write(request.to_dict())
        found_s = time.monotonic() + FIND_S
        answer = None
        while answer is None and time.monotonic() < found_s:
            try:
                answer = transport.query(key, payload, wait_s, JSON.encoding).result()
            except TimeoutError:
                text = f"the bridge at {where} has not answered within {wait_s:g} s"
                if request.action == CLOSE:
                    text += "; it may still close the lane (laneweave road open)"
                raise CommandFailedError(text) from None
            if answer is None:
                time.sleep(PAUSE_S)
    if answer is None:
        raise CommandFailedError(f"no bridge answers at {where}")
    data = format_of(answer.payload, answer.encoding).read(answer.payload, "response")
    if answer.ok:
        return RoadResponse.from_dict(data)
    refusal = Refusal.from_dict(data)
    if refusal.code == INVALID:
        raise RefusedError(refusal.message)
    raise CommandFailedError(refusal.message)
