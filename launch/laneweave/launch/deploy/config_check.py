"""Checks of the configuration of a deployment: problems, warnings, effective settings."""

from __future__ import annotations

import datetime as dt
import os
from collections import Counter
from collections.abc import Iterator, Mapping

from attrs import define, field

from laneweave.protocol.config.participants import demanded_vehicles, identities_of, members_of
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import check_endpoint, host_of, link_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import (
    EVERYWHERE,
    KNOWN_RULE,
    credentials_of,
    rules_of,
)
from laneweave.protocol.security.certificates import examine
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.topics import Party


@define
class Report:
    """Result of a check; warnings are lines of text."""

    problems: list[BadInputError] = field(factory=list)
    warnings: list[str] = field(factory=list)
    facts: list[tuple[str, str]] = field(factory=list)
    """Names and values of effective settings."""


def check_deployment(
    scenario: Scenario, identity: Identity | None, environment: Mapping[str, str] = os.environ
) -> Report:
    """Check what loading does not check; with `identity`, also this role's certificate files."""
    report = Report()
    _check_network(scenario, report)
    _check_moves(scenario, report)
    report.warnings += _shared_vehicles(scenario)
    if identity is not None:
        _check_role(scenario, identity, environment, report)
    return report


def _check_network(scenario: Scenario, report: Report) -> None:
    network = scenario.network
    endpoints = [("network.endpoint", network.endpoint)]
    endpoints += [("network.listen", endpoint) for endpoint in network.listen]
    for name, endpoint in endpoints:
        try:
            check_endpoint(endpoint, name)
        except BadInputError as error:
            report.problems += error.problems
    if link_of(network.endpoint) not in map(link_of, network.listens_at):
        allowed = f"an endpoint with the protocol and the options of {network.endpoint}, too"
        report.problems.append(BadInputError("network.listen", list(network.listen), allowed))
    if network.listen and host_of(network.endpoint) in EVERYWHERE:
        report.warnings.append(
            f"network.endpoint: {network.endpoint} is not reachable by other roles"
        )
    if scenario.security.mode == "off" and _listens_to_other_hosts(scenario):
        report.warnings.append(
            "security.mode: off, so every process that reaches the router has all rights"
        )
    report.facts += [
        ("realm", network.realm),
        ("router at", network.endpoint),
        ("listens at", ", ".join(network.listens_at)),
        ("lease", f"{network.lease_s:g} s"),
        ("security", scenario.security.mode),
    ]


def _check_moves(scenario: Scenario, report: Report) -> None:
    """Run the checks that agents run at start-up, if the extra `agent` is installed."""
    try:
        from laneweave.agents.driving.trajectory import check_moves  # noqa: PLC0415 (an extra)
    except ModuleNotFoundError:
        return
    try:
        check_moves(scenario)
    except BadInputError as error:
        report.problems += error.problems


def _listens_to_other_hosts(scenario: Scenario) -> bool:
    hosts = [host_of(endpoint) for endpoint in scenario.network.listens_at]
    return any(host and host not in ("127.0.0.1", "::1", "localhost") for host in hosts)


def _shared_vehicles(scenario: Scenario) -> Iterator[str]:
    """Yield a warning if fleets have vehicles in common."""
    fleets = scenario.security.fleets
    demanded = demanded_vehicles(scenario) if fleets else ()
    drivers = Counter(
        vehicle for members in fleets.values() for vehicle in members_of(members, demanded)
    )
    shared = sorted(vehicle for vehicle, count in drivers.items() if count > 1)
    if shared:
        yield f"security.fleets: {len(shared)} vehicles are in several fleets, such as {shared[0]}"


def _check_role(
    scenario: Scenario,
    identity: Identity,
    environment: Mapping[str, str],
    report: Report,
) -> None:
    name = identity.common_name
    report.facts.append(("identity", name))
    if scenario.security.mode == "off":
        return
    if identity not in set(identities_of(scenario)):
        report.problems.append(BadInputError("--name", name, KNOWN_RULE))
        return
    if identity.party is not Party.ROUTER:
        count = sum(len(rule.keys) for rule in rules_of(identity, scenario))
        report.facts.append(("rights", f"{count}, see docs/DEPLOYMENT.md"))
    _check_files(scenario, identity, environment, report)


def _check_files(
    scenario: Scenario,
    identity: Identity,
    environment: Mapping[str, str],
    report: Report,
) -> None:
    host = host_of(scenario.network.endpoint)
    try:
        credentials = credentials_of(scenario, identity.common_name, environment)
        assert credentials is not None  # noqa: S101 (the deployment is secured)
        found = examine(credentials, identity.common_name, "" if host in EVERYWHERE else host)
    except BadInputError as error:
        report.problems += error.problems
        return
    until = dt.datetime.fromtimestamp(found.valid_until_s, dt.UTC)
    report.warnings += found.warnings
    report.facts += [
        ("authority", credentials.ca),
        ("certificate", f"{credentials.certificate}, valid until {until:%Y-%m-%d %H:%M} UTC"),
        ("private key", credentials.private_key or "from the environment"),
    ]
