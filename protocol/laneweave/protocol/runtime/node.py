"""Events, effects, and the node that drives a pure core over a transport.

A *core* is a state machine without I/O, clock, threads or unseeded randomness: `handle` takes an
event and the time and returns effects; `wakeup_s` is the time of the next wakeup. A `Node` decodes
payloads into typed events and executes effects through the transport. It counts and drops malformed
input, which never reaches a core.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Protocol

import structlog
from attrs import field, frozen
from msgspec.structs import replace

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.quick_frozen import quick_frozen
from laneweave.protocol.runtime.metrics import MetricsSnapshot, NodeMetrics
from laneweave.protocol.runtime.transport import (
    Delivery,
    LinkDown,
    LinkUp,
    Overflow,
    Query,
    Received,
    TokenDown,
    TokenUp,
    Transport,
)
from laneweave.protocol.wire.codec import decode, encode, remembering_decode
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import SERVICE, Keys, Topic, key_of

log = structlog.get_logger(__name__)

TOO_LATE = "the deadline passed before the computation began"
"""Error of a delegated computation whose deadline passed before it started."""
STOPPED = "the computation was stopped"
"""Error of a delegated computation after `StopJob`."""

Clock = Callable[[], float]
"""Returns the time [s]."""


class StoppedError(Exception):
    """A computation must end, since its result is no longer needed."""


@frozen
class Started:
    """First event of every core."""


@quick_frozen
class Arrived:
    """A valid message arrived."""

    topic: Topic
    parameters: Mapping[str, str]
    message: Any
    vehicles: frozenset[str] | None = None
    """Vehicles of an agent process that have received it; None: all that it concerns."""


@frozen
class _OnTopic:
    """A topic and parameters of its keys; missing parameters match any value."""

    topic: Topic
    parameters: Mapping[str, Any] = field(factory=dict)


@frozen
class PeerUp(_OnTopic):
    """A peer's liveliness token appeared."""


@frozen
class PeerDown(_OnTopic):
    """A peer's liveliness token vanished."""


@frozen
class MessagesDropped(_OnTopic):
    """Messages were dropped on arrival, since too many of the same sender were waiting."""


@frozen
class Wakeup:
    """The core's `wakeup_s` has been reached."""


@frozen
class Computed:
    """A computation requested by the core is complete; `error` is empty if it succeeded."""

    job: int
    result: Any
    error: str = ""


@frozen
class QueryArrived:
    """A query on a topic that this node serves; answered with `Reply` or `Decline`."""

    token: int
    payload: bytes
    encoding: str = ""
    """MIME type of the payload; empty: unknown."""
    topic: Topic = SERVICE
    sender: Mapping[str, str] = field(factory=dict)
    """Parameters of the querying process's liveliness token; empty: unknown."""


@frozen
class Stopping:
    """The process is about to exit; with a grace, as soon as the core returns `End`."""

    grace_s: float = 0.0
    """Time to finish what has begun [s]; 0: this is the core's last event."""


Event = (
    Started
    | Arrived
    | PeerUp
    | PeerDown
    | MessagesDropped
    | LinkUp
    | LinkDown
    | Wakeup
    | Computed
    | QueryArrived
    | Stopping
)


@quick_frozen
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
    """Cancel a subscription."""


@frozen
class Announce(_OnTopic):
    """Declare a liveliness token."""


@frozen
class Withdraw(_OnTopic):
    """Withdraw a liveliness token."""


@frozen
class Watch(_OnTopic):
    """Receive `PeerUp` and `PeerDown` for matching tokens."""


@frozen
class Serve:
    """Receive queries on a topic."""

    topic: Topic


@frozen
class Reply:
    """Answer a query; `ok` is false for an error reply."""

    token: int
    payload: bytes
    ok: bool = True
    encoding: str = ""


@frozen
class Decline:
    """Leave a query to the other servers of the topic."""

    token: int


@frozen
class Compute:
    """Run `work` in another thread, after earlier jobs; `Computed` carries the result."""

    job: int
    work: Callable[[Clock], Any]
    """Called with the clock for its deadlines, which stands still in simulated time."""


@frozen
class Delegate:
    """Run `work` in a worker process; `Computed` carries the result.

    `work` must be picklable. It is called with the time left until `deadline_s` [s]; if none is
    left, the job fails. A worker that exceeds the deadline by `worker_pool.OVERDUE_S` is killed.
    The second argument is the clock that `work` should read: it raises `StoppedError` after
    `StopJob`.
    """

    job: int
    work: Callable[[float, Clock], Any]
    deadline_s: float
    """Time on the clock of `now_s`."""


@frozen
class StopJob:
    """Stop a delegated computation, or do not begin it, since its result is no longer needed.

    `Computed` follows: with the error `STOPPED`, or with the result if that is already complete.
    """

    job: int


@frozen
class Refuse:
    """Count the event as rejected input: a number in it is out of bounds (`wire.bounds`)."""

    error: BadInputError


@frozen
class End:
    """Leave the network; the core has finished."""


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
    | StopJob
    | Refuse
    | End
)


class Core(Protocol):
    """A state machine that a node drives."""

    def handle(self, event: Event, now_s: float) -> Iterable[Effect]:
        """Handle one event and return the effects.

        Other cores may share the content of an event, so it must not be modified.
        """

    @property
    def wakeup_s(self) -> float | None:
        """Time of the next `Wakeup` on the clock of `now_s`, or None."""


def core_metrics(core: Core) -> Iterable[MetricsSnapshot]:
    """Return the metrics of a core: its property `metrics`, if it has one."""
    metrics: Iterable[MetricsSnapshot] = getattr(core, "metrics", ())
    return metrics


class Node:
    """Driver of one core over one transport."""

    def __init__(
        self,
        core: Core,
        transport: Transport,
        keys: Keys,
        submit: Callable[[Compute | Delegate | StopJob], None],
        label: Name,
        read: Callable[[str, bytes], Arrived] | None = None,
        write: Callable[[object], bytes] = encode,
    ) -> None:
        """Connect a core to a transport; nothing is sent before the first `dispatch`.

        Args:
            core: receives the events.
            transport: executes the effects.
            keys: key grammar of the realm.
            submit: runs a computation elsewhere, then calls `dispatch(Computed(...))`; or stops it.
            label: unique name of this process in reports.
            read: decodes a message, by default `read_message`; may cache.
            write: encodes a message for `read`.
        """
        self._label = label
        self.core = core
        self.ended = False
        self.published = 0
        self.rejected = 0
        self.skipped_fields = 0
        """Number of fields in received messages that only a later release knows."""
        self.received: dict[str, int] = {}
        """Number of valid messages by topic name."""
        self.handled = 0
        """Number of events that the core has handled."""
        self.handling_s = 0.0
        """Total handling time [s], accumulated by the runner."""
        self._transport = transport
        self._keys = keys
        self._submit = submit
        self._read = read or partial(
            read_message, keys, decode=remembering_decode(self._on_skipped)
        )
        self._write = write
        self._encoded: tuple[object, bytes] = (None, b"")
        """Last encoded message and its bytes, reused because a plan goes to several vehicles."""

    def deliver(self, delivery: Delivery, now_s: float) -> None:
        """Convert a delivery into an event and dispatch it."""
        event: Event
        try:
            if isinstance(delivery, Received):
                event = self._read(delivery.key, delivery.payload)
                name = event.topic.name
                self.received[name] = self.received.get(name, 0) + 1
            else:
                event = self._other_event(delivery)
        except BadInputError as error:
            self._reject(getattr(delivery, "key", ""), error)
            return
        self.dispatch(event, now_s)

    def dispatch(self, event: Event, now_s: float) -> None:
        """Pass an event to the core and execute the effects."""
        if self.ended:
            return
        self.handled += 1
        for effect in self.core.handle(event, now_s):
            if isinstance(effect, Send):
                self._send(effect)
            elif isinstance(effect, Refuse):
                self._reject(_key_of(self._keys, event), effect.error)
            else:
                self._execute(effect)

    def metrics(self) -> list[MetricsSnapshot]:
        """Return the metrics of this node and its core."""
        own = NodeMetrics(
            self.published,
            self.received.copy(),
            self.rejected,
            self.skipped_fields,
            self.handled,
            self.handling_s,
        )
        return [own, *core_metrics(self.core)]

    def _other_event(
        self, delivery: LinkUp | LinkDown | Query | TokenUp | TokenDown | Overflow
    ) -> Event:
        if isinstance(delivery, (LinkUp, LinkDown)):
            return delivery
        if isinstance(delivery, Query):
            return self._query_event(delivery)
        known = known_key(self._keys, delivery.key)
        if isinstance(delivery, Overflow):
            return MessagesDropped(*known)
        return PeerUp(*known) if isinstance(delivery, TokenUp) else PeerDown(*known)

    def _query_event(self, query: Query) -> QueryArrived:
        topic, _ = known_key(self._keys, query.key)
        _, sender = self._keys.read(query.sender) or (None, {})
        return QueryArrived(query.token, query.payload, query.encoding, topic, sender)

    def _on_skipped(self, fields: int) -> None:
        if not self.skipped_fields:
            log.warning("messages of a later release have more fields, which are skipped")
        self.skipped_fields += fields

    def _reject(self, key: str, error: BadInputError) -> None:
        self.rejected += 1
        # Log only the 1st, 10th, 100th, ...: a flood must not fill the log.
        if self.rejected == 10 ** (len(str(self.rejected)) - 1):
            log.warning("message ignored", key=key, reason=str(error), ignored=self.rejected)

    def _send(self, effect: Send) -> None:
        message, topic = effect.message, effect.topic
        self.published += 1
        if isinstance(message, Report):
            message = replace(
                message,
                process=self._label,
                published=self.published,
                rejected=self.rejected,
            )
        if message is not self._encoded[0]:
            self._encoded = message, self._write(message)
        key = key_of(self._keys.realm, topic.pattern, **effect.parameters)
        self._transport.publish(key, self._encoded[1], topic.quality)

    def _execute(self, effect: Effect) -> None:
        transport = self._transport
        match effect:
            case Compute() | Delegate() | StopJob():
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
    """Return the message in a payload that arrived on a key.

    Raises:
        BadInputError: the key is not in `keys`, or the payload is not a message of its topic.
    """
    topic, parameters = known_key(keys, key)
    if topic.kind is None:
        raise BadInputError("key", key, "a topic that carries messages")
    message = topic.checked(decode(payload, topic.kind), parameters)
    return Arrived(topic, parameters, message)


def _key_of(keys: Keys, event: Event) -> str:
    """Return the key of a message or token; empty for other events."""
    if isinstance(event, (Arrived, PeerUp, PeerDown)):
        return keys.key(event.topic, **event.parameters)
    return ""


def known_key(keys: Keys, key: str) -> tuple[Topic, Mapping[str, str]]:
    """Return a key's topic and parameters.

    Raises:
        BadInputError: the key is not in `keys`.
    """
    known = keys.read(key)
    if known is None:
        raise BadInputError("key", key, f"a topic of realm {keys.realm}")
    return known


def run_job(job: Compute, clock: Clock = time.monotonic) -> Computed:
    """Run a computation that reads `clock`, and return its result or error."""
    try:
        return Computed(job.job, job.work(clock))
    except StoppedError:
        return Computed(job.job, None, STOPPED)
    except Exception as error:
        log.exception("computation failed", job=job.job)
        return Computed(job.job, None, error_text(error))


def run_delegated(job: Delegate, now_s: Clock, clock: Clock = time.monotonic) -> Computed:
    """Run a delegated computation with a clock, unless its deadline has passed by `now_s`."""
    left_s = job.deadline_s - now_s()
    if left_s <= 0:
        return Computed(job.job, None, TOO_LATE)
    return run_job(Compute(job.job, partial(job.work, left_s)), clock)


def error_text(error: Exception) -> str:
    """Return the `error` of a `Computed` for an exception."""
    return f"{type(error).__name__}: {error}"
