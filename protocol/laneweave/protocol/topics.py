"""The key grammar: which message travels on which key, from whom, with which quality of service.

    laneweave/{realm}/{topic}/...

`TOPICS` is the one table from which keys are built, received keys are understood, and
docs/PROTOCOL.md is checked.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from enum import Enum

from attrs import frozen

from laneweave.protocol import messages
from laneweave.protocol.errors import BadInputError

PREFIX = "laneweave"
NAME_PATTERN = re.compile(r"[A-Za-z0-9_.-]{1,64}")
NAME_RULE = "letters, digits, `_`, `-`, `.`; at least 1, at most 64"


class Quality(Enum):
    """Quality of service of a topic; `zenoh_transport` maps it to Zenoh's settings."""

    LATEST = "latest"
    """Periodic, so that a lost one hardly matters. Dropped when the network is congested."""
    ASSURED = "assured"
    """Waits when the network is congested; acknowledged and sent again by the protocol."""
    LOCKSTEP = "lockstep"
    """As ASSURED, before everything else: ticks and their answers."""


@frozen
class Topic:
    """One kind of key."""

    name: str
    pattern: str
    """Key below the realm, with {parameters}."""
    kind: type | None
    """Message class; None for tokens and the planning service."""
    sender: str
    quality: Quality

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(re.findall(r"{(\w+)}", self.pattern))


CLOCK = Topic("clock", "clock", messages.RoadClock, "bridge", Quality.LATEST)
CENSUS = Topic("census", "census", messages.Census, "bridge", Quality.LATEST)
SENSE = Topic("sense", "sense/{vehicle}", messages.Sense, "bridge", Quality.LOCKSTEP)
COMMAND = Topic("command", "command/{vehicle}", messages.Command, "vehicle", Quality.LOCKSTEP)
STATE = Topic(
    "state", "state/{formation}/{vehicle}", messages.VehicleState, "vehicle", Quality.LATEST
)
PREPARE = Topic("prepare", "prepare/{vehicle}", messages.Prepare, "coordinator", Quality.ASSURED)
PLAN = Topic("plan", "plan/{vehicle}", messages.Plan, "coordinator", Quality.ASSURED)
HEARTBEAT = Topic(
    "heartbeat", "heartbeat/{coordinator}", messages.Heartbeat, "coordinator", Quality.LATEST
)
REPORT = Topic("report", "report/{role}/{name}", messages.Report, "any", Quality.ASSURED)
EVENT = Topic("event", "event/{role}/{name}", messages.LogEvent, "any", Quality.ASSURED)
COORDINATOR_ALIVE = Topic(
    "coordinator-alive", "alive/coordinator/{coordinator}/{incarnation}", None, "coordinator",
    Quality.ASSURED,
)  # fmt: skip
VEHICLE_ALIVE = Topic("vehicle-alive", "alive/vehicle/{vehicle}", None, "vehicle", Quality.ASSURED)
BRIDGE_ALIVE = Topic("bridge-alive", "alive/bridge/{incarnation}", None, "bridge", Quality.ASSURED)
SERVICE = Topic("service", "service/plan", None, "client", Quality.ASSURED)

TOPICS = (
    CLOCK,
    CENSUS,
    SENSE,
    COMMAND,
    STATE,
    PREPARE,
    PLAN,
    HEARTBEAT,
    REPORT,
    EVENT,
    COORDINATOR_ALIVE,
    VEHICLE_ALIVE,
    BRIDGE_ALIVE,
    SERVICE,
)


@frozen
class Keys:
    """Builds and reads the keys of one realm."""

    realm: str

    def __attrs_post_init__(self) -> None:
        """Check the realm.

        Raises:
            BadInputError: the realm cannot be one part of a key.
        """
        if not NAME_PATTERN.fullmatch(self.realm):
            raise BadInputError("network.realm", self.realm, NAME_RULE)

    def key(self, topic: Topic, **parameters: object) -> str:
        """Return a concrete key, or a key expression when a parameter is `*`.

        Raises:
            BadInputError: a parameter cannot be one part of a key.
        """
        return f"{PREFIX}/{self.realm}/{topic.pattern.format_map(_Text(parameters))}"

    def all_of(self, topic: Topic, **given: object) -> str:
        """Return the key expression that matches all keys of a topic with the given parameters."""
        return self.key(topic, **(dict.fromkeys(topic.parameters, "*") | given))

    def read(self, key: str) -> tuple[Topic, dict[str, str]] | None:
        """Return a key's topic and parameters, or None when it is not one of ours."""
        parts = key.split("/")
        if parts[:2] != [PREFIX, self.realm]:
            return None
        for topic in TOPICS:
            pattern = topic.pattern.split("/")
            if len(pattern) == len(parts) - 2:
                found = _match(pattern, parts[2:])
                if found is not None:
                    return topic, found
        return None


class _Text(dict[str, str]):
    def __init__(self, parameters: Mapping[str, object]) -> None:
        super().__init__({name: str(value) for name, value in parameters.items()})
        for name, text in self.items():
            if text != "*" and not NAME_PATTERN.fullmatch(text):
                raise BadInputError(name, text, NAME_RULE)


def _match(pattern: list[str], parts: list[str]) -> dict[str, str] | None:
    found = {}
    for expected, part in zip(pattern, parts, strict=True):
        if expected.startswith("{"):
            if not NAME_PATTERN.fullmatch(part):
                return None
            found[expected[1:-1]] = part
        elif expected != part:
            return None
    return found


def incarnation_of(parameters: Mapping[str, str]) -> int:
    """Return the incarnation in the parameters of a token's key, -1 where it is no number."""
    incarnation = parameters["incarnation"]
    return int(incarnation) if incarnation.isdecimal() else -1


def matches(expression: str, key: str) -> bool:
    """Tell whether a key expression matches a key: `*` is one part, `**` any number of parts."""
    return _match_parts(expression.split("/"), key.split("/"))


def _match_parts(expression: list[str], key: list[str]) -> bool:
    if not expression:
        return not key
    head, rest = expression[0], expression[1:]
    if head == "**":
        return any(_match_parts(rest, key[start:]) for start in range(len(key) + 1))
    return bool(key) and head in ("*", key[0]) and _match_parts(rest, key[1:])


def matches_any(expressions: Iterable[str], key: str) -> bool:
    """Tell whether one of several key expressions matches a key."""
    return any(matches(expression, key) for expression in expressions)
