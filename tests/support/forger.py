"""A client that forges well-formed messages with numbers that no correct sender has."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from attrs import define, field

from laneweave.protocol.runtime.transport import Delivery, Received
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.bounds import max_term
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Heartbeat,
    Name,
    PendingTransfer,
    Prepare,
    RoadClock,
    Sense,
    VehicleState,
    addresses_of,
)
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COMMAND,
    HEARTBEAT,
    PREPARE,
    REPORT,
    SENSE,
    STATE,
    Keys,
    Quality,
    Topic,
)
from support.states import changed
from support.waiting import wait_until

OF_ROAD = (CLOCK, CENSUS, HEARTBEAT)
OF_VEHICLE = (SENSE, STATE, COMMAND)
WAIT_S = 60.0
"""Longest wait for a vehicle on the road, and for its messages."""
RATE = 150.0
"""Messages per second of `Forger.send`."""


@define
class Forger:
    """A client that knows the newest messages of correct senders, and forges others from them."""

    access: Access
    """Access of the session that sends."""
    readers: Sequence[Access] = ()
    """Accesses of further sessions that receive, for messages that the first one may not read."""
    may_name: Callable[[Name], bool] = lambda _: True
    """Returns whether a vehicle may become the victim."""
    victim: Name | None = None
    """Vehicle that the messages name."""
    named: set[Name] = field(factory=set)
    """All victims so far."""
    clocks: list[tuple[float, float]] = field(factory=list)
    """Road time [s] and `time.monotonic()` of all clock messages."""
    _of_road: dict[type, Any] = field(factory=dict)
    """Newest message of each kind of `OF_ROAD`."""
    _of_victim: dict[type, Any] = field(factory=dict)
    """Newest message of each kind of `OF_VEHICLE` from the victim or for it."""
    _forged: set[bytes] = field(factory=set)
    """Payloads sent: this client receives them, too, and must not take them for the road's."""
    _tokens: set[str] = field(factory=set)
    """Keys of the tokens shown."""
    _lock: threading.Lock = field(factory=threading.Lock)
    _keys: Keys = field(init=False)
    _transports: list[ZenohTransport] = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Connect and subscribe."""
        self._keys = Keys(self.access.realm)
        accesses = (self.access, *self.readers)
        self._transports = [ZenohTransport(access, self._on) for access in accesses]
        for transport in self._transports:
            for topic in (*OF_ROAD, *OF_VEHICLE):
                transport.subscribe(self._keys.all_of(topic))

    def _on(self, delivery: Delivery) -> None:
        if not isinstance(delivery, Received) or delivery.payload in self._forged:
            return
        known = self._keys.read(delivery.key)
        if known is None or known[0].kind is None:
            return
        kind, vehicle = known[0].kind, known[1].get("vehicle")
        with self._lock:
            if vehicle is None:
                self._of_road[kind] = message = decode(delivery.payload, kind)
                if isinstance(message, RoadClock):
                    self.clocks.append((message.t_s, time.monotonic()))
            elif vehicle == self.victim:
                self._of_victim[kind] = decode(delivery.payload, kind)

    def known(self, kind: type) -> Any:  # noqa: ANN401
        """Return the newest message of a kind."""
        return wait_until(lambda: self._of_victim.get(kind) or self._of_road.get(kind), WAIT_S)

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.clocks[-1][0] if self.clocks else 0.0

    def clock_s(self, t_s: float) -> float:
        """Return when a road time was reached [`time.monotonic()`]; infinity if it was not."""
        road_s, clock_s = np.array(self.clocks).T
        return float(np.interp(t_s, road_s, clock_s, right=np.inf))

    def _candidates(self) -> list[Name]:
        """Return the vehicles on the road that may become the victim, in order of entry."""
        on_road = (entry.vehicle for entry in self.known(Census).on_road)
        return [vehicle for vehicle in on_road if self.may_name(vehicle)]

    def choose(self) -> None:
        """Choose the vehicle that entered last, once there is one and its messages are known."""
        wait_until(self._knows_last, WAIT_S)
        assert self.victim is not None
        self.named.add(self.victim)

    def _knows_last(self) -> bool:
        candidates = self._candidates()
        if candidates and candidates[-1] != self.victim:
            with self._lock:
                self.victim = candidates[-1]
                self._of_victim.clear()
            # With a certificate, a vehicle may read only this key.
            for transport, process in product(self._transports, self._addresses()):
                transport.subscribe(self._keys.key(SENSE, process=process, vehicle=self.victim))
        return bool(candidates) and len(self._of_victim) == len(OF_VEHICLE)

    def keep_victim(self) -> None:
        """Choose another victim if the vehicle has left the road."""
        if self.victim not in self._candidates():
            self.choose()

    def send(self, rows: Sequence[Callable[[Forger], None]], done: Callable[[], bool]) -> int:
        """Forge messages of all rows in turn, `RATE` per second, until `done`; return how many."""
        began_s, sent = time.monotonic(), 0
        while not done():
            self.keep_victim()
            for forge in rows:
                forge(self)
            sent += len(rows)
            time.sleep(max(0.0, began_s + sent / RATE - time.monotonic()))
        self.withdraw_tokens()
        return sent

    # --- messages -----------------------------------------------------------------------------

    def publish(self, topic: Topic, message: object, **parameters: object) -> None:
        payload = encode(message)
        self._forged.add(payload)
        key = self._keys.key(topic, **parameters)
        self._transports[0].publish(key, payload, Quality.ASSURED)

    def to_victim(self, topic: Topic, message: object) -> None:
        """Publish a message to the victim; on other topics, a message in the victim's name."""
        if not topic.addressed:
            self.publish(topic, message, vehicle=self.victim)
            return
        for process in self._addresses():
            self.publish(topic, message, process=process, vehicle=self.victim)

    def _addresses(self) -> tuple[Name, ...]:
        """Return the processes with an agent for the victim."""
        assert self.victim is not None
        on_road = self.known(Census).on_road
        processes = {entry.vehicle: entry.processes for entry in on_road}
        return addresses_of(self.victim, processes.get(self.victim, ()))

    def change(self, topic: Topic, **changes: object) -> None:
        """Publish a message of the road with some fields changed."""
        assert topic.kind is not None
        self.publish(topic, changed(self.known(topic.kind), **changes))

    def change_victims(self, topic: Topic, **changes: object) -> None:
        """Publish a message of the victim or for it with some fields changed."""
        assert topic.kind is not None
        self.to_victim(topic, changed(self.known(topic.kind), **changes))

    def state(self, **changes: object) -> None:
        """Publish a state in the name of the victim."""
        state = changed(self.known(VehicleState), **changes)
        self.publish(STATE, state, block=state.block, vehicle=state.vehicle)

    def prepare(self, term: int) -> None:
        """Publish a PREPARE for the victim."""
        blocks = self.known(VehicleState).record.joined
        ballot = HIGH._replace(term=term)
        self.to_victim(PREPARE, Prepare(ballot, blocks, (self.victim or Name("x"),)))

    def heartbeat(self, term: int) -> None:
        """Publish a heartbeat in the name of a candidate that does not lead."""
        forged = Heartbeat(Name("zz"), 1, term, leading=False, plans=0)
        self.publish(HEARTBEAT, forged, coordinator="zz")

    def report(self, role: str, name: str, **counters: Any) -> None:  # noqa: ANN401
        """Publish a report."""
        message = Report(Name(role), Name(name), Name("forger"), **counters)
        self.publish(REPORT, message, role=role, name=name)

    def flip_token(self, incarnation: int) -> None:
        """Show the token of a bridge, or withdraw it."""
        key = self._keys.key(BRIDGE_ALIVE, incarnation=incarnation)
        if key in self._tokens:
            self._transports[0].withdraw(key)
        else:
            self._transports[0].announce(key)
        self._tokens ^= {key}

    def withdraw_tokens(self) -> None:
        """Withdraw all tokens."""
        for key in self._tokens:
            self._transports[0].withdraw(key)
        self._tokens.clear()

    def close(self) -> None:
        for transport in self._transports:
            transport.close()


HUGE = 2**63 - 1
HIGH = Ballot(HUGE, Name("zz"), HUGE, HUGE)
NOW_NS = time.time_ns
HOUR_NS = 3600 * 10**9
TOMORROW = time.time_ns() + 24 * HOUR_NS
"""Incarnation of a bridge whose token is shown; the same one each time."""
ROWS: Mapping[str, Callable[[Forger], None]] = {
    "prepare": lambda forger: forger.prepare(HUGE),
    "prepare-possible": lambda forger: forger.prepare(max_term(forger.t_s)),
    "state-term": lambda forger: forger.state(promised=HIGH),
    "state-term-possible": lambda forger: forger.state(
        promised=HIGH._replace(term=max_term(forger.t_s))
    ),
    "state-transfer-term": lambda forger: forger.state(transfer=PendingTransfer(HIGH)),
    "heartbeat-term": lambda forger: forger.heartbeat(term=HUGE),
    "heartbeat-term-2**62": lambda forger: forger.heartbeat(term=2**62),
    "heartbeat-term-possible": lambda forger: forger.heartbeat(term=100_000),
    "clock-bridge": lambda forger: forger.change(CLOCK, bridge=HUGE),
    "clock-bridge-possible": lambda forger: forger.change(CLOCK, bridge=NOW_NS() + HOUR_NS),
    "clock-time": lambda forger: forger.change(CLOCK, t_s=1e12, tick=10**13),
    "clock-time-possible": lambda forger: forger.change(CLOCK, t_s=9e4, tick=900_000),
    "census-time": lambda forger: forger.change(CENSUS, t_s=1e12, on_road=(), announced=()),
    "census-bridge": lambda forger: forger.change(CENSUS, bridge=HUGE, on_road=(), announced=()),
    "census-empty": lambda forger: forger.change(
        CENSUS, t_s=forger.t_s + 5.0, on_road=(), formations=()
    ),
    "token": lambda forger: forger.flip_token(HUGE),
    "token-possible": lambda forger: forger.flip_token(TOMORROW),
    "state-time": lambda forger: forger.state(t_s=1e12),
    "state-incarnation": lambda forger: forger.state(incarnation=2**62),
    "command-incarnation": lambda forger: forger.change_victims(COMMAND, incarnation=HUGE),
    "sense-in_charge": lambda forger: forger.change_victims(SENSE, incarnation=HUGE),
    "sense-caretaker": lambda forger: forger.change_victims(
        SENSE, incarnation=HUGE, caretaker=True, tick=forger.known(Sense).tick + 1
    ),
    "sense-bridge": lambda forger: forger.change_victims(SENSE, bridge=HUGE),
    "sense-bridge-possible": lambda forger: forger.change_victims(SENSE, bridge=NOW_NS() + HOUR_NS),
    "report": lambda forger: forger.report("coordinator", "zz", published=HUGE, rejected=HUGE),
    "report-negative": lambda forger: forger.report("coordinator", "zz", rejected=-(2**62)),
    "report-solves": lambda forger: forger.report("coordinator", "zz", solves=HUGE),
    "sense-tick": lambda forger: forger.change_victims(SENSE, tick=HUGE),
    "sense-tick-possible": lambda forger: forger.change_victims(SENSE, tick=900_000, t_s=9e4),
}
"""What is forged, with values that are impossible, and some that are possible but wrong."""
