"""Rights of each process on a secured network, derived from the table of topics.

Each right follows from a row of `topics.TOPICS`: senders may send on keys that contain their name,
readers may read all keys of the topic, processes with agents only those of messages to them. A
router checks both directions, so each right has a flow as seen from the router. This module does no
I/O.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

from attrs import frozen

from laneweave.protocol.config.participants import demanded_vehicles, identities_of, members_of
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import host_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.connection import (
    Access,
    Credentials,
    RouterGuard,
    ca_path,
    certificate_path,
    identity_folder,
    key_path,
)
from laneweave.protocol.wire.codec import MAX_BYTES
from laneweave.protocol.wire.identities import Identity, parse_identity
from laneweave.protocol.wire.topics import (
    ANY_SENDER,
    ROLES,
    TOPICS,
    Exchange,
    Keys,
    Party,
    Topic,
    declared,
)

CA_FILE = "LANEWEAVE_CA_FILE"
CERTIFICATE_FILE = "LANEWEAVE_CERTIFICATE_FILE"
PRIVATE_KEY_FILE = "LANEWEAVE_PRIVATE_KEY_FILE"
PRIVATE_KEY = "LANEWEAVE_PRIVATE_KEY"
"""Environment variables that override the files in `security.folder`."""
# Zenoh accepts unknown identities but silently drops their traffic, so reject them here.
KNOWN_RULE = (
    "an identity of this configuration: runtime.coordinators, security.fleets, "
    "security.vehicles, security.clients, security.operators, security.observers"
)
REQUEST_MARGIN = 2
"""Factor by which the router's size limit exceeds the service's, so that the service can reject a
request with a reason."""
AGENTS = (Party.VEHICLE, Party.FLEET)
"""Parties whose processes have agents."""
EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104 (not an address to listen at)
"""Hosts that stand for all interfaces; clients cannot connect to them."""


class Flow(StrEnum):
    """Direction as seen from the router."""

    IN = "ingress"
    OUT = "egress"


SENDING: dict[Exchange, tuple[tuple[Flow, str], ...]] = {
    Exchange.MESSAGES: ((Flow.IN, "put"),),
    Exchange.TOKENS: ((Flow.IN, "liveliness_token"),),
    # A client learns that a server exists before it queries.
    Exchange.QUERIES: ((Flow.IN, "query"), (Flow.OUT, "reply"), (Flow.OUT, "declare_queryable")),
}
"""Rights of a topic's sender: flow and kind of Zenoh message."""
READING: dict[Exchange, tuple[tuple[Flow, str], ...]] = {
    Exchange.MESSAGES: ((Flow.IN, "declare_subscriber"), (Flow.OUT, "put")),
    Exchange.TOKENS: (
        (Flow.IN, "declare_liveliness_subscriber"),
        (Flow.IN, "liveliness_query"),
        (Flow.OUT, "liveliness_token"),
    ),
    Exchange.QUERIES: ((Flow.IN, "declare_queryable"), (Flow.IN, "reply"), (Flow.OUT, "query")),
}
"""Rights of a topic's readers."""
DECLARED = (
    "declare_subscriber",
    "declare_liveliness_subscriber",
    "liveliness_query",
    "liveliness_token",
)
"""Kinds of messages with key expressions in the form `topics.declared`."""


@frozen
class Rule:
    """Right of one identity to send or receive one kind of Zenoh message."""

    flow: Flow
    message: str
    keys: tuple[str, ...]
    """Key expressions."""


def rules_of(identity: Identity, scenario: Scenario) -> tuple[Rule, ...]:
    """Return all rights of an identity in a deployment."""
    allowed: dict[tuple[Flow, str], dict[str, None]] = {}
    keys = Keys(scenario.network.realm)
    for party, name in _represented(identity, scenario):
        for topic in TOPICS:
            for right, parameters in rights_on(topic, party, name, identity.name):
                allowed.setdefault(right, {})[keys.all_of(topic, **parameters)] = None
    return tuple(Rule(flow, message, tuple(found)) for (flow, message), found in allowed.items())


def _represented(identity: Identity, scenario: Scenario) -> Iterator[tuple[Party, str]]:
    """Yield the party and name of an identity, and for a fleet those of its vehicles."""
    yield identity.party, identity.name
    if identity.party is Party.FLEET:
        members = scenario.security.fleets.get(identity.name, ())
        for vehicle in members_of(members, demanded_vehicles(scenario)):
            yield Party.VEHICLE, vehicle


def rights_on(
    topic: Topic, party: Party, name: str, process: str
) -> Iterator[tuple[tuple[Flow, str], dict[str, str]]]:
    """Yield the rights that a topic grants, with the parameters of the keys.

    Args:
        topic: the topic.
        party: party whose rights the process has.
        name: name that belongs to this party: its own, or that of a vehicle of a fleet.
        process: name of the process.
    """
    own = _own(topic, party, name)
    of_process = {"process": process} if "process" in topic.parameters else {}
    if not topic.addressed:
        own |= of_process
    sending, reading = SENDING[topic.exchange], READING[topic.exchange]
    if party == topic.sender or (topic.sender == ANY_SENDER and party in ROLES):
        yield from ((right, own) for right in sending)
    if party == topic.deputy:
        yield from ((right, {}) for right in sending)
    if party in topic.readers:
        yield from ((right, {}) for right in reading)
    if topic.addressed and party in AGENTS:
        yield from ((right, of_process) for right in reading)


def _own(topic: Topic, party: Party, name: str) -> dict[str, str]:
    """Return the parameters of keys that contain the name of this process."""
    own = {str(party): name}
    if party in ROLES:
        own |= {"role": ROLES[party], "name": name or str(party)}
    return {key: value for key, value in own.items() if key in topic.parameters}


# --- settings of processes and of the router ------------------------------------------------------


def access_of(
    scenario: Scenario, identity: str, environment: Mapping[str, str] = os.environ
) -> Access:
    """Return the connection settings of a process.

    Args:
        scenario: the deployment.
        identity: common name of the process's certificate, such as `coordinator.c1`.
        environment: may contain paths of credentials, or the private key.

    Raises:
        BadInputError: the identity is unknown, or the environment contradicts itself.
    """
    network = scenario.network
    return Access(
        network.endpoint,
        network.realm,
        network.lease_s,
        credentials_of(scenario, identity, environment),
        identity,
        network.connect_timeout_s,
    )


def credentials_of(
    scenario: Scenario, identity: str, environment: Mapping[str, str]
) -> Credentials | None:
    """Return the credentials of a process; None if the network is not secured.

    Raises:
        BadInputError: the identity is unknown, or the environment contradicts itself.
    """
    if scenario.security.mode == "off":
        return None
    known = parse_identity(identity)
    if known not in identities_of(scenario):
        raise BadInputError("identity", identity, KNOWN_RULE)
    name = known.common_name
    folder = Path(scenario.security.folder)
    key_pem, key_file = environment.get(PRIVATE_KEY, ""), environment.get(PRIVATE_KEY_FILE, "")
    if key_pem and key_file:
        raise BadInputError(PRIVATE_KEY_FILE, key_file, f"nothing, as {PRIVATE_KEY} is set")
    return Credentials(
        ca=environment.get(CA_FILE) or str(ca_path(identity_folder(folder, name))),
        certificate=environment.get(CERTIFICATE_FILE) or str(certificate_path(folder, name)),
        private_key="" if key_pem else key_file or str(key_path(folder, name)),
        private_key_pem=key_pem,
    )


def guard_of(scenario: Scenario, environment: Mapping[str, str] = os.environ) -> RouterGuard | None:
    """Return the restrictions that a router enforces; None if the network is not secured.

    Raises:
        BadInputError: the environment contradicts itself.
    """
    credentials = credentials_of(scenario, str(Party.ROUTER), environment)
    if credentials is None:
        return None
    host = host_of(scenario.network.endpoint)
    return RouterGuard(
        credentials,
        "" if host in EVERYWHERE else host,
        access_control(scenario),
        size_limits(scenario),
    )


def access_control(scenario: Scenario) -> dict[str, Any]:
    """Return the rights of all identities as Zenoh's `access_control`, denied by default."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for identity in identities_of(scenario):
        subject = identity.common_name
        granted = [
            {
                "id": f"{subject} {rule.flow} {rule.message}",
                "permission": "allow",
                "flows": [str(rule.flow)],
                "messages": [rule.message],
                "key_exprs": [
                    declared(key) if rule.message in DECLARED else key for key in rule.keys
                ],
            }
            for rule in rules_of(identity, scenario)
        ]
        if granted:
            rules += granted
            subjects.append({"id": subject, "cert_common_names": [subject]})
            policies.append({"rules": [rule["id"] for rule in granted], "subjects": [subject]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def size_limits(scenario: Scenario) -> list[dict[str, Any]]:
    """Return the maximum message sizes as Zenoh's `low_pass_filter`."""
    keys = Keys(scenario.network.realm)
    request_bytes = REQUEST_MARGIN * scenario.service.max_request_bytes
    return [
        {
            "id": name,
            "flows": [str(Flow.IN)],
            "messages": [message],
            "key_exprs": [keys.all_of(topic) for topic in TOPICS if topic.exchange is exchange],
            "size_limit": max_bytes,
        }
        for name, message, exchange, max_bytes in (
            ("requests", "query", Exchange.QUERIES, request_bytes),
            ("messages", "put", Exchange.MESSAGES, MAX_BYTES),
        )
    ]
