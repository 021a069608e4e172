"""Events, effects, and the node that drives a pure core over a transport.

A *core* is a state machine without I/O, clock, thread or randomness of its own: `handle` takes an
event and the time and returns effects; `wakeup_s` is the time of its next wakeup. A `Node` decodes
payloads into typed events and carries out effects with the transport. It counts and drops
malformed input, so a core never sees it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Protocol

import attrs
import structlog
from attrs import field, frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import MetricsSnapshot, NodeMetrics
from laneweave.protocol.runtime.transport import (
    Delivery,
    LinkDown,
    LinkUp,
    Query,
    Received,
    TokenDown,
    TokenUp,
    Transport,
)
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import Name, Report
from laneweave.protocol.wire.topics import Keys, Topic

log = structlog.get_logger(__name__)

TOO_LATE = "the deadline passed before it began"
"""Error of a delegated computation that was not started."""


@frozen
class Started:
    """The node has started: the first event of every core."""


@frozen
class Arrived:
    """A well-formed message."""

    topic: Topic
    parameters: Mapping[str, str]
    message: Any


@frozen
class _OnTopic:
    """A topic, and parameters of its keys; those that are not given match anything."""

    topic: Topic
    parameters: Mapping[str, Any] = field(factory=dict)


@frozen
class PeerUp(_OnTopic):
    """A peer's liveliness token appeared."""


@frozen
class PeerDown(_OnTopic):
    """A peer's liveliness token vanished."""


@frozen
class Wakeup:
    """The time `wakeup_s` of the core has come."""


@frozen
class Computed:
    """A computation of the core has ended; `error` is set if it raised."""

    job: int
    result: Any
    error: str = ""


@frozen
class QueryArrived:
    """A question to this node's service; answer with `Reply` or `Decline`."""

    token: int
    payload: bytes
    encoding: str = ""
    """MIME type of the payload; empty: unknown."""


@frozen
class Stopping:
    """The process is to end: the last event of a core."""


Event = (
    Started
    | Arrived
    | PeerUp
    | PeerDown
    | LinkUp
    | LinkDown
    | Wakeup
    | Computed
    | QueryArrived
    | Stopping
)


@frozen
class Send:
    """Publish a message."""

    topic: Topic
    message: Any
    parameters: dict[str, Any] = field(factory=dict)


@frozen
class Listen(_OnTopic):
    """Subscribe to a topic."""


@frozen
class Unlisten(_OnTopic):
    """Undo `Listen`."""


@frozen
class Announce(_OnTopic):
    """Show a liveliness token."""


@frozen
class Withdraw(_OnTopic):
    """Withdraw a liveliness token."""


@frozen
class Watch(_OnTopic):
    """Receive `PeerUp` and `PeerDown` for matching tokens."""


@frozen
class Serve:
    """Answer questions on a topic."""

    topic: Topic


@frozen
class Reply:
    """Answer a question; `ok` false marks an error reply."""

    token: int
    payload: bytes
    ok: bool = True
    encoding: str = ""


@frozen
class Decline:
    """Leave a question to the other servers of the topic."""

    token: int


@frozen
class Compute:
    """Run `work` on another thread, after earlier jobs; `Computed` brings its result."""

    job: int
    work: Callable[[], Any]


@frozen
class Delegate:
    """Run `work` in a worker process; `Computed` brings its result.

    `work` must be picklable. It is called with the seconds left until `deadline_s`; if none are
    left it is not called and counts as failed. A worker is killed when it exceeds the deadline by
    far.
    """

    job: int
    work: Callable[[float], Any]
    deadline_s: float
    """On the clock of `now_s`."""


@frozen
class End:
    """Leave the network: the core has nothing more to do."""


Effect = (
    Send
    | Listen
    | Unlisten
    | Announce
    | Withdraw
    | Watch
    | Serve
    | Reply
    | Decline
    | Compute
    | Delegate
    | End
)


class Core(Protocol):
    """A state machine that a node drives."""

    def handle(self, event: Event, now_s: float) -> Iterable[Effect]:
        """Handle one event and return the effects.

        The content of an event may be shared with other cores and must not be modified.
        """

    @property
    def wakeup_s(self) -> float | None:
        """Time of the next `Wakeup`, on the clock of `now_s`; None: none is needed."""


def core_metrics(core: Core) -> Iterable[MetricsSnapshot]:
    """Return the metrics of a core: its property `metrics`, or nothing if it has none."""
    metrics: Iterable[MetricsSnapshot] = getattr(core, "metrics", ())
    return metrics


class Node:
    """Drives one core over one transport."""

    def __init__(
        self,
        core: Core,
        transport: Transport,
        keys: Keys,
        submit: Callable[[Compute | Delegate], None],
        label: Name,
        read: Callable[[str, bytes], Arrived] | None = None,
        write: Callable[[object], bytes] = encode,
    ) -> None:
        """Join a core to its transport; nothing is sent before the first `dispatch`.

        Args:
            core: receives the events.
            transport: carries out the effects.
            keys: key grammar of the realm.
            submit: runs computations elsewhere, and calls `dispatch(Computed(...))` at the end.
            label: distinguishes this process from all others in reports.
            read: decodes a message, as `read_message` does, which is the default; may cache.
            write: encodes a message for `read`.
        """
        self._label = label
        self.core = core
        self.ended = False
        self.published = 0
        self.rejected = 0
        self.received: dict[str, int] = {}
        """Well-formed messages by topic name."""
        self.handled = 0
        """Events that the core has handled."""
        self.handling_s = 0.0
        """Total handling time, added up by the runner."""
        self._transport = transport
        self._keys = keys
        self._submit = submit
        self._read = read or partial(read_message, keys)
        self._write = write
        self._encoded: tuple[object, bytes] = (None, b"")
        """Newest message and its bytes: a plan is sent to one vehicle after the other."""

    def deliver(self, delivery: Delivery, now_s: float) -> None:
        """Translate a delivery into an event and let the core handle it."""
        event: Event
        try:
            if isinstance(delivery, Received):
                event = self._read(delivery.key, delivery.payload)
                name = event.topic.name
                self.received[name] = self.received.get(name, 0) + 1
            else:
                event = self._news(delivery)
        except BadInputError as error:
            self._reject(delivery, str(error))
            return
        self.dispatch(event, now_s)

    def dispatch(self, event: Event, now_s: float) -> None:
        """Let the core handle an event and carry out the effects."""
        if self.ended:
            return
        self.handled += 1
        for effect in self.core.handle(event, now_s):
            if isinstance(effect, Send):
                self._send(effect)
            else:
                self._carry_out(effect)

    def metrics(self) -> list[MetricsSnapshot]:
        """Return the metrics of this node and its core."""
        own = NodeMetrics(
            self.published, self.received.copy(), self.rejected, self.handled, self.handling_s
        )
        return [own, *core_metrics(self.core)]

    def _news(self, delivery: LinkUp | LinkDown | Query | TokenUp | TokenDown) -> Event:
        if isinstance(delivery, (LinkUp, LinkDown)):
            return delivery
        if isinstance(delivery, Query):
            return QueryArrived(delivery.token, delivery.payload, delivery.encoding)
        known = known_key(self._keys, delivery.key)
        return PeerUp(*known) if isinstance(delivery, TokenUp) else PeerDown(*known)

    def _reject(self, delivery: Delivery, reason: str) -> None:
        self.rejected += 1
        # Log the 1st, 10th, 100th, ... only: a flood must not fill the log.
        if self.rejected == 10 ** (len(str(self.rejected)) - 1):
            key = getattr(delivery, "key", "")
            log.warning("message ignored", key=key, reason=reason, ignored=self.rejected)

    def _send(self, effect: Send) -> None:
        message, topic = effect.message, effect.topic
        self.published += 1
        if isinstance(message, Report):
            message = attrs.evolve(
                message,
                process=self._label,
                published=self.published,
                rejected=self.rejected,
            )
        if message is not self._encoded[0]:
            self._encoded = message, self._write(message)
        key = self._keys.key(topic, **effect.parameters)
        self._transport.publish(key, self._encoded[1], topic.quality)

    def _carry_out(self, effect: Effect) -> None:
        transport = self._transport
        match effect:
            case Compute() | Delegate():
                self._submit(effect)
            case Reply(token, payload, ok, encoding):
                transport.answer(token, payload, ok=ok, encoding=encoding)
            case Decline(token):
                transport.decline(token)
            case End():
                self.ended = True
                transport.close()
            case Serve(topic):
                transport.serve(self._keys.key(topic))
            case Announce(topic, parameters):
                transport.announce(self._keys.key(topic, **parameters))
            case Withdraw(topic, parameters):
                transport.withdraw(self._keys.key(topic, **parameters))
            case Listen(topic, parameters):
                transport.subscribe(self._keys.all_of(topic, **parameters))
            case Unlisten(topic, parameters):
                transport.unsubscribe(self._keys.all_of(topic, **parameters))
            case Watch(topic, parameters):
                transport.watch(self._keys.all_of(topic, **parameters))


def read_message(
    keys: Keys,
    key: str,
    payload: bytes,
    decode: Callable[[bytes, type], object] = decode,
) -> Arrived:
    """Return the message that arrived on a key; a pure function.

    Raises:
        BadInputError: the key is not one of `keys`, or the payload is not a message of its topic.
    """
    topic, parameters = known_key(keys, key)
    if topic.kind is None:
        raise BadInputError("key", key, "a topic that carries messages")
    return Arrived(topic, parameters, decode(payload, topic.kind))


def known_key(keys: Keys, key: str) -> tuple[Topic, Mapping[str, str]]:
    """Return a key's topic and parameters.

    Raises:
        BadInputError: the key is not one of `keys`.
    """
    known = keys.read(key)
    if known is None:
        raise BadInputError("key", key, f"a topic of realm {keys.realm}")
    return known


def run_job(job: Compute) -> Computed:
    """Run a computation and return its result or error."""
    try:
        return Computed(job.job, job.work())
    except Exception as error:
        log.exception("computation failed", job=job.job)
        return Computed(job.job, None, error_text(error))


def run_delegated(job: Delegate, now_s: Callable[[], float]) -> Computed:
    """Run a delegated computation in this process, on the clock `now_s`, if time is left."""
    left_s = job.deadline_s - now_s()
    if left_s <= 0:
        return Computed(job.job, None, TOO_LATE)
    return run_job(Compute(job.job, partial(job.work, left_s)))


def error_text(error: Exception) -> str:
    """Return an exception as the `error` of a `Computed`."""
    return f"{type(error).__name__}: {error}"
