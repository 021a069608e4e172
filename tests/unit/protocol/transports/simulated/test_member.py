"""A node in virtual time: its clock, its wakeups, its computations."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from laneweave.protocol.runtime.node import (
    Arrived,
    Clock,
    Compute,
    Computed,
    Delegate,
    Effect,
    Event,
    Listen,
    Started,
    Wakeup,
)
from laneweave.protocol.transports.simulated.member import INJECTED_FAILURE
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions, Item
from laneweave.protocol.wire.topics import HEARTBEAT
from support.node_recorder import CALM, REALM, Recorder, at_start, listener, network_of, send

# --- clocks -----------------------------------------------------------------------------------


CLOCKS = [(0.0, 1.0), (0.05, 1.0), (-0.05, 1.0), (0.0, 1.05), (0.05, 0.95), (-3.0, 1.05)]


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
    wanted = [0.1, 0.1 + 1e-3, 0.25, 1.7, 1.7000000001 + 1e-3, 60.0]
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


# --- wakeups ----------------------------------------------------------------------------------


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
    cores = {"a": alarmed(0.5), "b": alarmed(2.5)}
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


# --- computations -----------------------------------------------------------------------------


def computing(conditions: Conditions, *jobs: Compute | Delegate) -> Recorder:
    """Return what a core saw that ordered these jobs at its start."""
    core = Recorder(at_start(*jobs))
    network = SimulatedNetwork(3, conditions)
    network.add("a", core, REALM)
    network.run(1000.0)
    return core


def test_a_computation_takes_its_time() -> None:
    def fail(_: object) -> None:
        raise ValueError("no")

    core = computing(Conditions(compute_s=0.25), Compute(1, lambda _: 41 + 1), Compute(2, fail))
    assert core.of(Computed) == [Computed(1, 42), Computed(2, None, "ValueError: no")]
    assert core.times(Computed) == [0.25, 0.25]


def test_no_time_passes_while_a_computation_runs() -> None:
    """Deadlines do not depend on the speed of the machine: equal seeds give equal runs."""

    def read(clock: Clock) -> list[float]:
        return [clock(), clock()]

    here = Compute(1, read)
    delegated = Delegate(2, lambda _, clock: read(clock), 1000.0)
    core = computing(Conditions(compute_s=0.25), here, delegated)
    results = [event.result for event in core.of(Computed) if isinstance(event, Computed)]
    assert sorted(results) == [[0.0, 0.0], [0.25, 0.25]]


def test_a_computation_sees_what_has_changed_since_it_was_ordered() -> None:
    """As in a thread: a job that reads what its core changes is not pure."""
    state = [1]
    core = Recorder(at_start(Compute(1, lambda _: sum(state))))
    network = SimulatedNetwork(3, Conditions(compute_s=0.25))
    network.add("a", core, REALM)
    network.at(0.1, state.append, 10)
    network.run(1.0)
    assert core.of(Computed) == [Computed(1, 11)]
    assert network.failed_jobs == []


def test_failed_computations_are_reported_unless_injected() -> None:
    def fail(_: object) -> None:
        raise ValueError("no")

    for share, failed in ((0.0, [(0.25, "a", "ValueError: no")]), (1.0, [])):
        network = SimulatedNetwork(3, Conditions(compute_s=0.25, compute_failure=share))
        network.add("a", Recorder(at_start(Compute(1, fail))), REALM)
        network.run(1.0)
        assert network.failed_jobs == failed


def test_computations_take_their_own_time_each_and_end_in_order() -> None:
    conditions = Conditions(compute_s=0.25, compute_jitter_s=2.0)
    core = computing(conditions, *(Compute(number, lambda _: 7) for number in range(40)))
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
        Delegate(number, lambda *_: 7, 1000.0) if number % 2 else Compute(number, lambda _: 7)
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
        return Compute(number, lambda _: done.append(number))

    core = computing(Conditions(compute_failure=share), *(job(number) for number in range(1000)))
    failed = [event.job for event in core.of(Computed) if event.error]  # type: ignore[union-attr]
    assert core.of(Computed) == [
        Computed(number, None, INJECTED_FAILURE if number in failed else "")
        for number in range(1000)
    ]
    assert sorted([*done, *failed]) == list(range(1000))
    # Four standard deviations.
    assert abs(len(failed) - 1000 * share) <= 4 * (1000 * share * (1 - share)) ** 0.5
