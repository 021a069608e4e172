"""Faults of the simulated network beyond loss: clocks, computations, the router."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.runtime.node import (
    Arrived,
    Compute,
    Computed,
    Delegate,
    Effect,
    End,
    Event,
    Listen,
    PeerDown,
    Serve,
    Started,
    Wakeup,
    Watch,
)
from laneweave.protocol.runtime.transport import Answer, LinkDown, LinkUp
from laneweave.protocol.transports.simulated.member import INJECTED_FAILURE
from laneweave.protocol.transports.simulated.network import REJOIN_S, SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Clock, Conditions, Item
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.topics import HEARTBEAT, SERVICE, VEHICLE_ALIVE, Keys
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

# --- clocks -----------------------------------------------------------------------------------

CLOCKS = [(0.05, 1.0), (-0.05, 1.0), (0.0, 1.05), (0.0, 0.95), (0.05, 0.95), (-3.0, 1.05)]


def alarmed(*times_s: float) -> Recorder:
    """Return a core that wants to be woken at these times of its clock."""
    core, left = Recorder(), list(times_s)

    def next_one(event: Event, _: float) -> Iterable[Effect]:
        if isinstance(event, Wakeup):
            left.pop(0)
        core.wakeup_s = left[0] if left else None
        return [Listen(HEARTBEAT)] if isinstance(event, Started) else []

    core.on_event = next_one
    return core


def traced(network: SimulatedNetwork) -> list[tuple[float, str, Item]]:
    """Return a list that fills with what nodes are handed."""
    events: list[tuple[float, str, Item]] = []
    network.trace = lambda *event: events.append(event)
    return events


@pytest.mark.parametrize(("offset_s", "rate"), CLOCKS)
def test_a_core_lives_by_its_own_clock(offset_s: float, rate: float) -> None:
    wanted = [0.2, 0.3, 1.7, 1.7000001, 4.0, 60.0]
    core = alarmed(*wanted)
    network = SimulatedNetwork(1, CALM)
    events = traced(network)
    network.add("a", core, REALM)
    network.set_clock("a", offset_s, rate)
    network.run(100.0)
    assert core.events[0][0] == offset_s
    seen = core.times(Wakeup)
    assert seen == pytest.approx(wanted, abs=1e-9)
    assert all(now_s >= due_s for now_s, due_s in zip(seen, wanted, strict=True))
    woken = [now_s for now_s, _, item in events if isinstance(item, Wakeup)]
    assert woken == pytest.approx([(due_s - offset_s) / rate for due_s in wanted], abs=1e-9)


@pytest.mark.parametrize(("offset_s", "rate"), CLOCKS)
def test_messages_arrive_at_the_time_that_the_receivers_clock_shows(
    offset_s: float, rate: float
) -> None:
    network = SimulatedNetwork(1, CALM)
    exact, wrong = listener(), listener()
    for name, core in {"a": Recorder(), "b": exact, "c": wrong}.items():
        network.add(name, core, REALM)
    network.set_clock("c", offset_s, rate)
    network.run(2.0)
    send(network, "a", 1)
    network.run(3.0)
    assert exact.times(Arrived) == [2.002]
    assert wrong.times(Arrived) == [pytest.approx(offset_s + rate * 2.002)]


def test_a_clock_belongs_to_the_machine_until_it_is_put_right() -> None:
    network = SimulatedNetwork(1, CALM)
    network.set_clock("a", 0.05, 1.05)
    first, second, third = Recorder(), Recorder(), Recorder()
    network.add("a", first, REALM)
    network.run(1.0)
    network.kill("a")
    network.add("a", second, REALM)
    network.run(2.0)
    network.kill("a")
    network.set_clock("a")
    network.add("a", third, REALM)
    network.run(3.0)
    starts = [core.times(Started) for core in (first, second, third)]
    assert starts == [[0.05], [pytest.approx(1.1)], [2.0]]


@pytest.mark.parametrize(
    ("offset_s", "woken_s"), [(0.5, 0.5), (-0.5, 1.5), (0.95, 0.1)], ids=["on", "back", "past"]
)
def test_a_clock_that_jumps_moves_the_wakeup(offset_s: float, woken_s: float) -> None:
    core = alarmed(1.0)
    network = network_of(a=core)
    events = traced(network)
    network.set_clock("a", offset_s)
    network.run(5.0)
    woken = [now_s for now_s, _, item in events if isinstance(item, Wakeup)]
    assert woken == [pytest.approx(woken_s)]


def test_a_wakeup_moves_with_a_clock_that_jumps_in_a_pause() -> None:
    core = alarmed(1.0)
    network = network_of(a=core)
    network.pause("a")
    network.set_clock("a", -2.0)
    network.run(2.0)
    network.resume("a")
    network.run(2.9)
    assert core.times(Wakeup) == []
    network.run(5.0)
    assert core.times(Wakeup) == [1.0]


@given(
    st.floats(-1e4, 1e4), st.floats(0.5, 2.0), st.floats(-1e5, 1e5) | st.sampled_from([0.0, 1e-300])
)
def test_a_wakeup_is_never_early_and_hardly_late(
    offset_s: float, rate: float, local_s: float
) -> None:
    clock = Clock(offset_s, rate)
    shown_s = clock.local_s(clock.virtual_s(local_s))
    assert local_s <= shown_s <= local_s + 1e-9


@pytest.mark.parametrize(
    ("offset_s", "rate"),
    [(0.0, 0.0), (0.0, -1.0), (float("nan"), 1.0), (float("inf"), 1.0), (0.0, float("nan"))],
)
def test_a_clock_that_is_none_is_refused(offset_s: float, rate: float) -> None:
    network = network_of(a=Recorder())
    with pytest.raises(ValueError, match="must be"):
        network.set_clock("a", offset_s, rate)


# --- computations -----------------------------------------------------------------------------


def computing(conditions: Conditions, *jobs: Compute | Delegate) -> Recorder:
    """Return what a core saw that ordered these jobs at its start."""
    core = Recorder(at_start(*jobs))
    network = SimulatedNetwork(3, conditions)
    network.add("a", core, REALM)
    network.run(1000.0)
    return core


def test_computations_take_their_own_time_each_and_end_in_order() -> None:
    conditions = Conditions(compute_s=0.25, compute_jitter_s=2.0)
    core = computing(conditions, *(Compute(number, lambda: 7) for number in range(40)))
    assert core.of(Computed) == [Computed(number, 7) for number in range(40)]
    times = core.times(Computed)
    assert times == sorted(times)
    assert min(times) >= 0.25
    assert max(times) <= 2.25
    assert len(set(times)) > 1
    # Some are late: more than the mean.
    assert max(times) > 1.25


def test_delegated_computations_hold_up_no_others() -> None:
    conditions = Conditions(compute_s=0.0, compute_jitter_s=1.0)
    jobs = [
        Delegate(number, lambda _: 7, 1000.0) if number % 2 else Compute(number, lambda: 7)
        for number in range(40)
    ]
    numbers = [event.job for event in computing(conditions, *jobs).of(Computed)]  # type: ignore[union-attr]
    assert [number for number in numbers if number % 2] == list(range(1, 40, 2))
    assert [number for number in numbers if not number % 2] == list(range(0, 40, 2))
    assert numbers != sorted(numbers)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_computations_fail_at_the_given_rate_without_being_done(share: float) -> None:
    done: list[int] = []

    def job(number: int) -> Compute:
        return Compute(number, lambda: done.append(number))

    core = computing(Conditions(compute_failure=share), *(job(number) for number in range(1000)))
    failed = [event.job for event in core.of(Computed) if event.error]  # type: ignore[union-attr]
    assert core.of(Computed) == [
        Computed(number, None, INJECTED_FAILURE if number in failed else "")
        for number in range(1000)
    ]
    assert sorted([*done, *failed]) == list(range(1000))
    # Four standard deviations.
    assert abs(len(failed) - 1000 * share) <= 4 * (1000 * share * (1 - share)) ** 0.5


# --- messages ---------------------------------------------------------------------------------


def test_messages_can_be_lost_by_their_key() -> None:
    receiver = listener()
    network = network_of(a=Recorder(), b=Recorder(), c=receiver)
    network.lose(lambda key: 1.0 if key.endswith("/a") else 0.0)
    send(network, "a", *range(10))
    send(network, "b", *range(10, 20))
    network.run(0.2)
    assert receiver.numbers == list(range(10, 20))
    assert network.dropped == 10
    network.lose(None)
    send(network, "a", 20)
    network.run(0.3)
    assert receiver.numbers[10:] == [20]


@pytest.mark.parametrize(("general", "on_key"), [(0.2, 0.6), (0.6, 0.2)])
def test_the_greater_loss_counts(general: float, on_key: float) -> None:
    receiver = listener()
    network = network_of(Conditions(loss=general), a=Recorder(), b=receiver)
    network.lose(lambda _: on_key)
    send(network, "a", *range(2000))
    network.run(1.0)
    # Four standard deviations.
    assert abs(len(receiver.numbers) - 800) < 88


def test_messages_may_take_seconds_and_still_arrive() -> None:
    receiver = listener()
    network = network_of(Conditions(jitter_s=5.0), a=Recorder(), b=receiver)
    send(network, "a", *range(200))
    network.run(2.6)
    assert 50 < len(receiver.numbers) < 150
    network.run(5.2)
    assert sorted(receiver.numbers) == list(range(200))


def test_all_who_receive_the_same_bytes_share_one_message() -> None:
    receivers = {name: listener() for name in ("b", "c")}
    network = network_of(Conditions(jitter_s=1.0, duplication=1.0), more=receivers, a=Recorder())
    send(network, "a", 1, 2)
    network.run(3.0)
    arrived = [event for core in receivers.values() for event in core.of(Arrived)]
    assert all(sorted(core.numbers) == [1, 1, 2, 2] for core in receivers.values())
    assert len({id(event.message) for event in arrived}) == 2  # type: ignore[union-attr]


def test_each_receiver_refuses_malformed_bytes_every_time() -> None:
    network = network_of(a=listener(), b=listener())
    for payload in (b"\xc1", b"\xc1", encode(beat(1).message)):
        network.inject("laneweave/r/heartbeat/x", payload)
    network.run(1.0)
    for name in ("a", "b"):
        core = network.node(name).core
        assert isinstance(core, Recorder)
        assert core.numbers == [1]
        assert network.node(name).rejected == 2


def test_realms_in_one_network_do_not_mix() -> None:
    network = SimulatedNetwork(1, CALM)
    ours, theirs = listener(), listener()
    network.add("a", ours, "r")
    network.add("b", theirs, "s")
    network.run(0.1)
    payload = encode(beat(1).message)
    network.inject("laneweave/r/heartbeat/x", payload)
    network.run(0.2)
    assert (ours.numbers, theirs.numbers) == ([1], [])
    network.inject("laneweave/s/heartbeat/x", payload)
    network.run(0.3)
    assert (ours.numbers, theirs.numbers) == ([1], [1])
    assert network.node("a").rejected == network.node("b").rejected == 0


@pytest.mark.parametrize(
    ("name", "value"),
    [("loss", 1.1), ("loss", -0.1), ("duplication", 2.0), ("compute_failure", float("nan")),
     ("delay_s", -1.0), ("jitter_s", float("inf")), ("lease_s", float("nan")),
     ("compute_s", -0.1), ("compute_jitter_s", -0.1)],
)  # fmt: skip
def test_conditions_that_cannot_be_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Conditions(**{name: value})


# --- the router -------------------------------------------------------------------------------


def crowd(seed: int = 1) -> tuple[SimulatedNetwork, dict[str, Recorder]]:
    """Return a network in which everybody shows a token, watches all, and hears all beats."""
    names = ("a", "b", "c", "d")
    cores = {
        name: Recorder(at_start(Listen(HEARTBEAT), Watch(VEHICLE_ALIVE), token(name)))
        for name in names
    }
    network = network_of(seed=seed, more=cores)
    for core in cores.values():
        assert sorted(core.tokens) == [f"+{name}" for name in names]
        core.events.clear()
    return network, cores


def test_without_the_router_everybody_loses_everybody_at_once() -> None:
    network, cores = crowd()
    send(network, "a", 1)
    network.lose_router()
    network.lose_router()
    for name, core in cores.items():
        assert sorted(core.tokens) == ["-a", "-b", "-c", "-d"]
        assert core.times(PeerDown) == [0.1] * 4
        assert core.times(LinkDown) == [0.1]
        send(network, name, 2)
    network.run(5.0)
    for core in cores.values():
        assert core.numbers == []
        assert core.of(LinkUp) == []
        assert len(core.tokens) == 4


def test_the_nodes_find_the_router_again_one_after_the_other() -> None:
    network, cores = crowd()
    network.lose_router()
    network.run(2.0)
    network.restore_router()
    network.restore_router()
    network.run(2.0 + REJOIN_S[1] + 0.01)
    times = [core.times(LinkUp) for core in cores.values()]
    assert all(len(one) == 1 and 2.2 <= one[0] <= 2.9 for one in times)
    assert len({one[0] for one in times}) == len(cores)
    for core in cores.values():
        assert sorted(core.tokens[4:]) == ["+a", "+b", "+c", "+d"]
    send(network, "a", 3)
    network.run(4.0)
    assert [core.numbers for core in cores.values()] == [[3]] * 4


def test_nodes_find_the_router_at_times_drawn_from_the_seed() -> None:
    def join_times(seed: int) -> list[list[float]]:
        network, cores = crowd(seed)
        network.lose_router()
        network.restore_router()
        network.run(3.0)
        return [core.times(LinkUp) for core in cores.values()]

    assert join_times(1) == join_times(1)
    assert join_times(1) != join_times(2)


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


def test_nobody_connects_while_the_router_is_lost() -> None:
    network, cores = crowd()
    network.disconnect("a")
    network.lose_router()
    network.reconnect("a")
    late = Recorder(at_start(Listen(HEARTBEAT), Watch(VEHICLE_ALIVE), token("late")))
    network.add("late", late, REALM)
    network.run(2.0)
    assert [type(event) for _, event in late.events] == [Started, LinkDown]
    assert cores["a"].of(LinkUp) == []
    network.restore_router()
    network.run(4.0)
    assert len(cores["a"].of(LinkUp)) == len(late.of(LinkUp)) == 1
    assert sorted(late.tokens) == ["+a", "+b", "+c", "+d", "+late"]
    assert "+late" in cores["a"].tokens


def test_a_sleeper_looks_for_the_router_when_it_wakes() -> None:
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
    network.lose_router()
    network.kill("a")
    perform(network, "b", End())
    cores["c"].on_event = lambda event, _: [End()] if isinstance(event, LinkUp) else []
    network.restore_router()
    network.run(3.0)
    assert network.names == ("d",)
    assert cores["a"].of(LinkUp) == cores["b"].of(LinkUp) == []
    tokens = cores["d"].tokens[4:]
    assert "+a" not in tokens
    assert "+b" not in tokens
    assert ("+c" in tokens) == ("-c" in tokens)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("fault", ["disconnect", "kill"])
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


def test_a_node_may_end_when_it_loses_the_router() -> None:
    network, cores = crowd()
    cores["b"].on_event = lambda event, _: [End()] if isinstance(event, LinkDown) else []
    network.lose_router()
    assert network.names == ("a", "c", "d")
    network.restore_router()
    network.run(3.0)
    assert sorted(cores["a"].tokens[4:]) == ["+a", "+c", "+d"]


# --- questions --------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["kill", "disconnect", "pause", "stop"])
def test_a_question_is_settled_when_no_server_can_answer_it(fault: str) -> None:
    network = SimulatedNetwork(1, Conditions(lease_s=0.5))
    for name in "ab":
        network.add(name, Recorder(at_start(Serve(SERVICE))), REALM)
    network.run(0.1)
    answers: list[Answer | None] = []
    network.ask(Keys(REALM).key(SERVICE), b"?", answers.append)
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
