"""The key grammar: which message travels on which key, from whom, with which quality of service.

    laneweave/{realm}/{topic}/...

`TOPICS` is the one table from which keys are built, received keys are understood, the rights of
those who take part are granted (`rights.py`), and docs/PROTOCOL.md is checked.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from enum import Enum
from functools import lru_cache
from types import MappingProxyType

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.wire import messages

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


class Exchange(Enum):
    """What goes on under a topic's keys."""

    MESSAGES = "messages"
    """The sender publishes; readers subscribe."""
    TOKENS = "tokens"
    """The sender shows a liveliness token; readers watch it."""
    QUESTIONS = "questions"
    """The sender asks; readers serve, and answer."""


@frozen
class Topic:
    """One kind of key, and who does what with it.

    Senders and readers are kinds of processes, `Party` of `identities.py` by its value. What a
    router lets them do (`rights.py`) follows from these fields and from nothing else.
    """

    name: str
    pattern: str
    """Key below the realm, with {parameters}."""
    kind: type | None
    """Message class; None for tokens and the planning service."""
    sender: str
    """Whoever the key names, where it names one of this kind. `any`: vehicles, coordinators and
    the bridge, each under its own {role} and {name}."""
    quality: Quality
    readers: tuple[str, ...] = ()
    """They read all keys of the topic."""
    addressee: str = ""
    """Likewise only the keys that name it."""
    deputy: str = ""
    """It sends in the sender's place, whoever that is."""
    exchange: Exchange = Exchange.MESSAGES

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(re.findall(r"{(\w+)}", self.pattern))


CLOCK = Topic(
    "clock", "clock", messages.RoadClock, "bridge", Quality.LATEST,
    readers=("coordinator", "observer"),
)  # fmt: skip
CENSUS = Topic(
    "census", "census", messages.Census, "bridge", Quality.LATEST,
    readers=("coordinator", "fleet", "observer"),
)  # fmt: skip
SENSE = Topic(
    "sense", "sense/{vehicle}", messages.Sense, "bridge", Quality.LOCKSTEP, addressee="vehicle"
)
COMMAND = Topic(
    "command", "command/{vehicle}", messages.Command, "vehicle", Quality.LOCKSTEP,
    readers=("bridge",),
)  # fmt: skip
# Vehicles read each other's: who waits for somebody has to see that it has left its cell. Where
# nobody attends a vehicle, its caretaker, a part of the bridge, speaks for it.
STATE = Topic(
    "state", "state/{formation}/{vehicle}", messages.VehicleState, "vehicle", Quality.LATEST,
    readers=("coordinator", "vehicle", "observer"), deputy="bridge",
)  # fmt: skip
MOTION = Topic(
    "motion", "motion/{stretch}/{vehicle}", messages.Motion, "vehicle", Quality.LATEST,
    readers=("vehicle", "observer"),
)  # fmt: skip
PREPARE = Topic(
    "prepare", "prepare/{vehicle}", messages.Prepare, "coordinator", Quality.ASSURED,
    addressee="vehicle", readers=("bridge",),
)  # fmt: skip
PLAN = Topic(
    "plan", "plan/{vehicle}", messages.Plan, "coordinator", Quality.ASSURED,
    addressee="vehicle", readers=("bridge", "observer"),
)  # fmt: skip
HEARTBEAT = Topic(
    "heartbeat", "heartbeat/{coordinator}", messages.Heartbeat, "coordinator", Quality.LATEST,
    readers=("coordinator", "bridge", "observer"),
)  # fmt: skip
REPORT = Topic(
    "report", "report/{role}/{name}", messages.Report, "any", Quality.ASSURED,
    readers=("bridge", "observer"),
)  # fmt: skip
EVENT = Topic(
    "event", "event/{role}/{name}", messages.LogEvent, "any", Quality.ASSURED,
    readers=("bridge", "observer"),
)  # fmt: skip
COORDINATOR_ALIVE = Topic(
    "coordinator-alive", "alive/coordinator/{coordinator}/{incarnation}", None, "coordinator",
    Quality.ASSURED, readers=("coordinator", "observer"), exchange=Exchange.TOKENS,
)  # fmt: skip
VEHICLE_ALIVE = Topic(
    "vehicle-alive", "alive/vehicle/{vehicle}", None, "vehicle", Quality.ASSURED,
    readers=("bridge", "observer"), exchange=Exchange.TOKENS,
)  # fmt: skip
BRIDGE_ALIVE = Topic(
    "bridge-alive", "alive/bridge/{incarnation}", None, "bridge", Quality.ASSURED,
    readers=("coordinator", "vehicle", "observer"), exchange=Exchange.TOKENS,
)  # fmt: skip
SERVICE = Topic(
    "service", "service/plan", None, "client", Quality.ASSURED,
    readers=("coordinator",), exchange=Exchange.QUESTIONS,
)  # fmt: skip

TOPICS = (
    CLOCK,
    CENSUS,
    SENSE,
    COMMAND,
    STATE,
    MOTION,
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
        return _key(self.realm, topic.pattern, **parameters)

    def all_of(self, topic: Topic, **given: object) -> str:
        """Return the key expression that matches all keys of a topic with the given parameters."""
        return self.key(topic, **(dict.fromkeys(topic.parameters, "*") | given))

    def read(self, key: str) -> tuple[Topic, Mapping[str, str]] | None:
        """Return a key's topic and parameters, or None when it is not one of ours."""
        return _read(self.realm, key) if len(key) <= _MAX_KEY else None


_MEMO = 1024
"""Keys remembered, in each direction: a process uses few of them, many times a second."""
_MAX_KEY = max(
    len(re.sub(r"{\w+}", "x" * 64, f"{PREFIX}/{{realm}}/{topic.pattern}")) for topic in TOPICS
)
"""Characters of the longest key; no longer text is looked at or remembered."""
_PATTERNS = tuple((topic, tuple(topic.pattern.split("/"))) for topic in TOPICS)


# `typed`: 1, 1.0 and True are equal, but their texts differ.
@lru_cache(maxsize=_MEMO, typed=True)
def _key(realm: str, pattern: str, /, **parameters: object) -> str:
    texts = {name: str(value) for name, value in parameters.items()}
    for name, text in texts.items():
        if text != "*" and not NAME_PATTERN.fullmatch(text):
            raise BadInputError(name, text, NAME_RULE)
    return f"{PREFIX}/{realm}/{pattern.format_map(texts)}"


@lru_cache(maxsize=_MEMO)
def _read(realm: str, key: str) -> tuple[Topic, Mapping[str, str]] | None:
    prefix, *rest = key.split("/")
    if prefix != PREFIX or not rest or rest[0] != realm:
        return None
    parts = rest[1:]
    for topic, pattern in _PATTERNS:
        if len(pattern) == len(parts):
            found = _match(pattern, parts)
            if found is not None:
                # All who read this key share the answer.
                return topic, MappingProxyType(found)
    return None


def _match(pattern: Iterable[str], parts: Iterable[str]) -> dict[str, str] | None:
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
    if "*" not in expression:
        return expression == key
    return _compiled(expression).fullmatch("/" + key) is not None


@lru_cache(maxsize=_MEMO)
def _compiled(expression: str) -> re.Pattern[str]:
    """Return the pattern of the keys that match, each part with a slash before it."""
    wild = {"*": "/[^/]*", "**": "(?:/[^/]*)*"}
    return re.compile(
        "".join(wild.get(part) or "/" + re.escape(part) for part in expression.split("/"))
    )


def matches_any(expressions: Iterable[str], key: str) -> bool:
    """Tell whether one of several key expressions matches a key."""
    return any(matches(expression, key) for expression in expressions)
