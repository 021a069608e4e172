"""Message faults above the transport: a core wrapper that drops, duplicates and delays messages.

`FaultyCore` sits between a node and its core, so faults are independent for each receiver and work
with any transport. Liveliness tokens, link events and queries are not affected.

Each topic has its own random generator, seeded with the run's seed and the process's label: the
same seed and arrivals give the same faults.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import attrs
from attrs import field, frozen

from laneweave.protocol.errors import BadInputError, unknown_name
from laneweave.protocol.field_validators import within, within_or_none
from laneweave.protocol.names import NAME_PATTERN
from laneweave.protocol.runtime.delaying_core import DelayingCore
from laneweave.protocol.runtime.node import Arrived, Core, Effect, Send
from laneweave.protocol.structuring import KEY
from laneweave.protocol.wire.messages import Plan, Prepare, RoadClock
from laneweave.protocol.wire.topics import ANY_SENDER, ROLES, TOPICS, Party

SENDER_OF_ROLE = {role: str(party) for party, role in ROLES.items() if party is not Party.FLEET}
"""Kind of process in message rules, by role; fleets send as their vehicles."""
SENDERS = tuple(SENDER_OF_ROLE.values())
"""Kinds of processes that send and receive messages."""
MESSAGE_TOPICS = tuple(topic.name for topic in TOPICS if topic.kind is not None)
Route = tuple[str | None, str | None]
"""Sender and receiver of messages, each the kind or the name of a process; None: any."""
CoreWrapper = Callable[[Core], Core]
"""Wraps a core, or returns it unchanged."""


def _message_topics(_: object, attribute: attrs.Attribute[Any], value: tuple[str, ...]) -> None:
    for name in value:
        if name not in MESSAGE_TOPICS:
            allowed = "any of " + ", ".join(MESSAGE_TOPICS)
            raise unknown_name(attribute.name, name, MESSAGE_TOPICS, allowed)


def _process(_: object, attribute: attrs.Attribute[Any], value: str) -> None:
    if not NAME_PATTERN.fullmatch(value):
        allowed = f"{', '.join(SENDERS)}, or the name of a coordinator or a vehicle"
        raise BadInputError(attribute.name, value, allowed)


def _processes(_: object, attribute: attrs.Attribute[Any], value: tuple[str, str]) -> None:
    for one in value:
        _process(None, attribute, one)
    if value[0] == value[1] and value[0] not in SENDERS:
        raise BadInputError(attribute.name, list(value), "two different processes")


@frozen(kw_only=True)
class MessageRule:
    """Rule for message faults; the rules of a run are applied in order.

    A rule affects a message if topic, time, sender and receiver all match.

    Raises:
        BadInputError: a value is invalid.
    """

    topics: tuple[str, ...] = field(default=(), validator=_message_topics)
    """Topic names; empty: all topics that carry messages."""
    loss: float = field(default=0.0, validator=within(0.0, 1.0))
    """Probability that a receiver loses a message."""
    duplication: float = field(default=0.0, validator=within(0.0, 1.0))
    """Probability that a receiver receives a message twice."""
    delay_s: float = field(default=0.0, validator=within(0.0, 60.0))
    """Delay of each copy (wall-clock time)."""
    jitter_s: float = field(default=0.0, validator=within(0.0, 60.0))
    """Maximum additional delay of each copy, drawn uniformly; reorders frequent messages."""
    from_s: float = field(default=0.0, validator=within(0.0, 1e6))
    """Road time at which the rule starts; 0: also before the road's clock starts."""
    until_s: float | None = field(default=None, validator=within_or_none(0.0, 1e6))
    """Road time at which the rule ends; None: when the run ends."""
    sender: str | None = field(
        default=None, validator=attrs.validators.optional(_process), metadata={KEY: "from"}
    )
    """Kind or name of the sender; None: any."""
    receiver: str | None = field(
        default=None, validator=attrs.validators.optional(_process), metadata={KEY: "to"}
    )
    """Kind or name of the receiver; None: any."""
    between: tuple[str, str] | None = field(
        default=None, validator=attrs.validators.optional(_processes)
    )
    """Two kinds or names, one of which sends and the other receives; None: as `sender` and
    `receiver` say."""

    def __attrs_post_init__(self) -> None:
        """Check the fields against each other."""
        if self.between is not None and (self.sender, self.receiver) != (None, None):
            raise BadInputError("between", list(self.between), "nothing if from or to is given")
        if self.until_s is not None and self.until_s <= self.from_s:
            raise BadInputError("until_s", self.until_s, f"more than from_s, {self.from_s:g}")

    def holds(self, road_s: float) -> bool:
        """Return whether the rule is in force at a road time."""
        return self.from_s <= road_s and (self.until_s is None or road_s < self.until_s)

    @property
    def routes(self) -> tuple[Route, ...]:
        """Senders and receivers whose messages the rule affects."""
        if self.between is None:
            return ((self.sender, self.receiver),)
        first, second = self.between
        return (first, second), (second, first)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the single processes in the rule."""
        parties = self.between or (self.sender, self.receiver)
        return tuple(one for one in parties if one is not None and one not in SENDERS)

    @property
    def label(self) -> str:
        """Senders and receivers in words."""
        if self.between is not None:
            return " and ".join(self.between)
        return f"{self.sender or 'all'} to {self.receiver or 'all'}"


class FaultBoard(Protocol):
    """State that the processes of a run share without sending messages."""

    road_s: float
    """Road time, written by the bridge's `FaultyCore` and read by all others."""
    dropped: int
    """Number of dropped messages; each `FaultyCore` adds its own."""


class FaultyCore(DelayingCore):
    """A `Core` that injects message faults into the input of another core."""

    def __init__(
        self,
        core: Core,
        rules: Iterable[MessageRule],
        board: FaultBoard,
        *,
        receiver: str,
        seed: str,
        names: Iterable[str] = (),
    ) -> None:
        """Wrap a core.

        Args:
            core: receives the remaining messages.
            rules: all rules of the run; those for other receivers are ignored.
            board: shared road time and counter.
            receiver: kind of receiver, one of `SENDERS`.
            seed: seed of all draws, unique to the process.
            names: name of the process, or of each vehicle that it drives.
        """
        super().__init__(core)
        self._board = board
        self._kind = receiver
        self._receivers = frozenset((None, receiver, *names))
        self._rules = tuple(
            rule for rule in rules if any(to in self._receivers for _, to in rule.routes)
        )
        self._rules_for: dict[str, tuple[tuple[MessageRule, tuple[Route, ...]], ...]] = {}
        """Rules of each topic, with their routes."""
        self._seed = seed
        self._generators: dict[str, random.Random] = {}

    def _passed(self, effect: Effect) -> Effect:
        if isinstance(effect, Send) and isinstance(effect.message, RoadClock):
            self._board.road_s = effect.message.t_s
        return effect

    def _on_overflow(self, arrived: Arrived) -> None:
        del arrived
        self._board.dropped += 1

    def _copies(self, arrived: Arrived, now_s: float) -> Iterable[tuple[float, Arrived]]:
        del now_s
        delays_s = self._copy_delays_s(arrived)
        if not delays_s:
            self._board.dropped += 1
        return [(delay_s, arrived) for delay_s in delays_s]

    def _copy_delays_s(self, arrived: Arrived) -> list[float]:
        """Return the delay of each copy of a message [s]; empty if the message is dropped."""
        delays_s = [0.0]
        name = arrived.topic.name
        rules = self._rules_for.get(name)
        if rules is None:
            rules = self._rules_for[name] = tuple(
                (rule, rule.routes)
                for rule in self._rules
                if not rule.topics or name in rule.topics
            )
        if not rules:
            return delays_s
        road_s, senders, receivers = self._board.road_s, _senders(arrived), self._to(arrived)
        draw = self._generator(name).random
        for rule, routes in rules:
            if not rule.holds(road_s):
                continue
            if not any(source in senders and to in receivers for source, to in routes):
                continue
            # Always draw both, so that duplicates do not depend on loss.
            lost, doubled = draw() < rule.loss, draw() < rule.duplication
            if lost:
                return []
            delays_s = [
                delay_s + rule.delay_s + (rule.jitter_s * draw() if rule.jitter_s else 0.0)
                for delay_s in delays_s * (2 if doubled else 1)
            ]
        return delays_s

    def _to(self, arrived: Arrived) -> frozenset[str | None]:
        """Return which receivers in rules mean the receiver of a message.

        A message to one of several vehicles in this process is received by that vehicle, any other
        message by all of them.
        """
        if not arrived.topic.addressed or self._kind != Party.VEHICLE:
            return self._receivers
        return frozenset((None, self._kind, arrived.parameters.get("vehicle")))

    def _generator(self, topic: str) -> random.Random:
        generator = self._generators.get(topic)
        if generator is None:
            # Text seeds are hashed with SHA-512, identically in all processes.
            generator = random.Random(f"{self._seed}/{topic}")  # noqa: S311 (no secrets)
            self._generators[topic] = generator
        return generator


def unwrapped(core: Core) -> Core:
    """Return a core unchanged: the `CoreWrapper` of a run without faults."""
    return core


def _senders(arrived: Arrived) -> tuple[str | None, ...]:
    """Return which senders in rules mean the sender of a message: any, its kind, its name."""
    kind, parameters, message = arrived.topic.sender, arrived.parameters, arrived.message
    if kind == ANY_SENDER:
        role = parameters.get("role", "")
        return None, SENDER_OF_ROLE.get(role, role), parameters.get("name")
    if isinstance(message, Prepare | Plan):
        return None, kind, message.ballot.coordinator
    return None, kind, parameters.get(kind, kind)
