"""The transport over Zenoh; the only module that imports zenoh.

Every process is a client of one router, which is also a Python process. Scouting and gossip are
off; only the router listens. Callbacks only enqueue, or complete a future. docs/PROTOCOL.md
explains the settings of each topic.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, InvalidStateError
from functools import partial
from typing import Any

import structlog
import zenoh

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import check_endpoint
from laneweave.protocol.runtime.inbox import OpenQueries
from laneweave.protocol.runtime.metrics import Observe, RouterMetrics, unobserved
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.runtime.transport import (
    Answer,
    Deliver,
    LinkDown,
    LinkUp,
    Query,
    Received,
    TokenDown,
    TokenUp,
    sender_name,
    update_tokens,
)
from laneweave.protocol.security.certificates import check_credentials
from laneweave.protocol.security.connection import Access, RouterGuard
from laneweave.protocol.transports.zenoh.settings import Setting, client_settings, router_settings
from laneweave.protocol.wire.codec import MAX_BYTES
from laneweave.protocol.wire.topics import Party, Quality, declared, undeclared

log = structlog.get_logger(__name__)

# With `express` each sample has its own packet, and DROP loses most of a synchronised burst.
_QUALITY: dict[Quality, dict[str, Any]] = {
    quality: {"congestion_control": congestion, "priority": priority, "express": False}
    for quality, congestion, priority in (
        (Quality.LATEST, zenoh.CongestionControl.DROP, zenoh.Priority.DATA),
        (Quality.ASSURED, zenoh.CongestionControl.BLOCK, zenoh.Priority.DATA),
        (Quality.LOCKSTEP, zenoh.CongestionControl.BLOCK, zenoh.Priority.REAL_TIME),
    )
}

MAX_SENDER_BYTES = 1024
"""Maximum size of an attachment that can be a key."""
TOO_LONG = bytes(MAX_BYTES + 1)
"""Substitute for a payload that is too long to read."""
ROUTER_RUNTIME = "(rx: (worker_threads: 64))"
"""Zenoh's default is two receiving threads. Closing an expired connection blocks one of them for up
to 10 s (the linger of its socket), and without a free thread no messages are forwarded. When a host
fails, many connections expire at once."""
_RUNTIME_VARIABLE = "ZENOH_RUNTIME"
CLIENT_RUNTIME = (
    "(app: (worker_threads: 1), acc: (handover: app), tx: (handover: app), rx: (handover: app), "
    "net: (handover: app))"
)
"""A single thread for all of Zenoh's task pools in a client: with one process per vehicle, passing
messages between threads takes about a tenth of the CPU time of two cores."""
CONNECT_AGAIN_S = 0.5
"""Interval between attempts to connect."""


def _open(settings: Iterable[Setting], runtime: str) -> zenoh.Session:
    """Open a session.

    Args:
        settings: settings of the session.
        runtime: value of `ZENOH_RUNTIME` if the environment does not set it. Zenoh reads it only
            for the first session of a process.

    Raises:
        zenoh.ZError: no router answers, or the router cannot listen.
    """
    config = zenoh.Config()
    for path, value in settings:
        config.insert_json5(path, json.dumps(value))
    if _RUNTIME_VARIABLE in os.environ:
        return zenoh.open(config)
    os.environ[_RUNTIME_VARIABLE] = runtime
    try:
        return zenoh.open(config)
    finally:
        # Child processes inherit the environment and may have another role.
        os.environ.pop(_RUNTIME_VARIABLE, None)


class ZenohTransport:
    """A client session; a `Transport`."""

    def __init__(self, access: Access, deliver: Deliver) -> None:
        """Connect to a router.

        Args:
            access: endpoint, identity and credentials of this process.
            deliver: called from Zenoh's threads with each delivery; must return at once.

        Raises:
            BadInputError: the endpoint is malformed, no router answers there, or the credentials
                are not valid.
        """
        endpoint = check_endpoint(access.endpoint)
        authority = ""
        if access.credentials is not None:
            check_credentials(access.credentials, access.identity)
            authority = f" with a certificate of the authority that signed {access.identity}'s"
        try:
            self._session = _open(client_settings(access), CLIENT_RUNTIME)
        except zenoh.ZError as error:
            raise BadInputError(
                "network.endpoint",
                endpoint,
                f"the endpoint of a running router, with its options{authority}",
            ) from error
        self._deliver = deliver
        self._subscriptions: dict[str, Any] = {}
        self._tokens: dict[str, Any] = {}
        self._watched: dict[str, Any] = {}
        self._seen: dict[str, None] = {}
        """Keys of the tokens that the node has been notified of."""
        self._own_lost: list[str] = []
        """Those of `_seen` that were tokens of this process when the link was lost."""
        self._seen_lock = threading.Lock()
        self._served: dict[str, Any] = {}
        self._queries: OpenQueries[zenoh.Query] = OpenQueries()
        self._closed = False
        self._link_listener = self._session.info.declare_transport_events_listener(
            self._on_link, history=False
        )

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        """Send a payload; without a connection it is silently lost."""
        with contextlib.suppress(zenoh.ZError):
            self._session.put(key, payload, **_QUALITY[quality])

    def subscribe(self, key_expression: str) -> None:
        """Subscribe to matching keys; repeated calls have no effect."""
        if key_expression not in self._subscriptions and not self._closed:
            self._subscriptions[key_expression] = self._session.declare_subscriber(
                declared(key_expression), self._on_sample
            )

    def unsubscribe(self, key_expression: str) -> None:
        """Cancel a subscription."""
        subscription = self._subscriptions.pop(key_expression, None)
        if subscription is not None:
            subscription.undeclare()

    def announce(self, key: str) -> None:
        """Declare a liveliness token."""
        if key not in self._tokens and not self._closed:
            self._tokens[key] = self._session.liveliness().declare_token(declared(key))

    def withdraw(self, key: str) -> None:
        """Withdraw a liveliness token."""
        token = self._tokens.pop(key, None)
        if token is not None:
            token.undeclare()

    def watch(self, key_expression: str) -> None:
        """Watch matching liveliness tokens; repeated calls have no effect."""
        if key_expression not in self._watched and not self._closed:
            self._watched[key_expression] = self._session.liveliness().declare_subscriber(
                declared(key_expression), self._on_token, history=True
            )

    def serve(self, key: str) -> None:
        """Deliver queries on a key."""
        if key not in self._served and not self._closed:
            self._served[key] = self._session.declare_queryable(key, partial(self._on_query, key))

    def answer(self, token: int, payload: bytes, *, ok: bool, encoding: str = "") -> None:
        """Answer a query; unknown tokens are ignored."""
        query = self._queries.pop(token)
        if query is None:
            return
        with contextlib.suppress(zenoh.ZError):
            if ok:
                query.reply(query.key_expr, payload, encoding=encoding or None)
            else:
                query.reply_err(payload, encoding=encoding or None)
            query.drop()  # type: ignore[no-untyped-call]

    def decline(self, token: int) -> None:
        """Leave a query to the other servers of its key."""
        query = self._queries.pop(token)
        if query is not None:
            query.drop()  # type: ignore[no-untyped-call]

    def query(
        self, key: str, payload: bytes, timeout_s: float, encoding: str = "", sender: str = ""
    ) -> Future[Answer | None]:
        """Query the servers of a key.

        Args:
            key: key of the query.
            payload: content of the query.
            timeout_s: time after which the query ends without an answer.
            encoding: MIME type of the payload.
            sender: key of a liveliness token of this process, which tells servers who asks, and
                when this process is gone; empty: none. Servers that do not see the token, or not
                yet, decline.

        Returns:
            A future for the first answer. Its result is None if the key has no server, or if all
            have declined, exited or disconnected. It raises `TimeoutError` if none answers in time.
            Its callbacks run in Zenoh's thread: they must return at once, and neither close the
            session nor wait for another answer.
        """
        first: Future[Answer | None] = Future()
        first.set_running_or_notify_cancel()

        def take(reply: zenoh.Reply) -> None:
            _settle(first, _answer_of(reply))

        # With consolidation, a hanging server would delay the answers of the others.
        try:
            self._session.get(
                key,
                # The binding would start a thread for an indirect callback, which takes 0.1 ms.
                zenoh.handlers.Callback(take, lambda: _settle(first, None), indirect=False),
                payload=payload,
                encoding=encoding or None,
                attachment=sender or None,
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
        except zenoh.ZError:  # the session is closed
            _settle(first, None)
        return first

    def close(self) -> None:
        """Close the session; its subscribers would keep the interpreter from exiting."""
        if not self._closed:
            self._closed = True
            # Closing undeclares everything; later calls must not access the closed session.
            self._subscriptions.clear()
            self._tokens.clear()
            self._session.close()  # type: ignore[no-untyped-call]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self._deliver(Received(str(sample.key_expr), sample.payload.to_bytes()))

    def _on_token(self, sample: zenoh.Sample) -> None:
        # The session reports its own tokens, and sometimes the router reports them again.
        kind = TokenUp if sample.kind == zenoh.SampleKind.PUT else TokenDown
        event = kind(undeclared(str(sample.key_expr)))
        with self._seen_lock:
            if update_tokens(self._seen, event):
                self._deliver(event)

    def _on_link(self, event: zenoh.TransportEvent) -> None:
        link_up = event.kind == zenoh.SampleKind.PUT
        self._deliver(LinkUp() if link_up else LinkDown())
        # The session reports its own tokens with the link only if the router had already reported
        # them back.
        with self._seen_lock:
            if link_up:
                changes: list[TokenUp | TokenDown] = [
                    TokenUp(key) for key in self._own_lost if key in self._tokens
                ]
                self._own_lost = []
            else:
                changes = [TokenDown(key) for key in self._seen if key in self._tokens]
                self._own_lost += [change.key for change in changes]
            for change in changes:
                if update_tokens(self._seen, change):
                    self._deliver(change)

    def _on_query(self, key: str, query: zenoh.Query) -> None:
        sender = self._sender_of(query)
        if sender is None or (token := self._queries.add(sender_name(sender), query)) is None:
            query.drop()  # type: ignore[no-untyped-call]
            return
        payload = b""
        if query.payload is not None:
            payload = query.payload.to_bytes() if len(query.payload) <= MAX_BYTES else TOO_LONG
        encoding = "" if query.encoding is None else str(query.encoding)
        self._deliver(Query(key, payload, token, encoding, sender))

    def _sender_of(self, query: zenoh.Query) -> str | None:
        """Return the token key in a query's attachment; empty without an attachment.

        None: the attachment is not the key of a visible token. A query can overtake the token of
        its client, since Zenoh's callbacks have a thread for each declaration; if it were accepted
        as a query without a token, nothing would report the end of the client.
        """
        attachment = query.attachment
        if attachment is None:
            return ""
        if len(attachment) > MAX_SENDER_BYTES:
            return None
        key = attachment.to_bytes().decode(errors="replace")
        with self._seen_lock:
            return key if key in self._seen else None


def connect(
    access: Access, deliver: Deliver, stopped: Callable[[float], object]
) -> ZenohTransport | None:
    """Connect to a router; retry for `connect_timeout_s`.

    Args:
        access: see `ZenohTransport`.
        deliver: see `ZenohTransport`.
        stopped: waits for the given seconds and returns whether the process should stop.

    Returns:
        The session; None if the process should stop.

    Raises:
        BadInputError: the endpoint is malformed, or no router answers there in time.
    """
    check_endpoint(access.endpoint)
    deadline_s = time.monotonic() + access.connect_timeout_s
    waiting = False
    while True:
        try:
            return ZenohTransport(access, deliver)
        except BadInputError as error:
            if error.field != "network.endpoint" or time.monotonic() >= deadline_s:
                raise
        if not waiting:
            waiting = True
            log.warning("waiting for the router", endpoint=access.endpoint)
        if stopped(CONNECT_AGAIN_S):
            return None


def connect_blocking(access: Access, deliver: Deliver) -> ZenohTransport:
    """Connect as `connect` does, without a callback that can stop it.

    Raises:
        BadInputError: see `connect`.
    """
    transport = connect(access, deliver, time.sleep)
    assert transport is not None  # noqa: S101 (`sleep` returns None)
    return transport


def run_router(
    listen: Sequence[str],
    lease_s: float,
    ready: Callable[[], None] | None = None,
    field: str = "network.endpoint",
    guard: RouterGuard | None = None,
    observe: Observe = unobserved,
) -> None:
    """Run a Zenoh router until the process receives SIGINT or SIGTERM.

    Args:
        listen: endpoints at which to listen; a socket file left by a killed router is replaced.
        lease_s: silence [s] after which clients consider the router lost.
        ready: called once the router is listening.
        field: name of the endpoints' field, for errors.
        guard: rights and credentials; None: all clients have all rights.
        observe: registers the metrics source once the router is listening.

    Raises:
        BadInputError: the router cannot listen at an endpoint, or its credentials are invalid.
    """
    endpoints = [check_endpoint(endpoint, field) for endpoint in listen]
    if guard is not None:
        check_credentials(guard.credentials, str(Party.ROUTER), guard.host)
    stop: queue.SimpleQueue[bool] = queue.SimpleQueue()
    with stop_signals(lambda: stop.put(True)):
        try:
            session = _open(router_settings(endpoints, lease_s, guard), ROUTER_RUNTIME)
        except zenoh.ZError as error:
            raise BadInputError(
                field,
                ", ".join(endpoints),
                "endpoints at addresses of this host that are not in use",
            ) from error
        try:
            observe(lambda: [RouterMetrics(len(session.info.transports()))])
            if ready is not None:
                ready()
            stopping = False
            while not stopping:
                with contextlib.suppress(queue.Empty):
                    stopping = stop.get(timeout=1.0)
            log.info("stopping")
        finally:
            session.close()  # type: ignore[no-untyped-call]


def _answer_of(reply: zenoh.Reply) -> Answer | Exception:
    if reply.ok is not None:
        sample = reply.ok
        return Answer(sample.payload.to_bytes(), True, str(sample.encoding))
    error = reply.err
    text = error.payload.to_bytes() if error is not None else b""
    if text == b"Timeout":
        return TimeoutError("no answer in time")
    return Answer(text, False, "" if error is None else str(error.encoding))


def _settle(first: Future[Answer | None], answer: Answer | Exception | None) -> None:
    """Complete a future unless it is already complete."""
    if first.done():
        return
    with contextlib.suppress(InvalidStateError):
        if isinstance(answer, Exception):
            first.set_exception(answer)
        else:
            first.set_result(answer)
