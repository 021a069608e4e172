"""The node: malformed input is counted, effects reach the transport, `End` closes."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock, call

import msgpack
import pytest
from attrs import define, field
from msgspec.structs import replace

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import NodeMetrics
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Compute,
    Computed,
    Decline,
    Delegate,
    Effect,
    End,
    Event,
    Listen,
    MessagesDropped,
    Node,
    PeerDown,
    PeerUp,
    QueryArrived,
    Refuse,
    Reply,
    Send,
    Serve,
    Started,
    StopJob,
    Unlisten,
    Wakeup,
    Watch,
    Withdraw,
    read_message,
    run_job,
)
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
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.codec import MAX_BYTES, decode, encode
from laneweave.protocol.wire.messages import Heartbeat, Name, RoadClock
from laneweave.protocol.wire.process_messages import LogEvent, Report
from support.node_recorder import Recorder, at_start
from support.wire_samples import different, filled

KEYS = topics.Keys("r")
BEAT = Heartbeat(Name("c1"), 7, 2, leading=True, plans=1)
BEAT_KEY = "laneweave/r/heartbeat/c1"


@define
class Bench:
    """A node with its recording core and transport."""

    core: Recorder = field(factory=Recorder)
    transport: Mock = field(factory=lambda: Mock(spec=Transport))
    jobs: list[Compute | Delegate | StopJob] = field(factory=list)
    node: Node = field(init=False)

    @node.default
    def _make_node(self) -> Node:
        return Node(self.core, self.transport, KEYS, self.jobs.append, Name("n1"))

    def messages(self) -> list[object]:
        """Return the messages that have arrived at the core."""
        return [event.message for _, event in self.core.events if isinstance(event, Arrived)]

    def carry_out(self, *effects: Effect) -> list[Any]:
        """Have the node carry out effects; return the calls of its transport."""
        self.core.on_event = lambda *_: effects
        self.node.dispatch(Wakeup(), 1.0)
        return self.transport.mock_calls


@pytest.fixture
def bench() -> Bench:
    return Bench()


# --- what comes in ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("delivery", "event"),
    [
        (Received(BEAT_KEY, encode(BEAT)), Arrived(topics.HEARTBEAT, {"coordinator": "c1"}, BEAT)),
        (Overflow(BEAT_KEY), MessagesDropped(topics.HEARTBEAT, {"coordinator": "c1"})),
        (LinkUp(), LinkUp()),
        (LinkDown(), LinkDown()),
        (Query("laneweave/r/service/plan", b"q", 4), QueryArrived(4, b"q")),
        (
            Query(
                "laneweave/r/service/cancel", b"q", 4, sender="laneweave/r/alive/client/s/dispatch"
            ),
            QueryArrived(
                4,
                b"q",
                topic=topics.SERVICE_CANCEL,
                sender={"session": "s", "client": "dispatch"},
            ),
        ),
        (
            Query("laneweave/r/service/plan", b"q", 4, sender="laneweave/r/alive/client/s/é"),
            QueryArrived(4, b"q"),
        ),
        (
            TokenUp("laneweave/r/alive/vehicle/p/v1"),
            PeerUp(topics.VEHICLE_ALIVE, {"process": "p", "vehicle": "v1"}),
        ),
        (
            TokenDown("laneweave/r/alive/coordinator/c1/17"),
            PeerDown(topics.COORDINATOR_ALIVE, {"coordinator": "c1", "incarnation": "17"}),
        ),
    ],
)
def test_deliveries_become_events(bench: Bench, delivery: Delivery, event: Event) -> None:
    bench.node.deliver(delivery, 1.0)
    assert bench.core.events == [(1.0, event)]


def test_a_repeated_message_is_decoded_once_and_arrives_each_time(bench: Bench) -> None:
    other = replace(BEAT, term=3)
    for beat in (BEAT, other, BEAT):
        bench.node.deliver(Received(BEAT_KEY, encode(beat)), 1.0)
    first, second, third = bench.messages()
    assert (first, second) == (BEAT, other)
    assert third is first


def test_a_large_message_is_not_remembered(bench: Bench) -> None:
    event = LogEvent(Name("bridge"), Name("b"), 0.0, Name("x"), {"text": "x" * 3000})
    for _ in range(2):
        bench.node.deliver(Received("laneweave/r/event/bridge/b", encode(event)), 1.0)
    first, second = bench.messages()
    assert first == second
    assert first is not second


def test_a_core_may_refuse_what_it_receives(bench: Bench) -> None:
    refuse = Refuse(BadInputError("term", 2**63 - 1, "less"))
    bench.core.on_event = lambda *_: [refuse]
    for delivery in (
        Received(BEAT_KEY, encode(BEAT)),
        TokenUp("laneweave/r/alive/bridge/17"),
        LinkUp(),
    ):
        bench.node.deliver(delivery, 1.0)
    assert bench.node.rejected == 3
    assert bench.transport.mock_calls == []


def deep_field(depth: int) -> bytes:
    body: bytes = msgpack.packb([2, "Heartbeat", ["HERE"]])
    return body.replace(b"\xa4HERE", b"\x91" * depth + b"\x01")


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x91" * 5000,
        b"\0" * (MAX_BYTES + 1),
        encode(BEAT)[:-1],
        encode(BEAT) + b"\0",
        encode(RoadClock(1, 1.0, 0, 0, 0, 0, ended=False)),
        msgpack.packb([2, "Heartbeat", {1: 2, None: 3, b"x": 4}]),
        msgpack.packb([2, "Heartbeat", [[[[[[[1]]]]]]]]),
        deep_field(900),
        msgpack.packb([2, "Heartbeat", "x" * 100_000]),
        msgpack.packb({}),
    ],
    ids=range(12),
)
def test_a_malformed_payload_is_counted_and_not_raised(bench: Bench, payload: bytes) -> None:
    for _ in range(3):
        bench.node.deliver(Received(BEAT_KEY, payload), 1.0)
    assert bench.node.rejected == 3
    assert bench.core.events == []


@pytest.mark.parametrize(
    "key",
    ["", "x", "laneweave/other/heartbeat/c1", "laneweave/r/heartbeat", "laneweave/r/heartbeat/é",
     "laneweave/r/heartbeat/{coordinator}", "laneweave/r/heartbeat/c1/x"],
)  # fmt: skip
def test_an_unknown_topic_is_counted(bench: Bench, key: str) -> None:
    bench.node.deliver(Received(key, encode(BEAT)), 1.0)
    bench.node.deliver(TokenUp(key), 1.0)
    bench.node.deliver(TokenDown(key), 1.0)
    assert bench.node.rejected == 3
    assert bench.core.events == []


@pytest.mark.parametrize("key", ["laneweave/r/alive/vehicle/p/v1", "laneweave/r/service/plan"])
def test_a_message_on_a_topic_without_messages_is_counted(bench: Bench, key: str) -> None:
    bench.node.deliver(Received(key, encode(BEAT)), 1.0)
    assert bench.node.rejected == 1
    assert bench.core.events == []


# --- what goes out ----------------------------------------------------------------------------


FORGED = [
    (topic, name)
    for topic in topics.TOPICS
    if topic.kind is not None
    for name in topic.named_in_key
]
"""Topics, and parameters of their keys that their messages contain."""


@pytest.mark.parametrize(("topic", "name"), FORGED, ids=lambda one: getattr(one, "name", one))
def test_a_message_has_the_names_in_its_key(topic: topics.Topic, name: str) -> None:
    """A router grants the rights of a sender for its keys."""
    assert topic.kind is not None
    message: Any = filled(topic.kind, different())
    known = dict.fromkeys(topic.parameters, "p")
    known |= {one: str(getattr(message, one)) for one in topic.named_in_key}
    keys = topics.Keys("here")
    arrived = read_message(keys, keys.key(topic, **known), encode(message))
    assert (arrived.message, arrived.parameters) == (message, known)
    other = keys.key(topic, **(known | {name: "7"}))
    with pytest.raises(BadInputError, match="7, as in its key"):
        read_message(keys, other, encode(message))


def test_vehicles_and_coordinators_speak_for_themselves_only() -> None:
    assert {(topic.name, name) for topic, name in FORGED} >= {
        ("state", "vehicle"), ("command", "vehicle"), ("motion", "vehicle"),
        ("heartbeat", "coordinator"), ("event", "name"), ("settings", "name"), ("report", "name"),
    }  # fmt: skip


def test_effects_reach_the_transport(bench: Bench) -> None:
    work = Compute(1, lambda _: 2)
    calls = bench.carry_out(
        Listen(topics.STATE, {"block": 3}),
        Listen(topics.CENSUS),
        Unlisten(topics.STATE, {"block": 3}),
        Announce(topics.VEHICLE_ALIVE, {"process": "p", "vehicle": "v1"}),
        Withdraw(topics.VEHICLE_ALIVE, {"process": "p", "vehicle": "v1"}),
        Watch(topics.VEHICLE_ALIVE),
        Serve(topics.SERVICE),
        Reply(5, b"a"),
        Reply(6, b"e", ok=False, encoding="application/json"),
        Decline(7),
        StopJob(1),
        Send(topics.HEARTBEAT, BEAT, {"coordinator": "c1"}),
        work,
    )
    assert calls == [
        call.subscribe("laneweave/r/state/3/*"),
        call.subscribe("laneweave/r/census"),
        call.unsubscribe("laneweave/r/state/3/*"),
        call.announce("laneweave/r/alive/vehicle/p/v1"),
        call.withdraw("laneweave/r/alive/vehicle/p/v1"),
        call.watch("laneweave/r/alive/vehicle/*/*"),
        call.serve("laneweave/r/service/plan"),
        call.answer(5, b"a", ok=True, encoding=""),
        call.answer(6, b"e", ok=False, encoding="application/json"),
        call.decline(7),
        call.publish(BEAT_KEY, encode(BEAT), topics.Quality.LATEST),
    ]
    assert bench.jobs == [StopJob(1), work]


def test_a_report_gets_the_counters_of_the_node(bench: Bench) -> None:
    for _ in range(4):
        bench.node.deliver(Received(BEAT_KEY, b"x"), 1.0)
    beat = Send(topics.HEARTBEAT, BEAT, {"coordinator": "c1"})
    report = Report(
        Name("coordinator"), Name("c1"), published=99, solves=5, unusable=1, solve_ms=b"\0" * 4
    )
    calls = bench.carry_out(
        beat, beat, beat, Send(topics.REPORT, report, {"role": "coordinator", "name": "c1"})
    )
    sent = decode(calls[-1].args[1], Report)
    assert sent == replace(report, process=Name("n1"), published=4, rejected=4)
    assert bench.node.published == 4


def test_a_node_tells_what_it_has_counted(bench: Bench) -> None:
    node = bench.node
    bench.core.on_event = at_start(Send(topics.HEARTBEAT, BEAT, {"coordinator": "c1"}))
    node.dispatch(Started(), 0.0)
    node.deliver(Received(BEAT_KEY, encode(BEAT)), 1.0)
    node.deliver(Received(BEAT_KEY, b"nonsense"), 1.0)
    node.deliver(LinkDown(), 1.0)
    (found,) = node.metrics()
    assert found == NodeMetrics(1, {"heartbeat": 1}, 1, 0, 3, 0.0)


def test_end_closes_the_transport_and_nothing_is_handled_any_more(bench: Bench) -> None:
    assert bench.carry_out(End()) == [call.close()]
    assert bench.node.ended
    events = list(bench.core.events)
    bench.node.dispatch(Wakeup(), 2.0)
    bench.node.deliver(Received(BEAT_KEY, encode(BEAT)), 2.0)
    bench.node.deliver(LinkDown(), 2.0)
    assert bench.core.events == events
    assert bench.transport.mock_calls == [call.close()]


# --- computations -----------------------------------------------------------------------------


def test_a_computation_brings_its_result_or_its_failure() -> None:
    def fail(_: object) -> None:
        raise RuntimeError("no luck")

    assert run_job(Compute(3, lambda _: [1])) == Computed(3, [1])
    assert run_job(Compute(4, fail)) == Computed(4, None, "RuntimeError: no luck")
