"""`laneweave faults`: faults of a deployment whose roles were started by hand."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from laneweave.launch.cli.options import Config, Endpoint, load_deployment

faults = typer.Typer(help="Inject faults into a deployment.", add_completion=False)


@faults.callback()
def _group() -> None:
    """Inject faults into a deployment."""


@faults.command()
def apply(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Fault file: docs/FAULTS.md.")],
    config: Config = None,
    endpoint: Endpoint = None,
    realm: Annotated[str | None, typer.Option("--realm", help="Realm of the processes.")] = None,
) -> None:
    """Kill and pause processes of a deployment on this host, at times of its road, until Ctrl-C.

    Rules for messages, partitions, links, restarts and the router are refused: from outside they
    are not possible, or not certain to affect this deployment only.
    """
    from laneweave.launch.faults.deployment_faults import DeploymentFaults
    from laneweave.launch.faults.fault_file import load_faults
    from laneweave.protocol.config.participants import coordinator_names

    settings = load_deployment(config, endpoint, network__realm=realm)
    specification = load_faults(Path(file), coordinator_names(settings), name="FILE")
    warn = partial(typer.echo, err=True)
    DeploymentFaults(settings, specification, typer.echo, warn).apply()
