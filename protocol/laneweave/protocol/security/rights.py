"""Who may do what on the network: a router's rules, derived from the table of topics.

Nothing is allowed but what follows from a row of `topics.TOPICS`: whoever sends under a topic may
do so under the keys that name it, readers read all keys of the topic, its addressee those that name
it. A router checks both what comes in from a process and what goes out to it, so each right has a
flow, seen from the router. Pure; only `zenoh_transport` knows how a router is told.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from enum import StrEnum
from typing import Any

from attrs import frozen

from laneweave.protocol.config.endpoints import host_of
from laneweave.protocol.config.identities import Identity, Party, identities_of
from laneweave.protocol.scenario.fleets import demanded_vehicles, members_of
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.security.access import Credentials, credentials_of
from laneweave.protocol.wire.codec import MAX_BYTES
from laneweave.protocol.wire.topics import TOPICS, Exchange, Keys, Topic

REQUEST_MARGIN = 2
"""Requests up to so many times the longest come in: the service refuses them, and says why."""

EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104 (compared with, not listened at)
"""Hosts at which a router listens and nobody looks for it."""


class Flow(StrEnum):
    """Direction, seen from the router."""

    IN = "ingress"
    OUT = "egress"


SENDING: dict[Exchange, tuple[tuple[Flow, str], ...]] = {
    Exchange.MESSAGES: ((Flow.IN, "put"),),
    Exchange.TOKENS: ((Flow.IN, "liveliness_token"),),
    # That somebody serves is told to those who ask for it before they ask.
    Exchange.QUESTIONS: ((Flow.IN, "query"), (Flow.OUT, "reply"), (Flow.OUT, "declare_queryable")),
}
"""What a router lets a topic's sender do: flow, and kind of Zenoh's messages."""
READING: dict[Exchange, tuple[tuple[Flow, str], ...]] = {
    Exchange.MESSAGES: ((Flow.IN, "declare_subscriber"), (Flow.OUT, "put")),
    Exchange.TOKENS: (
        (Flow.IN, "declare_liveliness_subscriber"),
        (Flow.IN, "liveliness_query"),
        (Flow.OUT, "liveliness_token"),
    ),
    Exchange.QUESTIONS: ((Flow.IN, "declare_queryable"), (Flow.IN, "reply"), (Flow.OUT, "query")),
}
"""What it lets its readers do."""
_REPORTING = {Party.VEHICLE: "agent", Party.COORDINATOR: "coordinator", Party.BRIDGE: "bridge"}
"""Roles under which those who may send `any` topic do so."""


@frozen
class Rule:
    """One kind of Zenoh's messages that one identity may send or get on some keys."""

    flow: Flow
    message: str
    keys: tuple[str, ...]
    """Key expressions."""


def rules_of(identity: Identity, scenario: Scenario) -> tuple[Rule, ...]:
    """Return all that an identity may do in a deployment."""
    allowed: dict[tuple[Flow, str], dict[str, None]] = {}
    keys = Keys(scenario.network.realm)
    for party, name in _parts(identity, scenario):
        for topic in TOPICS:
            for right, parameters in _rights(topic, party, name):
                allowed.setdefault(right, {})[keys.all_of(topic, **parameters)] = None
    return tuple(Rule(flow, message, tuple(found)) for (flow, message), found in allowed.items())


def _parts(identity: Identity, scenario: Scenario) -> Iterator[tuple[Party, str]]:
    """Yield in whose name an identity acts: a fleet in that of each of its vehicles, too."""
    yield identity.party, identity.name
    if identity.party is Party.FLEET:
        members = scenario.security.fleets.get(identity.name, ())
        for vehicle in members_of(members, demanded_vehicles(scenario)):
            yield Party.VEHICLE, vehicle


def _rights(
    topic: Topic, party: Party, name: str
) -> Iterator[tuple[tuple[Flow, str], dict[str, str]]]:
    """Yield what a topic gives somebody, and the parameters of the keys on which it does."""
    own = _own(topic, party, name)
    sending, reading = SENDING[topic.exchange], READING[topic.exchange]
    if party == topic.sender or (topic.sender == "any" and party in _REPORTING):
        yield from ((right, own) for right in sending)
    if party == topic.deputy:
        yield from ((right, {}) for right in sending)
    if party in topic.readers:
        yield from ((right, {}) for right in reading)
    if party == topic.addressee:
        yield from ((right, own) for right in reading)


def _own(topic: Topic, party: Party, name: str) -> dict[str, str]:
    """Return the parameters that a key has when it names somebody."""
    own = {str(party): name}
    if party in _REPORTING:
        own |= {"role": _REPORTING[party], "name": name or str(party)}
    return {key: value for key, value in own.items() if key in topic.parameters}


# --- what a router is told ------------------------------------------------------------------------


@frozen
class RouterGuard:
    """What a router needs to let everybody do what they may, and nothing else."""

    credentials: Credentials
    host: str
    """Where clients look for it; empty where the configuration does not tell."""
    access_control: dict[str, Any]
    """As Zenoh has it."""
    size_limits: list[dict[str, Any]]
    """Zenoh's `low_pass_filter`."""


def guard_of(scenario: Scenario, environment: Mapping[str, str] = os.environ) -> RouterGuard | None:
    """Return what a deployment's router needs; None where the network is not secured.

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
    """Return a deployment's rules in the form of Zenoh's `access_control`; the rest is denied."""
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
                "key_exprs": list(rule.keys),
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
    """Return the longest messages that a router lets in, in the form of `low_pass_filter`."""
    keys = Keys(scenario.network.realm)
    questions = [keys.all_of(topic) for topic in TOPICS if topic.exchange is Exchange.QUESTIONS]
    messages = [keys.all_of(topic) for topic in TOPICS if topic.exchange is Exchange.MESSAGES]
    request_bytes = REQUEST_MARGIN * scenario.service.max_request_bytes
    return [
        _size_limit("requests", "query", questions, request_bytes),
        _size_limit("messages", "put", messages, MAX_BYTES),
    ]


def _size_limit(name: str, message: str, keys: list[str], most_bytes: int) -> dict[str, Any]:
    return {
        "id": name,
        "flows": [str(Flow.IN)],
        "messages": [message],
        "key_exprs": keys,
        "size_limit": most_bytes,
    }


# --- the same for people --------------------------------------------------------------------------

_VERBS = {
    Exchange.MESSAGES: ("sends", "reads"),
    Exchange.TOKENS: ("shows", "watches"),
    Exchange.QUESTIONS: ("asks", "serves"),
}
_TABLE = (Party.BRIDGE, Party.COORDINATOR, Party.VEHICLE, Party.FLEET, Party.CLIENT, Party.OBSERVER)


def rights_table() -> str:
    """Return the Markdown table of who may do what, for docs/DEPLOYMENT.md."""
    lines = ["| certificate | may |", "|---|---|"]
    for party in _TABLE:
        identity = Identity(party, "" if party is Party.BRIDGE else "NAME")
        does = "<br>".join(_described(identity))
        lines.append(f"| `{identity.common_name}` | {does} |")
    return "\n".join(lines)


def _described(identity: Identity) -> Iterator[str]:
    if identity.party is Party.FLEET:
        yield "all that a vehicle may, for each of its vehicles"
    for exchange, verbs in _VERBS.items():
        topics = [topic for topic in TOPICS if topic.exchange is exchange]
        for verb, rights in zip(verbs, (SENDING[exchange], READING[exchange]), strict=True):
            keys = dict.fromkeys(_keys(topics, identity, rights[0]))
            if keys:
                yield f"{verb} " + ", ".join(f"`{key}`" for key in keys)


def _keys(topics: Iterable[Topic], identity: Identity, wanted: tuple[Flow, str]) -> Iterator[str]:
    for topic in topics:
        for right, parameters in _rights(topic, identity.party, identity.name):
            if right == wanted:
                shown = dict.fromkeys(topic.parameters, "*") | parameters
                yield topic.pattern.format_map(shown)
