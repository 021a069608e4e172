"""Key grammar: keys, message class, sender, readers and quality of service of each topic.

    laneweave/{realm}/{topic}/...

The table `TOPICS` determines keys and their parsing, the message classes of the codec, the rights
of processes (`security.access_control`), and a table of docs/PROTOCOL.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from enum import Enum, StrEnum
from functools import cached_property, lru_cache
from types import MappingProxyType

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.names import NAME_PATTERN, NAME_RULE
from laneweave.protocol.wire import messages, obstacle_messages, process_messages
from laneweave.protocol.wire.field_types import Message

PREFIX = "laneweave"


class Quality(Enum):
    """Quality of service of a topic; `transports.zenoh` maps it to Zenoh's settings."""

    LATEST = "latest"
    """Periodic messages, dropped under congestion."""
    ASSURED = "assured"
    """Messages that wait under congestion; the protocol acknowledges and resends them."""
    LOCKSTEP = "lockstep"
    """Ticks and answers to them: ASSURED, with the highest priority."""


class Exchange(Enum):
    """Kind of communication on a topic's keys."""

    MESSAGES = "messages"
    """The sender publishes; readers subscribe."""
    TOKENS = "tokens"
    """The sender declares a liveliness token; readers watch it."""
    QUERIES = "queries"
    """The sender queries; readers serve and answer."""


class Party(StrEnum):
    """Kind of process; it determines the rights of the process."""

    ROUTER = "router"
    """Forwards all messages."""
    BRIDGE = "bridge"
    """Simulates the road."""
    COORDINATOR = "coordinator"
    """Candidate for leadership; also answers plan requests."""
    VEHICLE = "vehicle"
    """Agent process of one vehicle."""
    FLEET = "fleet"
    """Agent process of several vehicles, possibly a shard of the census."""
    CLIENT = "client"
    """Queries the planning service."""
    OPERATOR = "operator"
    """Closes parts of lanes, and opens them again."""
    OBSERVER = "observer"
    """Only subscribes."""


ANY_SENDER = "any"
"""Vehicles, fleets, coordinators and the bridge, whose {role} and {name} are in the key."""
ROLES = {
    Party.VEHICLE: "agent",
    Party.FLEET: "fleet",
    Party.COORDINATOR: "coordinator",
    Party.BRIDGE: "bridge",
}
"""Role of each party in the keys of topics with `ANY_SENDER`."""


@frozen
class Topic:
    """A class of keys with its messages, senders and readers.

    The rights that a router grants (`security.access_control`) follow from these fields.
    """

    name: str
    pattern: str
    """Key without prefix or realm, with {parameters}."""
    kind: type[Message] | None
    """Message class; None for tokens and queries."""
    sender: str
    """A `Party`, or `ANY_SENDER`. Keys with the name of a process are reserved for that process."""
    quality: Quality
    readers: tuple[Party, ...] = ()
    """Parties that read all keys of the topic."""
    addressed: bool = False
    """Whether the keys name the process that they are for: processes with agents read only their
    own."""
    deputy: Party | None = None
    """Party that may send on behalf of any sender."""
    exchange: Exchange = Exchange.MESSAGES
    long: bool = False
    """Whether a message may take many packets."""
    remark: str = ""
    """Remark for the table of docs/PROTOCOL.md."""

    @property
    def reliable(self) -> bool:
        """Whether a link that can lose messages must deliver this topic's messages, in order.

        A long message sent as datagrams would rarely arrive complete.
        """
        return self.quality is not Quality.LATEST or self.long

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(re.findall(r"{(\w+)}", self.pattern))

    @cached_property
    def named_in_key(self) -> tuple[str, ...]:
        """Names of the fields of its messages whose values are parameters of the key."""
        known = () if self.kind is None else self.kind.__struct_fields__
        return tuple(name for name in self.parameters if name in known)

    def checked(self, message: object, parameters: Mapping[str, str]) -> object:
        """Return the message if its fields equal the parameters of the key.

        Raises:
            BadInputError: a field differs: a router with access control checks keys only.
        """
        for name in self.named_in_key:
            value = getattr(message, name)
            if str(value) != parameters[name]:
                raise BadInputError(name, value, f"{parameters[name]}, as in its key")
        return message


CLOCK = Topic(
    "clock", "clock", messages.RoadClock, Party.BRIDGE, Quality.LATEST,
    readers=(Party.COORDINATOR, Party.BRIDGE, Party.OBSERVER),
    remark="the bridge: before it starts, those of another one",
)  # fmt: skip
CENSUS = Topic(
    "census", "census", messages.Census, Party.BRIDGE, Quality.LATEST,
    readers=(Party.COORDINATOR, Party.FLEET, Party.OBSERVER), long=True,
    remark="fleets: only those with a shard",
)  # fmt: skip
OBSTACLES = Topic(
    "obstacles", "obstacles", obstacle_messages.Obstacles, Party.BRIDGE, Quality.LATEST,
    readers=(Party.COORDINATOR, Party.VEHICLE, Party.FLEET, Party.OBSERVER),
)  # fmt: skip
# Messages to vehicles are addressed to the process that has the agent: with one subscription for
# all its vehicles, neither it nor the router compares each key with an expression for each vehicle.
SENSE = Topic(
    "sense", "sense/{process}/{vehicle}", messages.Sense, Party.BRIDGE, Quality.LOCKSTEP,
    addressed=True,
)  # fmt: skip
COMMAND = Topic(
    "command", "command/{vehicle}", messages.Command, Party.VEHICLE, Quality.LOCKSTEP,
    readers=(Party.BRIDGE,),
)  # fmt: skip
# Vehicles read the states of the vehicles that they wait for. For a vehicle without an agent, its
# caretaker in the bridge sends the state.
STATE = Topic(
    "state", "state/{block}/{vehicle}", messages.VehicleState, Party.VEHICLE, Quality.LATEST,
    readers=(Party.COORDINATOR, Party.VEHICLE, Party.OBSERVER), deputy=Party.BRIDGE,
    remark="coordinators: only the leader; vehicles: only while waiting for the formation",
)  # fmt: skip
MOTION = Topic(
    "motion", "motion/{stretch}/{vehicle}", messages.Motion, Party.VEHICLE, Quality.LATEST,
    readers=(Party.VEHICLE, Party.OBSERVER),
    remark="only vehicles in this stretch of columns and in both adjacent ones",
)  # fmt: skip
PREPARE = Topic(
    "prepare", "prepare/{process}/{vehicle}", messages.Prepare, Party.COORDINATOR, Quality.ASSURED,
    addressed=True, readers=(Party.BRIDGE,),
    remark="the bridge for vehicles without an agent",
)  # fmt: skip
PLAN = Topic(
    "plan", "plan/{process}/{vehicle}", messages.Plan, Party.COORDINATOR, Quality.ASSURED,
    addressed=True, readers=(Party.BRIDGE, Party.OBSERVER),
    remark="the bridge for vehicles without an agent",
)  # fmt: skip
HEARTBEAT = Topic(
    "heartbeat", "heartbeat/{coordinator}", messages.Heartbeat, Party.COORDINATOR, Quality.LATEST,
    readers=(Party.COORDINATOR, Party.BRIDGE, Party.OBSERVER),
)  # fmt: skip
REPORT = Topic(
    "report", "report/{role}/{name}", process_messages.Report, ANY_SENDER, Quality.ASSURED,
    readers=(Party.BRIDGE, Party.OBSERVER),
    remark="the bridge's recorder",
)  # fmt: skip
EVENT = Topic(
    "event", "event/{role}/{name}", process_messages.LogEvent, ANY_SENDER, Quality.ASSURED,
    readers=(Party.BRIDGE, Party.OBSERVER),
    remark="the bridge's recorder; so far only coordinators send events",
)  # fmt: skip
ROAD_STATUS = Topic(
    "status", "status", process_messages.RoadStatus, Party.BRIDGE, Quality.LATEST,
    readers=(Party.BRIDGE, Party.OBSERVER), long=True,
    remark="the bridge: before it starts, those of another one",
)  # fmt: skip
SETTINGS = Topic(
    "settings", "settings/{role}/{name}", process_messages.ProcessSettings, ANY_SENDER,
    Quality.LATEST,
    readers=(Party.BRIDGE, Party.COORDINATOR, Party.VEHICLE, Party.FLEET, Party.OBSERVER),
    long=True,
    remark="all but observers: only while a process does not fit",
)  # fmt: skip
# Every process that acts on the road, with digests of the settings that all must share.
PROCESS_ALIVE = Topic(
    "process-alive", "alive/process/{role}/{name}/{incarnation}/{drives}/{digests}", None,
    ANY_SENDER, Quality.ASSURED,
    readers=(Party.BRIDGE, Party.COORDINATOR, Party.VEHICLE, Party.FLEET, Party.OBSERVER),
    exchange=Exchange.TOKENS,
    remark="all but observers: those of the bridge; the bridge: those of fleets, too",
)  # fmt: skip
COORDINATOR_ALIVE = Topic(
    "coordinator-alive", "alive/coordinator/{coordinator}/{incarnation}", None, Party.COORDINATOR,
    Quality.ASSURED, readers=(Party.COORDINATOR, Party.OBSERVER), exchange=Exchange.TOKENS,
)  # fmt: skip
VEHICLE_ALIVE = Topic(
    "vehicle-alive", "alive/vehicle/{process}/{vehicle}", None, Party.VEHICLE, Quality.ASSURED,
    readers=(Party.BRIDGE, Party.OBSERVER), exchange=Exchange.TOKENS,
)  # fmt: skip
BRIDGE_ALIVE = Topic(
    "bridge-alive", "alive/bridge/{incarnation}", None, Party.BRIDGE, Quality.ASSURED,
    readers=(Party.COORDINATOR, Party.VEHICLE, Party.BRIDGE, Party.OBSERVER),
    exchange=Exchange.TOKENS,
    remark="the bridge: before it starts, those of another one",
)  # fmt: skip
# A sender is known by the last part of its keys. The session is a secret between a client and the
# coordinators: who knows it can send requests in the client's name.
CLIENT_ALIVE = Topic(
    "client-alive", "alive/client/{session}/{client}", None, Party.CLIENT, Quality.ASSURED,
    readers=(Party.COORDINATOR,), exchange=Exchange.TOKENS,
)  # fmt: skip
SERVICE = Topic(
    "service", "service/plan", None, Party.CLIENT, Quality.ASSURED,
    readers=(Party.COORDINATOR,), exchange=Exchange.QUERIES,
    remark="a query",
)  # fmt: skip
SERVICE_CANCEL = Topic(
    "service-cancel", "service/cancel", None, Party.CLIENT, Quality.ASSURED,
    readers=(Party.COORDINATOR,), exchange=Exchange.QUERIES,
    remark="a query",
)  # fmt: skip
ROAD_REQUEST = Topic(
    "road-request", "road/request", None, Party.OPERATOR, Quality.ASSURED,
    readers=(Party.BRIDGE,), exchange=Exchange.QUERIES,
    remark="a query",
)  # fmt: skip

TOPICS = tuple(each for each in globals().values() if isinstance(each, Topic))


@frozen
class Keys:
    """Builder and parser for the keys of one realm."""

    realm: str

    def __attrs_post_init__(self) -> None:
        """Check the realm.

        Raises:
            BadInputError: the realm is not valid as one part of a key.
        """
        if not NAME_PATTERN.fullmatch(self.realm):
            raise BadInputError("network.realm", self.realm, NAME_RULE)

    def key(self, topic: Topic, **parameters: object) -> str:
        """Return a key, or a key expression if a parameter is `*`.

        Raises:
            BadInputError: a parameter is not valid as one part of a key.
        """
        return key_of(self.realm, topic.pattern, **parameters)

    def all_of(self, topic: Topic, **given: object) -> str:
        """Return the expression for all keys of a topic with the given parameters."""
        return self.key(topic, **(dict.fromkeys(topic.parameters, "*") | given))

    def read(self, key: str) -> tuple[Topic, Mapping[str, str]] | None:
        """Return a key's topic and parameters; None for an unknown key."""
        return _read(self.realm, key) if len(key) <= _MAX_KEY else None


_MEMO, _MEMO_PATTERNS = 1 << 13, 1 << 10
"""Sizes of the caches of keys and of compiled expressions. A process has several keys for each
vehicle on the road, in turn: in a cache with room for fewer, no key would ever be found."""
_MAX_KEY = max(
    len(re.sub(r"{\w+}", "x" * 64, f"{PREFIX}/{{realm}}/{topic.pattern}")) for topic in TOPICS
)
"""Maximum number of characters of a key; longer texts are neither parsed nor cached."""
_PATTERNS = tuple((topic, tuple(topic.pattern.split("/"))) for topic in TOPICS)


# `typed`, because 1, 1.0 and True are equal but have different texts.
@lru_cache(maxsize=_MEMO, typed=True)
def key_of(realm: str, pattern: str, /, **parameters: object) -> str:
    """Return the key of a topic's pattern in a realm; see `Keys.key`."""
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
                # All callers share the cached result.
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
    """Return the incarnation in a token key's parameters; -1 if it is not a number."""
    incarnation = parameters["incarnation"]
    return int(incarnation) if incarnation.isdecimal() else -1


def declared(expression: str) -> str:
    """Return the form of a key expression in which subscriptions and tokens are declared to Zenoh.

    Its first part is a wildcard. Client and router never forget the parts of a declared expression
    before its first wildcard (Zenoh 1.10.2), and routing searches them for every message. So with
    keys that end with the name of a vehicle, memory and CPU time would grow with each vehicle.
    """
    head, slash, rest = expression.partition("/")
    return f"*/{rest}" if slash and "*" not in head else expression


def undeclared(key: str) -> str:
    """Return the key of a token from its declared form."""
    return PREFIX + key[key.index("/") :]


def matches(expression: str, key: str) -> bool:
    """Return whether an expression matches a key (`*`: one part; `**`: any number of parts)."""
    wildcard = expression.find("*")
    if wildcard < 0:
        return expression == key
    # Most expressions differ before their first wildcard; compiling a pattern takes much longer.
    if not key.startswith(expression[: max(wildcard - 1, 0)]):
        return False
    return _compiled(expression).fullmatch("/" + key) is not None


@lru_cache(maxsize=_MEMO_PATTERNS)
def _compiled(expression: str) -> re.Pattern[str]:
    """Return a pattern for matching keys with a leading slash."""
    wild = {"*": "/[^/]*", "**": "(?:/[^/]*)*"}
    return re.compile(
        "".join(wild.get(part) or "/" + re.escape(part) for part in expression.split("/"))
    )


def matches_any(expressions: Iterable[str], key: str) -> bool:
    """Return whether any of the expressions matches a key."""
    return any(matches(expression, key) for expression in expressions)
