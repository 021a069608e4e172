"""The observer of a deployment, which publishes nothing."""

from __future__ import annotations

import contextlib
import queue
import time
from collections.abc import Iterator, Mapping

from attrs import define, field

from laneweave.launch.observe.process_view import OtherVersion
from laneweave.launch.observe.road_view import NetworkEvent, RoadView
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import PeerDown, PeerUp, known_key, read_message
from laneweave.protocol.runtime.transport import (
    Delivery,
    LinkDown,
    LinkUp,
    Received,
    TokenDown,
    TokenUp,
    Transport,
)
from laneweave.protocol.wire.topics import CENSUS, CLOCK, EVENT, HEARTBEAT, Keys, Topic

TOPICS = (CLOCK, CENSUS, HEARTBEAT, EVENT)


@define
class Observer:
    """Receiver of messages and tokens: `receive` yields them, `wait` updates the view."""

    keys: Keys
    inbox: queue.SimpleQueue[Delivery] = field(factory=queue.SimpleQueue)
    view: RoadView = field(factory=RoadView)
    topics: tuple[Topic, ...] = TOPICS
    """Subscribed topics."""
    tokens: tuple[Topic, ...] = ()
    """Watched liveliness tokens."""

    def subscribe(self, transport: Transport) -> None:
        """Subscribe to the topics and watch the tokens."""
        for topic in self.tokens:
            transport.watch(self.keys.all_of(topic))
        for topic in self.topics:
            transport.subscribe(self.keys.all_of(topic))

    def wait(self, timeout_s: float) -> None:
        """Wait at most `timeout_s` for events, then update the view with all of them."""
        for event in self.receive(timeout_s):
            self.view.update(event, time.monotonic())

    def receive(self, timeout_s: float) -> Iterator[NetworkEvent]:
        """Wait at most `timeout_s` for events, then yield all of them."""
        try:
            delivery = self.inbox.get(timeout=timeout_s)
            while True:
                with contextlib.suppress(BadInputError):
                    yield from self._read(delivery)
                delivery = self.inbox.get_nowait()
        except queue.Empty:
            return

    def _read(self, delivery: Delivery) -> Iterator[NetworkEvent]:
        match delivery:
            case Received(key, payload):
                known = self.keys.read(key)
                if known is not None and known[0] in self.topics:
                    try:
                        yield read_message(self.keys, key, payload)
                    except BadInputError as error:
                        if error.field == "version":
                            yield OtherVersion(_sender(*known), error.value)
            case TokenUp(key):
                yield PeerUp(*known_key(self.keys, key))
            case TokenDown(key):
                yield PeerDown(*known_key(self.keys, key))
            case LinkUp() | LinkDown():
                yield delivery
            case _:
                pass


def _sender(topic: Topic, parameters: Mapping[str, str]) -> str:
    """Return role and name of a message's sender, as far as its key tells."""
    role = parameters.get("role", topic.sender)
    name = parameters.get("name") or parameters.get(topic.sender, "")
    return f"{role} {name}".rstrip()
