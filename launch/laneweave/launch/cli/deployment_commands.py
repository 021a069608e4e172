"""`laneweave certs` and `laneweave config`: certificates and checks for a deployment."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from laneweave.protocol.config.participants import named_identities
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError, Described
from laneweave.protocol.field_validators import host_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.identities import Identity, parse_identity
from laneweave.protocol.wire.topics import Party

certs = typer.Typer(help="Make test certificates.", add_completion=False)
config = typer.Typer(help="Check a configuration.", add_completion=False)

DEFAULT_DAYS = 365.0
MAX_DAYS = 3650.0

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the certificates.")]
Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", metavar="NAME_OR_IP", help="Host of the router; repeatable."),
]
Days = Annotated[float, typer.Option("--days", metavar="N", help="Validity in days.")]
Separate = Annotated[
    bool,
    typer.Option("--separate", help="Give each identity a sub-folder, which also has ca.pem."),
]


@certs.command()
def init(
    folder: Folder,
    deployment: Annotated[
        Path | None,
        typer.Option("--config", metavar="DEPLOYMENT.toml", help="Deployment of the roles."),
    ] = None,
    host: Hosts = None,
    days: Days = DEFAULT_DAYS,
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep existing files and make only missing ones.")
    ] = False,
    separate: Separate = False,
) -> None:
    """Make a test authority and a certificate for each process of a deployment."""
    from laneweave.launch.deploy.certificate_authority import (
        CA_DAYS,
        host_names,
        issue,
        load_authority,
        make_authority,
    )
    from laneweave.protocol.security.connection import ca_path, certificate_path

    _check_days(days)
    if folder == Path():
        raise BadInputError("DIR", "", "the name of a folder")
    settings = load_scenario(deployment)
    identities = list(
        dict.fromkeys(
            parse_identity(one.common_name, f"{one.party} NAME")
            for one in named_identities(settings)
        )
    )
    hosts = [*(host or ()), *_hosts(settings)]
    host_names(hosts)  # check before writing
    if keep and ca_path(folder).exists():
        authority = load_authority(folder)
        identities = [
            identity
            for identity in identities
            if not certificate_path(folder, identity.common_name).exists()
        ]
    else:
        authority = make_authority(folder, days=max(CA_DAYS, days))
    for identity in identities:
        issue(authority, folder, identity, days=days, hosts=hosts, separate=separate)
    typer.echo(f"{folder}: a test authority and {len(identities)} certificates:")
    for identity in identities:
        typer.echo(f"  {identity.common_name}")
    typer.echo(f"Keep {folder}/ca.key away from all hosts: it can impersonate all processes.")


@certs.command()
def add(
    folder: Folder,
    identity: Annotated[
        str, typer.Argument(metavar="IDENTITY", help="Such as vehicle.v0001 or client.NAME.")
    ],
    host: Hosts = None,
    days: Days = DEFAULT_DAYS,
    separate: Separate = False,
) -> None:
    """Issue another certificate from the existing authority."""
    from laneweave.launch.deploy.certificate_authority import issue, load_authority

    _check_days(days)
    wanted = parse_identity(identity, "IDENTITY")
    if host and wanted.party is not Party.ROUTER:
        raise BadInputError("--host", host[0], "only for the router")
    authority = load_authority(folder)
    issue(authority, folder, wanted, days=days, hosts=host or (), separate=separate)
    typer.echo(f"{folder}: a certificate for {wanted.common_name}")


def _check_days(days: float) -> None:
    if not 0.0 < days <= MAX_DAYS:
        raise BadInputError("--days", days, f"(0, {MAX_DAYS:g}]")


def _hosts(settings: Scenario) -> Iterator[str]:
    """Yield the hosts in a configuration's endpoints."""
    for endpoint in (settings.network.endpoint, *settings.network.listen):
        host = host_of(endpoint)
        if host:
            yield host


@config.callback()
def _group() -> None:
    """Check a configuration."""


@config.command()
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A DEPLOYMENT.toml.")],
    role: Annotated[
        Party | None, typer.Option("--role", help="Also check the certificate of this role.")
    ] = None,
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the role.")] = "",
    against: Annotated[
        str | None,
        typer.Option(
            "--against",
            metavar="REALM",
            help="Also compare the file with the settings of the bridge in this realm.",
        ),
    ] = None,
) -> None:
    """Check a configuration and, with --role, that role's certificate files on this host.

    With --against, exit with status 2 if roles with this file would not act on the bridge's road.
    """
    from laneweave.launch.deploy.config_check import check_deployment
    from laneweave.protocol.config.source_files import read_toml_source
    from laneweave.protocol.errors import raise_all

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
    if against is not None:
        compared = _compare(settings, against, role)
        table.add_row("road", f"{compared} settings are those of the bridge in realm {against}")
    Console().print(table)


def _compare(settings: Scenario, realm: str, role: Party | None) -> int:
    """Compare the settings that all roles share with those of a bridge; return their number.

    Raises:
        BadInputError: some differ, or there is no router at the endpoint.
        CommandFailedError: there is no bridge.
    """
    import attrs

    from laneweave.launch.observe.bridge_lookup import settings_of_bridge
    from laneweave.protocol.errors import CommandFailedError, raise_all
    from laneweave.protocol.scenario.common_settings import settings_of
    from laneweave.protocol.security.access_control import access_of
    from laneweave.protocol.wire.common_settings import GROUPS, groups_of
    from laneweave.protocol.wire.topics import ROLES

    network = attrs.evolve(settings.network, realm=realm)
    access = access_of(attrs.evolve(settings, network=network), "observer.status")
    bridge = settings_of_bridge(access)
    if bridge is None:
        raise CommandFailedError(f"no bridge found in realm {realm} at {access.endpoint}")
    groups = groups_of(ROLES[role]) if role in ROLES else tuple(GROUPS)
    own = settings_of(settings)
    raise_all(
        BadInputError(one.name, Described(one.own), f"{one.other}, as the bridge in realm {realm}")
        for one in own.differences(bridge.values, groups)
    )
    return len(own.values)
