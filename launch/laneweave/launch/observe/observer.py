"""A node that watches a run: clock, census, leader. It says nothing."""

from __future__ import annotations

import contextlib
import queue
from collections import deque
from collections.abc import Iterator

from attrs import define, field

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import Arrived, PeerDown, PeerUp, known_key, read_message
from laneweave.protocol.runtime.transport import (
    Delivery,
    LinkDown,
    LinkUp,
    Received,
    TokenDown,
    TokenUp,
    Transport,
)
from laneweave.protocol.wire.messages import Census, Heartbeat, LogEvent, Name, RoadClock
from laneweave.protocol.wire.topics import CENSUS, CLOCK, EVENT, HEARTBEAT, Keys, Topic

News = Arrived | PeerUp | PeerDown | LinkUp | LinkDown
TOPICS = (CLOCK, CENSUS, HEARTBEAT, EVENT)
MOST_NEWS = 1000
"""Events that are kept until somebody takes them."""


@define
class View:
    """What is known of a run."""

    clock: RoadClock | None = None
    census: Census | None = None
    leader: Name | None = None
    incarnation: int = 0
    """Of the leader."""
    term: int = 0
    _news: deque[LogEvent] = field(factory=lambda: deque(maxlen=MOST_NEWS))

    def take(self, message: object) -> None:
        """Take a message in; older news than what is known is ignored."""
        match message:
            case RoadClock() if self.clock is None or message.tick >= self.clock.tick:
                self.clock = message
            case Census() if self.census is None or message.t_s >= self.census.t_s:
                self.census = message
            case Heartbeat() if message.leading and message.term >= self.term:
                self.leader, self.incarnation = message.coordinator, message.incarnation
                self.term = message.term
            case LogEvent():
                self._news.append(message)
            case _:
                pass

    def take_news(self) -> Iterator[LogEvent]:
        """Return what coordinators have said since the last call."""
        while self._news:
            yield self._news.popleft()

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.clock.t_s if self.clock is not None else 0.0


@define
class Observer:
    """Fills a view from a transport's deliveries, or hands over what they say."""

    keys: Keys
    inbox: queue.SimpleQueue[Delivery] = field(factory=queue.SimpleQueue)
    view: View = field(factory=View)
    topics: tuple[Topic, ...] = TOPICS
    """What it listens to."""
    tokens: tuple[Topic, ...] = ()
    """Whose coming and going it watches."""

    def subscribe(self, transport: Transport) -> None:
        """Ask for what the view needs."""
        for topic in self.tokens:
            transport.watch(self.keys.all_of(topic))
        for topic in self.topics:
            transport.subscribe(self.keys.all_of(topic))

    def wait(self, timeout_s: float) -> None:
        """Wait for news at most this long, then take in all there are."""
        for event in self.news(timeout_s):
            if isinstance(event, Arrived):
                self.view.take(event.message)

    def news(self, timeout_s: float) -> Iterator[News]:
        """Wait for news at most this long, then yield all there are."""
        try:
            delivery = self.inbox.get(timeout=timeout_s)
            while True:
                with contextlib.suppress(BadInputError):
                    yield from self._read(delivery)
                delivery = self.inbox.get_nowait()
        except queue.Empty:
            return

    def _read(self, delivery: Delivery) -> Iterator[News]:
        match delivery:
            case Received(key, payload):
                known = self.keys.read(key)
                if known is not None and known[0] in self.topics:
                    yield read_message(self.keys, key, payload)
            case TokenUp(key):
                yield PeerUp(*known_key(self.keys, key))
            case TokenDown(key):
                yield PeerDown(*known_key(self.keys, key))
            case LinkUp() | LinkDown():
                yield delivery
            case _:
                pass
