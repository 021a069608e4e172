"""`laneweave config`: check a configuration before use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from laneweave.launch.deploy.config_check import check_deployment
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.config.source_files import read_toml_source
from laneweave.protocol.errors import BadInputError, raise_all
from laneweave.protocol.wire.identities import Identity, parse_identity
from laneweave.protocol.wire.topics import Party

app = typer.Typer(help="Check a configuration.", add_completion=False)


@app.callback()
def _group() -> None:
    """Check a configuration."""


@app.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A DEPLOYMENT.toml.")],
    role: Annotated[
        Party | None, typer.Option("--role", help="Also check the certificate of this role.")
    ] = None,
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the role.")] = "",
) -> None:
    """Check a configuration and, with --role, that role's certificate files on this host."""
    settings = load_scenario(file)
    if name and role is None:
        raise BadInputError("--name", name, "only with --role")
    identity = None
    if role is not None:
        identity = parse_identity(Identity(role, name).common_name, "--role and --name")
    report = check_deployment(settings, identity)
    for line in report.warnings:
        typer.echo(f"warning: {line}", err=True)
    with read_toml_source(file).located(given=("--name",)):
        raise_all(report.problems)
    table = Table("what", escape(str(file)), show_lines=False)
    for what, value in report.facts:
        table.add_row(what, escape(value))
    Console().print(table)
