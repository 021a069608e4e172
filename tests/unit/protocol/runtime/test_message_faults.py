"""Message faults before a core: what is lost, doubled, late; and that nothing else is touched."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import pytest
from attrs import define

from laneweave.protocol.runtime import delaying_core, message_faults, node
from laneweave.protocol.runtime.message_faults import FaultyCore, MessageRule
from laneweave.protocol.runtime.metrics import RouterMetrics
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.messages import Ballot, Heartbeat, Name, Prepare, RoadClock
from laneweave.protocol.wire.process_messages import LogEvent, Report
from support.node_recorder import Recorder, at_start, beat
from support.refusals import refusal


@define
class Board:
    road_s: float = 0.0
    dropped: int = 0


def arrived(number: int, topic: topics.Topic = topics.STATE, **parameters: str) -> node.Arrived:
    return node.Arrived(topic, parameters, beat(number).message)


def faulty(
    *rules: MessageRule, board: Board | None = None, receiver: str = "vehicle", seed: str = "1"
) -> tuple[FaultyCore, Recorder]:
    listener = Recorder()
    return FaultyCore(listener, rules, board or Board(), receiver=receiver, seed=seed), listener


def feed(core: FaultyCore, event: node.Event, now_s: float = 0.0) -> list[node.Effect]:
    return list(core.handle(event, now_s))


def run_until(core: FaultyCore, end_s: float) -> None:
    """Wake the core whenever it wants to be woken."""
    while (wakeup_s := core.wakeup_s) is not None and wakeup_s <= end_s:
        feed(core, node.Wakeup(), wakeup_s)


def received(rule: MessageRule, count: int = 2000, seed: str = "1") -> list[int]:
    core, listener = faulty(rule, seed=seed)
    for number in range(count):
        feed(core, arrived(number))
    run_until(core, 100.0)
    return listener.numbers


def test_metrics_of_the_wrapped_core_are_visible() -> None:
    @define
    class Counting(Recorder):
        @property
        def metrics(self) -> list[RouterMetrics]:
            return [RouterMetrics(7)]

    core = FaultyCore(Counting(), (), Board(), receiver="vehicle", seed="1")
    found = node.Node(core, Mock(), topics.Keys("test"), lambda _: None, Name("1")).metrics()
    assert found[1:] == [RouterMetrics(7)]
    assert list(faulty()[0].metrics) == []


@pytest.mark.parametrize(
    ("rule", "share"),
    [
        (MessageRule(loss=0.1), 0.9),
        (MessageRule(loss=0.5), 0.5),
        (MessageRule(loss=0.9), 0.1),
        (MessageRule(duplication=0.25), 1.25),
        (MessageRule(duplication=1.0), 2.0),
    ],
)
def test_loss_and_duplication_affect_their_share(rule: MessageRule, share: float) -> None:
    passed = received(rule, 5000)
    assert passed == sorted(passed)
    assert len(passed) / 5000 == pytest.approx(share, abs=0.02 if rule.duplication < 1.0 else 0.0)
    assert max(map(passed.count, range(100))) <= (2 if rule.duplication else 1)


def test_duplicates_do_not_depend_on_the_loss() -> None:
    lossless = received(MessageRule(duplication=0.5))
    lossy = received(MessageRule(duplication=0.5, loss=0.3))
    doubled = {number for number in lossless if lossless.count(number) == 2}
    assert {number for number in lossy if lossy.count(number) == 2} == doubled & set(lossy)


def test_rules_add_up_and_a_delay_keeps_the_order() -> None:
    core, listener = faulty(
        MessageRule(duplication=1.0, delay_s=0.2), MessageRule(duplication=1.0, delay_s=0.3)
    )
    for number in range(5):
        feed(core, arrived(number), 0.1 * number)
    assert listener.events == []
    assert core.wakeup_s == 0.5
    run_until(core, 0.75)
    assert listener.numbers == 4 * [0] + 4 * [1] + 4 * [2]
    run_until(core, 10.0)
    assert listener.numbers[::4] == [0, 1, 2, 3, 4]
    times_s = [now_s for now_s, _ in listener.events[::4]]
    assert times_s == pytest.approx([0.5, 0.6, 0.7, 0.8, 0.9])


def test_jitter_longer_than_the_spacing_reorders_and_each_copy_has_its_own() -> None:
    core, listener = faulty(MessageRule(duplication=1.0, delay_s=0.1, jitter_s=1.0))
    for number in range(200):
        feed(core, arrived(number), 0.1 * number)
        run_until(core, 0.1 * number)
    run_until(core, 100.0)
    assert sorted(listener.numbers) == sorted(2 * list(range(200)))
    assert listener.numbers != sorted(listener.numbers)
    assert len({now_s for now_s, _ in listener.events}) == 400
    for now_s, event in listener.events:
        assert isinstance(event, node.Arrived)
        assert 0.1 <= now_s - 0.1 * event.message.term <= 1.1 + 1e-9


def test_a_rule_holds_in_its_window_of_road_time() -> None:
    board = Board()
    core, listener = faulty(MessageRule(loss=1.0, from_s=10.0, until_s=20.0), board=board)
    for road_s in (0.0, 9.9, 10.0, 19.9, 20.0, 30.0):
        board.road_s = road_s
        # The node's clock has nothing to do with it.
        feed(core, arrived(int(road_s * 10)), now_s=1000.0)
    assert listener.numbers == [0, 99, 200, 300]
    assert board.dropped == 2
    assert core.wakeup_s is None


def test_a_rule_is_for_its_topics() -> None:
    core, listener = faulty(MessageRule(topics=("state", "plan"), loss=1.0))
    feed(core, arrived(1, topics.STATE))
    feed(core, arrived(2, topics.HEARTBEAT))
    assert listener.numbers == [2]


V1, C1, BRIDGE = ("vehicle", "v1"), ("coordinator", "c1"), ("bridge", "bridge")
PROMISE = Prepare(Ballot(1, Name("c1"), 1, 1), (), ())


@pytest.mark.parametrize(
    ("topic", "parameters", "message", "sender"),
    [
        (topics.STATE, {"block": "1", "vehicle": "v1"}, None, V1),
        (topics.COMMAND, {"vehicle": "v1"}, None, V1),
        (topics.HEARTBEAT, {"coordinator": "c1"}, None, C1),
        (topics.PREPARE, {"vehicle": "v9"}, PROMISE, C1),
        (topics.CLOCK, {}, None, BRIDGE),
        (topics.SENSE, {"vehicle": "v9"}, None, BRIDGE),
        (topics.REPORT, {"role": "agent", "name": "v1"}, None, V1),
        (topics.EVENT, {"role": "coordinator", "name": "c1"}, None, C1),
    ],
)
def test_a_rule_names_a_single_sender(
    topic: topics.Topic,
    parameters: dict[str, str],
    message: Prepare | None,
    sender: tuple[str, str],
) -> None:
    event = node.Arrived(topic, parameters, message or beat(1).message)
    for named in ("v1", "v2", "c1", "c2", "vehicle", "coordinator", "bridge"):
        core, listener = faulty(MessageRule(loss=1.0, sender=named))
        feed(core, event)
        assert (listener.events == []) is (named in sender), named


def process(kind: str, names: tuple[str, ...], *rules: MessageRule) -> tuple[FaultyCore, Recorder]:
    listener = Recorder()
    return FaultyCore(listener, rules, Board(), receiver=kind, seed="1", names=names), listener


def test_a_rule_names_a_single_receiver() -> None:
    rule = MessageRule(loss=1.0, receiver="v1")
    for kind, name in (("vehicle", "v1"), ("vehicle", "v2"), ("coordinator", "c1")):
        core, listener = process(kind, (name,), rule)
        feed(core, arrived(1, vehicle="v3"))
        assert (listener.events == []) is (name == "v1"), name


def test_of_several_vehicles_in_a_process_only_the_named_one_loses_what_is_sent_to_it() -> None:
    core, listener = process("vehicle", ("v1", "v2"), MessageRule(loss=1.0, receiver="v1"))
    feed(core, arrived(1, topics.SENSE, vehicle="v1"))
    feed(core, arrived(2, topics.SENSE, vehicle="v2"))
    assert listener.numbers == [2]
    # The state of another vehicle has no address: the process receives it once, for both.
    feed(core, arrived(3, vehicle="v3"))
    assert listener.numbers == [2]


def test_between_is_symmetrical() -> None:
    rule = MessageRule(loss=1.0, between=("v1", "v2"))
    for receiver, lost in (("v1", {"v2"}), ("v2", {"v1"}), ("v3", set())):
        for sender in ("v1", "v2", "v3"):
            core, listener = process("vehicle", (receiver,), rule)
            feed(core, arrived(1, vehicle=sender))
            assert (listener.events == []) is (sender in lost), (sender, receiver)


def test_all_conditions_of_a_rule_must_hold() -> None:
    rule = MessageRule(loss=1.0, topics=("motion",), sender="v2", receiver="v1", from_s=5.0)
    lost = []
    for topic in (topics.STATE, topics.MOTION):
        for road_s in (4.0, 5.0):
            board = Board(road_s)
            listener = Recorder()
            core = FaultyCore(listener, (rule,), board, receiver="vehicle", seed="1", names=("v1",))
            feed(core, arrived(1, topic, vehicle="v2"))
            if not listener.events:
                lost.append((topic.name, road_s))
    assert lost == [("motion", 5.0)]


@pytest.mark.parametrize(
    ("topic", "parameters", "sender"),
    [
        (topics.STATE, {}, "vehicle"),
        (topics.HEARTBEAT, {}, "coordinator"),
        (topics.CLOCK, {}, "bridge"),
        (topics.REPORT, {"role": "agent", "name": "v1"}, "vehicle"),
        (topics.EVENT, {"role": "coordinator", "name": "c1"}, "coordinator"),
        (topics.EVENT, {"role": "bridge", "name": "bridge"}, "bridge"),
    ],
)
def test_a_rule_is_for_its_sender_and_its_receiver(
    topic: topics.Topic, parameters: dict[str, str], sender: str
) -> None:
    for named in message_faults.SENDERS:
        for rule in (MessageRule(loss=1.0, sender=named), MessageRule(loss=1.0, receiver=named)):
            core, listener = faulty(rule, receiver=sender)
            feed(core, arrived(1, topic, **parameters))
            assert (listener.events == []) is (named == sender)


def test_equal_seeds_give_equal_fates_and_others_others() -> None:
    rule = MessageRule(loss=0.5, duplication=0.5, jitter_s=0.5)
    assert received(rule, seed="7/c1/1") == received(rule, seed="7/c1/1")
    assert received(rule, seed="7/c1/1") != received(rule, seed="7/c2/1")


def test_the_fates_of_one_topic_do_not_depend_on_another() -> None:
    rule = MessageRule(loss=0.5)
    core, listener = faulty(rule)
    for number in range(200):
        feed(core, arrived(number, topics.STATE))
        feed(core, arrived(-1, topics.HEARTBEAT))
    assert [number for number in listener.numbers if number >= 0] == received(rule, 200)


def test_events_other_than_messages_pass_unchanged() -> None:
    core, listener = faulty(MessageRule(loss=1.0))
    events: list[node.Event] = [
        node.Started(),
        node.PeerUp(topics.COORDINATOR_ALIVE, {}),
        node.PeerDown(topics.COORDINATOR_ALIVE, {}),
        LinkDown(),
        LinkUp(),
        node.QueryArrived(1, b""),
        node.Stopping(),
    ]
    for event in events:
        feed(core, event)
    assert [event for _, event in listener.events] == events


@pytest.mark.parametrize("wanted_s", [0.5, 1.0, 3.0])
def test_the_core_is_woken_when_it_wants_and_not_for_delayed_messages(wanted_s: float) -> None:
    core, listener = faulty(MessageRule(delay_s=1.0))
    listener.wakeup_s = wanted_s

    def clear(event: node.Event, _: float) -> tuple[node.Effect, ...]:
        if isinstance(event, node.Wakeup):
            listener.wakeup_s = None
        return ()

    listener.on_event = clear
    feed(core, arrived(1), 0.0)
    run_until(core, 5.0)
    expected: list[tuple[float, node.Event]] = [(1.0, arrived(1)), (wanted_s, node.Wakeup())]
    assert listener.events == sorted(expected, key=lambda entry: entry[0])
    assert core.wakeup_s is None


def test_no_more_messages_are_delayed_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delaying_core, "MAX_HELD", 5)
    board = Board()
    core, listener = faulty(MessageRule(delay_s=1.0), board=board)
    for number in range(8):
        feed(core, arrived(number))
    run_until(core, 1.0)
    assert listener.numbers == [0, 1, 2, 3, 4]
    assert board.dropped == 3


def test_effects_pass() -> None:
    core, listener = faulty()
    heartbeat = Heartbeat(Name("c1"), 1, 1, leading=False, plans=0)
    event = LogEvent(Name("agent"), Name("v1"), 0.0, Name("kind"))
    report = Report(Name("agent"), Name("v1"), solves=3)
    effects: list[node.Effect] = [
        node.Send(topics.HEARTBEAT, heartbeat),
        node.Send(topics.EVENT, event, {"role": "agent"}),
        node.Send(topics.REPORT, report, {"role": "agent"}),
    ]
    listener.on_event = lambda *_: effects
    assert feed(core, node.Started()) == effects


def test_the_clock_of_the_bridge_sets_the_road_time() -> None:
    board = Board()
    core, listener = faulty(board=board, receiver="bridge")
    listener.on_event = at_start(
        node.Send(topics.CLOCK, RoadClock(125, 12.5, 3, 2, 1, 1, ended=False))
    )
    feed(core, node.Started())
    assert board.road_s == 12.5


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"loss": 1.1}, "loss"),
        ({"duplication": -0.1}, "duplication"),
        ({"delay_s": -1.0}, "delay_s"),
        ({"jitter_s": 61.0}, "jitter_s"),
        ({"topics": ("states",)}, "topics"),
        ({"topics": ("vehicle-alive",)}, "topics"),
        ({"sender": "v 1"}, "sender"),
        ({"receiver": ""}, "receiver"),
        ({"between": ("v1", "v1")}, "between"),
        ({"between": ("v1", "*")}, "between"),
        ({"between": ("v1", "v2"), "sender": "c1"}, "between"),
        ({"from_s": 5.0, "until_s": 5.0}, "until_s"),
    ],
)
def test_what_is_wrong_with_a_rule_is_named(values: dict[str, Any], name: str) -> None:
    assert refusal(MessageRule, **values).field == name
