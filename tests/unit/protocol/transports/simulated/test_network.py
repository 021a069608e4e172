"""The network in virtual time: messages, tokens, the router, faults of nodes."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest

from laneweave.protocol.runtime import node
from laneweave.protocol.runtime.transport import Answer, LinkDown, LinkUp
from laneweave.protocol.transports.simulated.network import (
    KILL_SEEN_S,
    REJOIN_S,
    SimulatedNetwork,
)
from laneweave.protocol.transports.simulated.parcels import Parcel
from laneweave.protocol.transports.simulated.virtual_time import Clock, Conditions
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.topics import COMMAND, HEARTBEAT, SERVICE, VEHICLE_ALIVE, Keys
from support.node_recorder import (
    CALM,
    REALM,
    Recorder,
    at_start,
    beat,
    listener,
    network_of,
    perform,
    send,
    token,
)
from support.tables import for_each

KEY = Keys(REALM).key(HEARTBEAT, coordinator="a")
BEAT = encode(beat(4).message)


# --- messages ---------------------------------------------------------------------------------


def test_without_faults_each_message_arrives_once_and_in_order() -> None:
    receiver = listener()
    network = network_of(a=Recorder(), b=receiver)
    send(network, "a", *range(100))
    network.run(1.0)
    assert receiver.numbers == list(range(100))
    assert receiver.times(node.Arrived) == pytest.approx([0.102] * 100)
    assert network.dropped == 0


@pytest.mark.parametrize("loss", [0.1, 0.5, 0.9])
def test_messages_are_lost_at_the_given_rate(loss: float) -> None:
    receivers = {name: listener() for name in ("b", "c")}
    network = network_of(Conditions(loss=loss), more=receivers, a=Recorder())
    send(network, "a", *range(2000))
    network.run(1.0)
    lost = [2000 - len(core.numbers) for core in receivers.values()]
    # Four standard deviations.
    spread = 4 * (2000 * loss * (1 - loss)) ** 0.5
    assert all(abs(count - 2000 * loss) < spread for count in lost)
    assert network.dropped == sum(lost)
    # Each receiver has a fate of its own.
    assert set(receivers["b"].numbers) != set(receivers["c"].numbers)


def test_messages_are_duplicated_at_the_given_rate() -> None:
    receiver = listener()
    network = network_of(Conditions(duplication=0.25), a=Recorder(), b=receiver)
    send(network, "a", *range(2000))
    network.run(1.0)
    assert set(receiver.numbers) == set(range(2000))
    assert abs(len(receiver.numbers) - 2500) < 80
    assert max(map(receiver.numbers.count, range(50))) == 2


def test_messages_overtake_each_other_with_jitter() -> None:
    receiver = listener()
    network = network_of(Conditions(jitter_s=0.01), a=Recorder(), b=receiver)
    send(network, "a", *range(100))
    network.run(1.0)
    assert sorted(receiver.numbers) == list(range(100))
    assert receiver.numbers != sorted(receiver.numbers)
    assert all(0.102 <= now_s <= 0.112 + 1e-9 for now_s in receiver.times(node.Arrived))


def test_a_hindrance_loses_messages_where_it_says_until_it_ends() -> None:
    receivers = {name: listener() for name in ("b", "c")}
    network = network_of(more=receivers, a=Recorder())
    lost_between = ("a", "b")
    network.hinder(lambda *names_and_key: math.inf if names_and_key[:2] == lost_between else 0.0)
    send(network, "a", 1)
    send(network, "c", 2)
    network.run(0.2)
    assert receivers["b"].numbers == [2]
    assert receivers["c"].numbers == [1, 2]
    assert network.dropped == 1
    network.hinder(None)
    send(network, "a", 3)
    network.run(0.3)
    assert receivers["b"].numbers == [2, 3]


def test_a_hindrance_delays_messages_of_a_key() -> None:
    receiver = listener()
    network = network_of(a=Recorder(), b=receiver)
    network.hinder(lambda _sender, _receiver, key: 0.5 if key == KEY else 0.0)
    send(network, "a", 1)
    network.run(0.5)
    assert receiver.numbers == []
    network.run(0.7)
    assert receiver.numbers == [1]


def test_a_clock_jumps_ahead_and_keeps_its_rate() -> None:
    network = network_of(a=Recorder())
    network.set_clock("a", 1.0, 2.0)
    network.advance_clock("a", 0.5)
    assert network._clocks["a"] == Clock(1.5, 2.0)
    network.advance_clock("b", 0.5)
    assert network._clocks["b"] == Clock(0.5, 1.0)


def test_the_time_without_a_connection() -> None:
    network = network_of(a=Recorder())
    network.run(1.0)
    assert network.offline_s("a") == 0.0
    network.disconnect("a")
    network.run(1.5)
    assert network.offline_s("a") == 0.5
    network.pause("a")
    assert network.offline_s("a") == 0.0
    network.resume("a")
    network.reconnect("a")
    assert network.offline_s("a") == 0.0


@pytest.mark.parametrize("skip_codec", [False, True])
def test_injected_bytes_are_read_or_refused_by_each_receiver(*, skip_codec: bool) -> None:
    network = SimulatedNetwork(1, CALM, skip_codec=skip_codec)
    for name in ("a", "b"):
        network.add(name, listener(), REALM)
    network.run(0.1)
    for payload in (b"\xc1", b"\xc1", BEAT):
        network.inject(KEY, payload)
    network.run(1.0)
    for name in ("a", "b"):
        core = network.node(name).core
        assert isinstance(core, Recorder)
        assert core.numbers == [4]
        assert network.node(name).rejected == 2


@pytest.mark.parametrize("skip_codec", [False, True])
def test_a_message_arrives_as_the_same_object_or_an_equal_one(*, skip_codec: bool) -> None:
    network, receiver, sent = SimulatedNetwork(1, CALM, skip_codec=skip_codec), listener(), beat(7)
    network.add("b", receiver, REALM)
    network.add("a", Recorder(at_start(sent)), REALM)
    network.run(0.2)
    (arrived,) = receiver.of(node.Arrived)
    assert isinstance(arrived, node.Arrived)
    assert arrived.message == sent.message
    assert (arrived.message is sent.message) == skip_codec
    # An object on a key where it does not belong is refused, as its bytes would be.
    for key in (f"{KEY}/b", Keys(REALM).key(COMMAND, vehicle="a")):
        network.inject(key, Parcel(sent.message) if skip_codec else BEAT)
    network.run(0.3)
    assert receiver.of(node.Arrived) == [arrived]


def test_all_receivers_of_the_same_bytes_share_one_message() -> None:
    receivers = {name: listener() for name in ("b", "c")}
    network = network_of(Conditions(jitter_s=1.0, duplication=1.0), more=receivers, a=Recorder())
    send(network, "a", 1, 2)
    network.run(3.0)
    arrived = [event for core in receivers.values() for event in core.of(node.Arrived)]
    assert all(sorted(core.numbers) == [1, 1, 2, 2] for core in receivers.values())
    assert len({id(event.message) for event in arrived}) == 2  # type: ignore[union-attr]


def test_realms_in_one_network_do_not_mix() -> None:
    network = SimulatedNetwork(1, CALM)
    ours, theirs = listener(), listener()
    network.add("a", ours, "r")
    network.add("b", theirs, "s")
    network.run(0.1)
    network.inject("laneweave/r/heartbeat/a", BEAT)
    network.run(0.2)
    assert (ours.numbers, theirs.numbers) == ([4], [])
    network.inject("laneweave/s/heartbeat/a", BEAT)
    network.run(0.3)
    assert (ours.numbers, theirs.numbers) == ([4], [4])
    assert network.node("a").rejected == network.node("b").rejected == 0


def test_subscriptions_may_change_between_messages() -> None:
    receivers = {name: listener() for name in ("b", "c")}
    network = network_of(more=receivers, a=Recorder())
    send(network, "a", 1)
    perform(network, "b", node.Unlisten(HEARTBEAT))
    send(network, "a", 2)
    perform(network, "b", node.Listen(HEARTBEAT, {"coordinator": "a"}))
    send(network, "a", 3)
    send(network, "c", 4)
    network.run(0.2)
    assert receivers["b"].numbers == [1, 3]
    assert receivers["c"].numbers == [1, 2, 3, 4]


def test_nothing_is_sent_to_a_node_that_has_left() -> None:
    network = network_of(a=Recorder(), b=listener(), c=listener())
    send(network, "a", 1)
    network.kill("b")
    network.conditions = Conditions(loss=1.0)
    send(network, "a", 2)
    assert network.dropped == 1


# --- who is there -----------------------------------------------------------------------------


def watched(
    *more: node.Effect, jitter_s: float = 0.0
) -> tuple[SimulatedNetwork, Recorder, Recorder]:
    """Return a network in which `a` watches and `v` shows a token, and the two cores."""
    watcher, shown = listener(), Recorder(at_start(token("v"), *more))
    conditions = Conditions(delay_s=CALM.delay_s, jitter_s=jitter_s)
    return network_of(conditions, a=watcher, v=shown), watcher, shown


@pytest.mark.parametrize("how", ["kill", "stop", "end"])
def test_the_end_of_a_node_is_noticed_at_once(how: str) -> None:
    network, watcher, leaver = watched()
    leaver.on_event = lambda event, _: [beat(9, "v")] if isinstance(event, node.Stopping) else []
    if how == "end":
        perform(network, "v", node.End())
    else:
        getattr(network, how)("v")
    assert "v" not in network
    network.run(0.1 + KILL_SEEN_S + 0.002 + 1e-9)
    assert watcher.tokens == ["+v", "-v"]
    # Only a node that is asked to stop may still send something.
    assert len(leaver.of(node.Stopping)) == (how == "stop")
    assert watcher.numbers == ([9] if how == "stop" else [])


@pytest.mark.parametrize("paused", [False, True])
def test_a_watcher_that_comes_later_learns_who_is_there(*, paused: bool) -> None:
    network, _, _ = watched()
    if paused:
        network.pause("v")
    late = Recorder(at_start(node.Watch(VEHICLE_ALIVE)))
    network.add("late", late, REALM)
    network.run(0.3)
    network.resume("v")
    network.run(0.4)
    assert late.tokens == ["+v"]


@pytest.mark.parametrize(
    ("steps", "seen"),
    [
        (["resume v", 1.0], "+"),
        (["pause v", 0.4, "resume v", "pause v", 0.4 + CALM.lease_s - 0.01], "+"),
        (["pause v", 0.4, "resume v", "pause v", 0.4 + CALM.lease_s + 0.01], "+-"),
        (["pause v", 1.0, "kill v", 2.0], "+-"),
        (["disconnect a", "kill v", 1.0, "reconnect a", 2.0], "+-"),
        (["kill v", 0.1 + KILL_SEEN_S + 0.001, "disconnect a", "reconnect a", 2.0], "+-"),
    ],
    ids=["resumed awake", "lease not over", "lease over", "killed in a pause",
         "died while the link was down", "died as the link broke"],
)  # fmt: skip
def test_what_a_watcher_sees_of_a_node(steps: list[str | float], seen: str) -> None:
    network, watcher, _ = watched()
    for step in steps:
        if isinstance(step, str):
            verb, name = step.split()
            getattr(network, verb)(name)
        else:
            network.run(step)
    assert watcher.tokens == [f"{sign}v" for sign in seen]


def test_a_node_that_is_silent_for_its_lease_is_given_up_and_comes_back_as_a_zombie() -> None:
    network, watcher, zombie = watched(node.Listen(HEARTBEAT))
    zombie.wakeup_s = 0.2
    network.pause("v")
    network.run(0.1 + CALM.lease_s - 0.001)
    assert watcher.tokens == ["+v"]
    network.run(0.1 + CALM.lease_s + 0.01)
    assert watcher.tokens == ["+v", "-v"]
    send(network, "a", 1)
    network.run(3.0)
    assert zombie.numbers == []
    network.resume("v")
    assert zombie.numbers == [1]
    assert zombie.times(node.Arrived) == [3.0]
    network.run(3.1)
    assert watcher.tokens == ["+v", "-v", "+v"]
    assert zombie.times(node.Wakeup)[0] == 3.0


def test_a_paused_node_obeys_stop_when_it_wakes() -> None:
    network, _, sleeper = watched()
    network.pause("v")
    network.stop("v")
    network.run(0.2)
    assert "v" in network
    assert sleeper.of(node.Stopping) == []
    network.resume("v")
    assert "v" not in network
    assert len(sleeper.of(node.Stopping)) == 1


def test_a_disconnected_node_and_the_others_lose_each_other_and_find_each_other() -> None:
    start = (node.Listen(HEARTBEAT), node.Watch(VEHICLE_ALIVE))
    cores = {name: Recorder(at_start(*start, token(name))) for name in ("a", "b")}
    network = network_of(more=cores)
    assert sorted(cores["a"].tokens) == ["+a", "+b"]
    network.disconnect("b")
    network.disconnect("b")
    send(network, "a", 1)
    send(network, "b", 2)
    network.run(0.5)
    assert cores["a"].tokens[2:] == ["-b"]
    assert sorted(cores["b"].tokens[2:]) == ["-a", "-b"]
    assert len(cores["b"].of(LinkDown)) == 1
    assert cores["a"].of(LinkDown) == []
    assert cores["a"].numbers == [1]
    assert cores["b"].numbers == []
    network.reconnect("b")
    network.reconnect("b")
    send(network, "a", 3)
    network.run(1.0)
    assert cores["a"].tokens[3:] == ["+b"]
    assert sorted(cores["b"].tokens[4:]) == ["+a", "+b"]
    assert len(cores["b"].of(LinkUp)) == 1
    assert cores["b"].numbers == [3]


def test_link_down_may_come_anywhere_among_the_vanished_tokens() -> None:
    places = set()
    for seed in range(30):
        core = listener()
        network = network_of(
            seed=seed, a=core, b=Recorder(at_start(token("b"))), c=Recorder(at_start(token("c")))
        )
        network.disconnect("a")
        news = core.of(LinkDown, node.PeerDown)
        places.add(next(i for i, event in enumerate(news) if isinstance(event, LinkDown)))
    assert places == {0, 1, 2}


def test_what_is_under_way_is_lost_when_the_link_breaks() -> None:
    receiver = listener()
    network = network_of(a=Recorder(), b=receiver)
    send(network, "a", 1)
    perform(network, "a", token("a"))
    network.disconnect("b")
    network.reconnect("b")
    network.kill("a")
    network.run(1.0)
    assert receiver.numbers == []
    # The token was shown when `b` came back, and vanished after it.
    assert receiver.tokens == ["+a", "-a"]


@for_each("seed", range(20))
def test_news_of_a_token_never_overtake_each_other(seed: int) -> None:
    watcher = listener()
    network = network_of(Conditions(jitter_s=0.05), seed=seed, a=watcher, v=Recorder())
    for _ in range(5):
        perform(
            network, "v", token("v"), node.Withdraw(VEHICLE_ALIVE, {"process": "v", "vehicle": "v"})
        )
    perform(network, "v", token("v"))
    network.run(1.0)
    assert watcher.tokens == ["+v", "-v"] * 5 + ["+v"]


def test_a_node_started_again_under_its_name_gets_nothing_of_the_old_one() -> None:
    watcher = listener()

    def order(event: node.Event, _: float) -> Iterable[node.Effect]:
        start = at_start(token("v"), node.Listen(HEARTBEAT), node.Compute(1, lambda _: "old"))
        return start(event, 0.0)

    old = Recorder(order)
    old.wakeup_s = 0.15
    network = SimulatedNetwork(1, Conditions(jitter_s=0.0, compute_s=0.2))
    network.add("a", watcher, REALM)
    network.add("v", old, REALM)
    network.run(0.1)
    send(network, "a", 1)
    network.kill("v")
    new = Recorder(at_start(token("v"), node.Listen(HEARTBEAT)))
    network.add("v", new, REALM)
    network.run(1.0)
    assert new.of(node.Computed, node.Arrived, node.Wakeup) == []
    assert old.of(node.Computed) == []
    # The new node shows the token before the old one is missed.
    assert watcher.tokens[-1] == "+v"
    network.kill("v")
    network.run(2.0)
    assert watcher.tokens[-1] == "-v"


def test_faults_of_nodes_that_have_left_are_harmless_and_names_are_unique() -> None:
    network = network_of(a=Recorder(), v=Recorder())
    for fault in (network.kill, network.kill, network.stop, network.remove):
        fault("v")
    network.run(1.0)
    assert network.names == ("a",)
    with pytest.raises(ValueError, match="already"):
        network.add("a", Recorder(), REALM)


@pytest.mark.parametrize("moment", [LinkDown, LinkUp, node.PeerDown, node.Arrived, node.Computed])
def test_a_node_may_end_at_any_moment(moment: type) -> None:
    def end(event: node.Event, _: float) -> Iterable[node.Effect]:
        if isinstance(event, moment):
            return [
                node.End(),
                token("late"),
                node.Watch(VEHICLE_ALIVE),
                node.Listen(HEARTBEAT),
                beat(1, "v"),
            ]
        return at_start(token("v"), node.Listen(HEARTBEAT), node.Watch(VEHICLE_ALIVE))(event, 0.0)

    core, watcher = Recorder(end), listener()
    network = network_of(a=watcher, v=core, b=Recorder(at_start(token("b"))))
    network.disconnect("v")
    if "v" in network:
        network.reconnect("v")
    if "v" in network:
        network.pause("v")
        send(network, "a", 1)
        perform(network, "v", node.Compute(1, lambda _: 1))
        network.run(0.2)
        network.resume("v")
        network.run(0.3)
    assert "v" not in network
    network.run(1.0)
    assert "+late" not in watcher.tokens
    assert watcher.tokens[-1] == "-v"


# --- the router -------------------------------------------------------------------------------


def crowd(seed: int = 1) -> tuple[SimulatedNetwork, dict[str, Recorder]]:
    """Return a network in which every node shows a token, watches all, and hears all beats."""
    names = ("a", "b", "c", "d")
    cores = {
        name: Recorder(at_start(node.Listen(HEARTBEAT), node.Watch(VEHICLE_ALIVE), token(name)))
        for name in names
    }
    network = network_of(seed=seed, more=cores)
    for core in cores.values():
        assert sorted(core.tokens) == [f"+{name}" for name in names]
        core.events.clear()
    return network, cores


def test_without_the_router_all_lose_all_at_once_and_find_it_one_after_the_other() -> None:
    network, cores = crowd()
    send(network, "a", 1)
    network.lose_router()
    network.lose_router()
    for name, core in cores.items():
        assert sorted(core.tokens) == ["-a", "-b", "-c", "-d"]
        assert core.times(node.PeerDown) == [0.1] * 4
        assert core.times(LinkDown) == [0.1]
        send(network, name, 2)
    network.run(5.0)
    for core in cores.values():
        assert core.numbers == []
        assert core.of(LinkUp) == []
        assert len(core.tokens) == 4
    network.restore_router()
    network.restore_router()
    network.run(5.0 + REJOIN_S[1] + 0.01)
    times = [core.times(LinkUp) for core in cores.values()]
    assert all(len(one) == 1 and 5.2 <= one[0] <= 5.9 for one in times)
    assert len({one[0] for one in times}) == len(cores)
    for core in cores.values():
        assert sorted(core.tokens[4:]) == ["+a", "+b", "+c", "+d"]
    send(network, "a", 3)
    network.run(7.0)
    assert [core.numbers for core in cores.values()] == [[3]] * 4


def test_a_router_that_is_lost_again_is_not_found() -> None:
    network, cores = crowd()
    network.lose_router()
    network.restore_router()
    network.run(0.1 + REJOIN_S[0] - 0.01)
    network.lose_router()
    network.run(0.5)
    network.restore_router()
    network.run(0.5 + REJOIN_S[0] - 0.01)
    # The first search has ended with the second loss, though its time has come.
    assert all(core.of(LinkUp) == [] for core in cores.values())
    network.run(3.0)
    assert all(len(core.of(LinkUp)) == 1 for core in cores.values())


def test_a_node_that_is_unplugged_stays_so_when_the_router_comes_back() -> None:
    network, cores = crowd()
    network.disconnect("a")
    network.lose_router()
    network.disconnect("b")
    network.restore_router()
    network.run(3.0)
    for name in ("a", "b"):
        assert len(cores[name].of(LinkDown)) == 1
        assert cores[name].of(LinkUp) == []
    assert sorted(cores["c"].tokens[4:]) == ["+c", "+d"]
    network.reconnect("a")
    network.reconnect("b")
    network.run(4.0)
    assert all(len(cores[name].of(LinkUp)) == 1 for name in ("a", "b"))
    assert sorted(cores["c"].tokens[4:]) == ["+a", "+b", "+c", "+d"]


def test_no_node_connects_while_the_router_is_lost() -> None:
    network, cores = crowd()
    network.disconnect("a")
    network.lose_router()
    network.reconnect("a")
    late = Recorder(at_start(node.Listen(HEARTBEAT), node.Watch(VEHICLE_ALIVE), token("late")))
    network.add("late", late, REALM)
    network.run(2.0)
    assert [type(event) for _, event in late.events] == [node.Started, LinkDown]
    assert cores["a"].of(LinkUp) == []
    network.restore_router()
    network.run(4.0)
    assert len(cores["a"].of(LinkUp)) == len(late.of(LinkUp)) == 1
    assert sorted(late.tokens) == ["+a", "+b", "+c", "+d", "+late"]
    assert "+late" in cores["a"].tokens


def test_a_paused_node_looks_for_the_router_when_it_resumes() -> None:
    network, cores = crowd()
    network.pause("a")
    network.run(1.0)
    network.lose_router()
    network.run(1.5)
    network.restore_router()
    network.run(5.0)
    assert cores["a"].events == []
    assert "+a" not in cores["b"].tokens
    network.resume("a")
    assert sorted(cores["a"].tokens) == ["-a", "-b", "-c", "-d"]
    network.run(6.0)
    assert cores["a"].times(LinkUp) == [pytest.approx(5.55, abs=0.35)]
    assert "+a" in cores["b"].tokens


def test_a_node_may_be_killed_or_end_while_the_router_is_lost() -> None:
    network, cores = crowd()
    cores["b"].on_event = lambda event, _: [node.End()] if isinstance(event, LinkDown) else []
    network.lose_router()
    assert "b" not in network
    network.kill("a")
    cores["c"].on_event = lambda event, _: [node.End()] if isinstance(event, LinkUp) else []
    network.restore_router()
    network.run(3.0)
    assert network.names == ("d",)
    assert cores["a"].of(LinkUp) == cores["b"].of(LinkUp) == []
    tokens = cores["d"].tokens[4:]
    assert "+a" not in tokens
    assert "+b" not in tokens
    assert ("+c" in tokens) == ("-c" in tokens)


@for_each("seed", range(8))
@for_each("fault", ["disconnect", "kill"])
def test_a_node_that_goes_while_it_looks_for_the_router_never_finds_it(
    fault: str, seed: int
) -> None:
    network, cores = crowd(seed)
    network.lose_router()
    network.restore_router()
    network.run(0.2)
    getattr(network, fault)("a")
    network.run(3.0)
    assert cores["a"].of(LinkUp) == []
    for name in ("b", "c", "d"):
        assert sorted(cores[name].tokens[4:]) == ["+b", "+c", "+d"]


# --- queries ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["kill", "disconnect", "pause", "stop"])
def test_a_question_is_settled_when_no_server_can_answer_it(fault: str) -> None:
    network = SimulatedNetwork(1, Conditions(lease_s=0.5))
    for name in "ab":
        network.add(name, Recorder(at_start(node.Serve(SERVICE))), REALM)
    network.run(0.1)
    answers: list[Answer | None] = []
    network.query(Keys(REALM).key(SERVICE), b"?", answers.append)
    network.run(0.2)
    getattr(network, fault)("a")
    network.run(1.0)
    assert answers == []
    getattr(network, fault)("b")
    network.run(2.0)
    assert answers == [None]
    if fault == "pause":
        # An answer that comes after the lease is ignored.
        network.resume("a")
        network.node("a")._transport.answer(1, b"!", ok=True)
        network.run(3.0)
        assert answers == [None]
