"""The network in virtual time: repeatable, harsh, and honest about who is there."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from laneweave.protocol.runtime.node import (
    Arrived,
    Compute,
    Computed,
    Effect,
    End,
    Event,
    Listen,
    PeerDown,
    Started,
    Stopping,
    Unlisten,
    Wakeup,
    Watch,
    Withdraw,
)
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.transports.simulated.network import KILL_SEEN_S, SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.topics import HEARTBEAT, VEHICLE_ALIVE
from support.node_recorder import (
    CALM,
    REALM,
    STORM,
    Recorder,
    at_start,
    beat,
    chatter,
    listener,
    network_of,
    perform,
    send,
    token,
)

# --- repeatable -------------------------------------------------------------------------------


@pytest.mark.parametrize("conditions", [CALM, STORM], ids=["calm", "storm"])
def test_equal_seeds_give_equal_runs(conditions: Conditions) -> None:
    assert chatter(5, conditions) == chatter(5, conditions)


def test_other_seeds_give_other_runs() -> None:
    runs = [chatter(seed, STORM)[0] for seed in range(4)]
    assert all(runs[i] != runs[j] for i in range(4) for j in range(i))


# --- what happens to messages -----------------------------------------------------------------


def test_without_faults_each_message_arrives_once_and_in_order() -> None:
    receiver = listener()
    network = network_of(a=Recorder(), b=receiver)
    send(network, "a", *range(100))
    network.run(1.0)
    assert receiver.numbers == list(range(100))
    assert receiver.times(Arrived) == pytest.approx([0.102] * 100)
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
    assert all(0.102 <= now_s <= 0.112 + 1e-9 for now_s in receiver.times(Arrived))


def test_a_cut_loses_messages_where_it_says_until_it_heals() -> None:
    receivers = {name: listener() for name in ("b", "c")}
    network = network_of(more=receivers, a=Recorder())
    network.cut(lambda sender, receiver: (sender, receiver) == ("a", "b"))
    send(network, "a", 1)
    send(network, "c", 2)
    network.run(0.2)
    assert receivers["b"].numbers == [2]
    assert receivers["c"].numbers == [1, 2]
    assert network.dropped == 1
    network.cut(None)
    send(network, "a", 3)
    network.run(0.3)
    assert receivers["b"].numbers == [2, 3]


def test_a_stranger_can_deliver_any_bytes() -> None:
    receiver = listener()
    network = network_of(a=receiver)
    network.inject("laneweave/r/heartbeat/a", b"\xc1")
    network.inject("laneweave/r/heartbeat/a", encode(beat(4).message))
    network.run(0.2)
    assert receiver.numbers == [4]
    assert network.node("a").rejected == 1


def test_subscriptions_may_change_between_messages() -> None:
    receivers = {name: listener() for name in ("b", "c")}
    network = network_of(more=receivers, a=Recorder())
    send(network, "a", 1)
    perform(network, "b", Unlisten(HEARTBEAT))
    send(network, "a", 2)
    perform(network, "b", Listen(HEARTBEAT, {"coordinator": "a"}))
    send(network, "a", 3)
    send(network, "c", 4)
    network.run(0.2)
    assert receivers["b"].numbers == [1, 3]
    assert receivers["c"].numbers == [1, 2, 3, 4]


def test_nothing_is_sent_to_who_has_left() -> None:
    network = network_of(a=Recorder(), b=listener(), c=listener())
    send(network, "a", 1)
    network.kill("b")
    network.conditions = Conditions(loss=1.0)
    send(network, "a", 2)
    assert network.dropped == 1


# --- who is there -----------------------------------------------------------------------------


def test_a_killed_node_is_seen_at_once_and_says_nothing() -> None:
    watcher, victim = listener(), Recorder(at_start(token("v")))
    network = network_of(a=watcher, v=victim)
    network.kill("v")
    assert "v" not in network
    network.run(0.1 + KILL_SEEN_S + 0.002 + 1e-9)
    assert watcher.tokens == ["+v", "-v"]
    assert victim.of(Stopping) == []


def test_a_stopped_node_may_say_goodbye() -> None:
    watcher = listener()

    def goodbye(event: Event, _: float) -> Iterable[Effect]:
        return [beat(9, "v")] if isinstance(event, Stopping) else at_start(token("v"))(event, 0.0)

    victim = Recorder(goodbye)
    network = network_of(a=watcher, v=victim)
    network.stop("v")
    network.run(0.2)
    assert "v" not in network
    assert len(victim.of(Stopping)) == 1
    assert watcher.numbers == [9]
    assert watcher.tokens == ["+v", "-v"]


def test_a_node_that_ends_has_left() -> None:
    watcher, leaver = listener(), Recorder(at_start(token("v")))
    network = network_of(a=watcher, v=leaver)
    perform(network, "v", End())
    assert "v" not in network
    network.run(0.2)
    assert watcher.tokens == ["+v", "-v"]


def test_a_watcher_that_comes_later_learns_who_is_there() -> None:
    network = network_of(v=Recorder(at_start(token("v"))))
    late = Recorder(at_start(Watch(VEHICLE_ALIVE)))
    network.add("late", late, REALM)
    network.run(0.2)
    assert late.tokens == ["+v"]


def test_a_short_pause_is_not_noticed_and_loses_nothing() -> None:
    watcher, sleeper = listener(), listener()
    sleeper.on_event = at_start(token("v"), Listen(HEARTBEAT), Watch(VEHICLE_ALIVE))
    network = network_of(a=watcher, v=sleeper)
    network.pause("v")
    send(network, "a", 1, 2)
    network.run(0.3)
    assert sleeper.numbers == []
    network.resume("v")
    assert sleeper.numbers == [1, 2]
    assert sleeper.times(Arrived) == [0.3, 0.3]
    network.run(2.0)
    assert watcher.tokens == ["+v"]


def test_a_node_that_is_silent_for_its_lease_is_given_up_and_comes_back_as_a_zombie() -> None:
    watcher, zombie = listener(), Recorder(at_start(token("v"), Listen(HEARTBEAT)))
    zombie.wakeup_s = 0.2
    network = network_of(a=watcher, v=zombie)
    network.pause("v")
    network.run(0.1 + CALM.lease_s - 0.001)
    assert watcher.tokens == ["+v"]
    network.run(0.1 + CALM.lease_s + 0.01)
    assert watcher.tokens == ["+v", "-v"]
    send(network, "a", 1)
    network.run(3.0)
    network.resume("v")
    assert zombie.numbers == [1]
    network.run(3.1)
    assert watcher.tokens == ["+v", "-v", "+v"]
    assert zombie.times(Wakeup)[0] == 3.0


def test_each_pause_has_its_own_lease() -> None:
    watcher = listener()
    network = network_of(a=watcher, v=Recorder(at_start(token("v"))))
    network.pause("v")
    network.run(0.4)
    network.resume("v")
    network.pause("v")
    network.run(0.4 + CALM.lease_s - 0.01)
    assert watcher.tokens == ["+v"]
    network.run(0.4 + CALM.lease_s + 0.01)
    assert watcher.tokens == ["+v", "-v"]


def test_a_watcher_that_comes_during_a_short_pause_learns_of_the_sleeper() -> None:
    network = network_of(v=Recorder(at_start(token("v"))))
    network.pause("v")
    late = Recorder(at_start(Watch(VEHICLE_ALIVE)))
    network.add("late", late, REALM)
    network.run(0.3)
    network.resume("v")
    network.run(0.4)
    assert late.tokens == ["+v"]


def test_resuming_a_node_that_is_awake_does_nothing() -> None:
    watcher = listener()
    network = network_of(a=watcher, v=Recorder(at_start(token("v"))))
    network.resume("v")
    network.run(1.0)
    assert watcher.tokens == ["+v"]


def test_a_paused_node_that_is_killed_is_told_once() -> None:
    watcher = listener()
    network = network_of(a=watcher, v=Recorder(at_start(token("v"))))
    network.pause("v")
    network.run(1.0)
    network.kill("v")
    network.run(2.0)
    assert watcher.tokens == ["+v", "-v"]


def test_a_paused_node_obeys_stop_when_it_wakes() -> None:
    sleeper = Recorder(at_start(token("v")))
    network = network_of(v=sleeper)
    network.pause("v")
    network.stop("v")
    network.run(0.2)
    assert "v" in network
    assert sleeper.of(Stopping) == []
    network.resume("v")
    assert "v" not in network
    assert len(sleeper.of(Stopping)) == 1


def test_a_disconnected_node_and_the_others_lose_each_other_and_find_each_other() -> None:
    start = (Listen(HEARTBEAT), Watch(VEHICLE_ALIVE))
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
        news = core.of(LinkDown, PeerDown)
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


def test_nobody_is_believed_alive_that_died_while_the_link_was_down() -> None:
    watcher = listener()
    network = network_of(a=watcher, v=Recorder())
    perform(network, "v", token("v"))
    network.disconnect("a")
    network.kill("v")
    network.run(1.0)
    network.reconnect("a")
    network.run(2.0)
    assert watcher.tokens == []


def test_nobody_is_believed_alive_whose_end_was_under_way_when_the_link_broke() -> None:
    watcher = listener()
    network = network_of(a=watcher, v=Recorder(at_start(token("v"))))
    network.kill("v")
    network.run(network.now_s + KILL_SEEN_S + 0.001)
    network.disconnect("a")
    assert watcher.tokens == ["+v", "-v"]
    network.reconnect("a")
    network.run(2.0)
    assert watcher.tokens == ["+v", "-v"]


@pytest.mark.parametrize("seed", range(20))
def test_news_of_a_token_never_overtake_each_other(seed: int) -> None:
    watcher = listener()
    network = network_of(Conditions(jitter_s=0.05), seed=seed, a=watcher, v=Recorder())
    for _ in range(5):
        perform(network, "v", token("v"), Withdraw(VEHICLE_ALIVE, {"vehicle": "v"}))
    perform(network, "v", token("v"))
    network.run(1.0)
    assert watcher.tokens == ["+v", "-v"] * 5 + ["+v"]


def test_a_token_of_two_nodes_vanishes_with_the_last() -> None:
    watcher = listener()
    network = network_of(
        a=watcher, b=Recorder(at_start(token("v"))), c=Recorder(at_start(token("v")))
    )
    network.kill("b")
    network.run(0.5)
    assert watcher.tokens == ["+v"]
    network.kill("c")
    network.run(1.0)
    assert watcher.tokens == ["+v", "-v"]


def test_a_node_started_again_under_its_name_gets_nothing_of_the_old_one() -> None:
    watcher = listener()

    def order(event: Event, _: float) -> Iterable[Effect]:
        start = at_start(token("v"), Listen(HEARTBEAT), Compute(1, lambda: "old"))
        return start(event, 0.0)

    old = Recorder(order)
    old.wakeup_s = 0.15
    network = SimulatedNetwork(1, Conditions(jitter_s=0.0, compute_s=0.2))
    network.add("a", watcher, REALM)
    network.add("v", old, REALM)
    network.run(0.1)
    send(network, "a", 1)
    network.kill("v")
    new = Recorder(at_start(token("v"), Listen(HEARTBEAT)))
    network.add("v", new, REALM)
    network.run(1.0)
    assert new.of(Computed, Arrived, Wakeup) == []
    assert old.of(Computed) == []
    # The new node shows the token before the old one is missed.
    assert watcher.tokens[-1] == "+v"
    network.kill("v")
    network.run(2.0)
    assert watcher.tokens[-1] == "-v"


def test_two_nodes_of_one_name_are_refused() -> None:
    network = network_of(a=Recorder())
    with pytest.raises(ValueError, match="already"):
        network.add("a", Recorder(), REALM)


def test_faults_of_nodes_that_have_left_are_harmless() -> None:
    network = network_of(a=Recorder(), v=Recorder())
    network.kill("v")
    network.kill("v")
    network.stop("v")
    network.remove("v")
    network.run(1.0)
    assert network.names == ("a",)


@pytest.mark.parametrize("moment", [LinkDown, LinkUp, PeerDown, Arrived, Computed])
def test_a_node_may_end_at_any_moment(moment: type) -> None:
    def end(event: Event, _: float) -> Iterable[Effect]:
        if isinstance(event, moment):
            return [End(), token("late"), Watch(VEHICLE_ALIVE), Listen(HEARTBEAT), beat(1, "v")]
        return at_start(token("v"), Listen(HEARTBEAT), Watch(VEHICLE_ALIVE))(event, 0.0)

    core, watcher = Recorder(end), listener()
    network = network_of(a=watcher, v=core, b=Recorder(at_start(token("b"))))
    network.disconnect("v")
    if "v" in network:
        network.reconnect("v")
    if "v" in network:
        network.pause("v")
        send(network, "a", 1)
        perform(network, "v", Compute(1, lambda: 1))
        network.run(0.2)
        network.resume("v")
        network.run(0.3)
    assert "v" not in network
    network.run(1.0)
    assert "+late" not in watcher.tokens
    assert watcher.tokens[-1] == "-v"


# --- computations -----------------------------------------------------------------------------


def test_a_computation_takes_its_time() -> None:
    def fail() -> None:
        raise ValueError("no")

    core = Recorder(at_start(Compute(1, lambda: 41 + 1), Compute(2, fail)))
    network = SimulatedNetwork(1, Conditions(compute_s=0.25))
    network.add("a", core, REALM)
    network.run(1.0)
    assert core.of(Computed) == [Computed(1, 42), Computed(2, None, "ValueError: no")]
    assert core.times(Computed) == [0.25, 0.25]


def test_the_result_of_a_killed_node_goes_nowhere() -> None:
    core = Recorder(at_start(Compute(1, lambda: 1)))
    network = SimulatedNetwork(1, CALM)
    network.add("a", core, REALM)
    network.run(0.01)
    network.kill("a")
    network.run(1.0)
    assert core.of(Computed) == []


# --- wakeups ----------------------------------------------------------------------------------


def test_a_core_is_woken_when_it_asked_never_early_never_late() -> None:
    core = Recorder()
    wanted = [0.1, 0.1 + 1e-3, 0.25, 0.7, 0.7000000001 + 1e-3, 3.0]
    queue = list(wanted)

    def next_one(_: Event, now_s: float) -> Iterable[Effect]:
        if core.wakeup_s is not None and now_s >= core.wakeup_s:
            queue.pop(0)
        core.wakeup_s = queue[0] if queue else None
        return ()

    core.on_event = next_one
    network = SimulatedNetwork(1, CALM)
    network.add("a", core, REALM)
    network.run(10.0)
    assert core.times(Wakeup) == pytest.approx(wanted, abs=1e-6)
    assert all(now_s >= due_s for now_s, due_s in zip(core.times(Wakeup), wanted, strict=True))


def test_a_wakeup_that_moves_is_followed() -> None:
    """Each arrival moves the wakeup: later, earlier, away, and back to where it was."""
    core = Recorder()
    plan = {1: 0.9, 2: 0.3, 3: None, 4: 0.5, 5: 0.9, 6: 0.5}

    def move(event: Event, _: float) -> Iterable[Effect]:
        if isinstance(event, Started):
            return [Listen(HEARTBEAT)]
        core.wakeup_s = plan[event.message.term] if isinstance(event, Arrived) else None
        return ()

    core.on_event = move
    network = network_of(a=Recorder(), b=core)
    for number in range(1, 7):
        network.at(0.1 + number * 0.02, send, network, "a", number)
    network.run(5.0)
    assert core.times(Wakeup) == [0.5]


@pytest.mark.parametrize("shift_s", [0.01, -0.01], ids=["put off", "brought forward"])
def test_a_wakeup_that_moves_again_and_again_does_not_fill_the_queue(shift_s: float) -> None:
    core = Recorder(at_start(Listen(HEARTBEAT)))
    core.wakeup_s = 3.0

    def move(event: Event, now_s: float) -> Iterable[Effect]:
        if isinstance(event, Arrived):
            assert core.wakeup_s is not None
            core.wakeup_s += shift_s
        elif isinstance(event, Wakeup):
            core.wakeup_s = 10.0 if now_s < 10.0 else None
        return ()

    network = network_of(a=Recorder(), b=core)
    core.on_event = move
    for number in range(100):
        network.at(0.2 + number * 0.01, send, network, "a", number)
    network.run(1.5)
    assert core.wakeup_s == pytest.approx(3.0 + 100 * shift_s)
    events = 0
    while network.step():
        events += 1
    assert core.times(Wakeup) == [pytest.approx(3.0 + 100 * shift_s), 10.0]
    # Put off: the first alarm sets the right one. Brought forward: each time one was set, and all
    # but the last are stale, which set no others.
    assert events == (3 if shift_s > 0 else 102)


def test_a_wakeup_is_not_lost_in_a_pause() -> None:
    cores = {name: Recorder() for name in ("a", "b")}
    for core, due_s in zip(cores.values(), (0.5, 2.5), strict=True):

        def clear(event: Event, _: float, core: Recorder = core) -> Iterable[Effect]:
            if isinstance(event, Wakeup):
                core.wakeup_s = None
            return ()

        core.wakeup_s, core.on_event = due_s, clear
    network = network_of(more=cores)
    for name in cores:
        network.pause(name)
    network.run(2.0)
    assert cores["a"].of(Wakeup) == []
    for name in cores:
        network.resume(name)
    network.run(3.0)
    # One was due in the pause, the other after it.
    assert cores["a"].times(Wakeup) == [2.0]
    assert cores["b"].times(Wakeup) == [2.5]


@pytest.mark.parametrize("wakeup_s", [-1.0, 0.0, 0.05])
def test_a_core_that_asks_for_the_past_does_not_stop_the_clock(wakeup_s: float) -> None:
    core, receiver = Recorder(), listener()
    core.wakeup_s = wakeup_s
    network = network_of(a=core, b=receiver)
    send(network, "a", 1)
    network.run(0.5)
    assert network.now_s == 0.5
    assert receiver.numbers == [1]
    assert 100 < len(core.of(Wakeup)) < 1000


def test_an_empty_network_has_nothing_to_do() -> None:
    network = SimulatedNetwork(1)
    assert not network.step()
    network.run(5.0)
    assert network.now_s == 5.0


def test_a_run_stops_when_it_is_told_to() -> None:
    core = Recorder()
    core.wakeup_s = 0.2
    network = SimulatedNetwork(1, CALM)
    network.add("a", core, REALM)
    network.run(5.0, stop=lambda: len(core.of(Wakeup)) == 3)
    assert len(core.of(Wakeup)) == 3
    assert network.now_s < 0.3


def test_an_action_in_the_past_happens_now() -> None:
    network = network_of()
    times: list[float] = []
    network.at(0.0, lambda: times.append(network.now_s))
    network.run(0.2)
    assert times == [0.1]
