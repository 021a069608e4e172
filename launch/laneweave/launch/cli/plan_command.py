"""`laneweave plan`: answer a request; `laneweave compile`: compile the solvers in advance."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from laneweave.launch.cli.options import SOLVER_NAMES
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario


class OutputFormat(StrEnum):
    """Format of a printed plan."""

    json = "json"
    table = "table"


def plan(
    request: Annotated[Path, typer.Argument(metavar="REQUEST.json", help="-: read stdin.")],
    deadline: Annotated[
        float | None, typer.Option("--deadline", help="In seconds; overrides the request's.")
    ] = None,
    connect: Annotated[
        str | None,
        typer.Option("--connect", metavar="ENDPOINT", help="Ask a coordinator at this router."),
    ] = None,
    realm: Annotated[
        str | None, typer.Option("--realm", help="Realm of the coordinator; default: default.")
    ] = None,
    wait: Annotated[
        float, typer.Option("--wait", help="Seconds to wait for router and coordinator.")
    ] = 0.0,
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="DEPLOYMENT.toml", help="Ask one of its coordinators."),
    ] = None,
    client: Annotated[
        str | None,
        typer.Option(
            "--client", metavar="NAME", help="Client name in a secured deployment; default: plan."
        ),
    ] = None,
    output: Annotated[
        OutputFormat, typer.Option("--format", help="Format of the answer.")
    ] = OutputFormat.json,
    solver: Annotated[
        str | None,
        typer.Option(
            "--solver", metavar="NAME", help=f"{SOLVER_NAMES}; overrides the request's solver."
        ),
    ] = None,
    draw: Annotated[
        Path | None,
        typer.Option(
            "--draw", metavar="FILE", help="Draw the plan as FILE.png, or animated as FILE.gif."
        ),
    ] = None,
    draw_road: Annotated[
        Path | None,
        typer.Option(
            "--draw-road",
            metavar="FILE",
            help="Draw vehicles driving the plan on the road of --config, as FILE.png or FILE.gif.",
        ),
    ] = None,
    explained: Annotated[
        bool,
        typer.Option(
            "--explain",
            help="Print the steps of TAPPA (assignments, constraint trees); --draw draws them.",
        ),
    ] = False,
) -> None:
    """Answer one plan request, in this process or with a running coordinator."""
    from laneweave.launch.cli.plan_answers import access_for, answer_request, explain_request

    settings = Scenario() if config is None else _loaded(config)
    # A file without an endpoint describes only the road.
    road_only = draw_road is not None and not (connect or settings.network.endpoint)
    access = access_for(connect, realm, None if road_only else config, client)
    if explained:
        if access is not None:
            raise BadInputError("--explain", "set", "only without --connect and --config")
        if solver not in (None, "tappa"):
            raise BadInputError("--solver", solver, "tappa, for --explain")
        if draw_road is not None:
            raise BadInputError("--draw-road", str(draw_road), "only without --explain")
        explain_request(request, deadline, draw, settings)
        return
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


def compile_solvers() -> None:
    """Compile the solvers that need it, which otherwise happens when they are first used."""
    from laneweave.coordinator.planning.kernels import KERNELS

    for solver, kernels in KERNELS.items():
        kernels.load()
        typer.echo(f"{solver}: compiled")


def _loaded(config: Path) -> Scenario:
    from laneweave.protocol.config.scenario_files import load_scenario

    return load_scenario(config)
