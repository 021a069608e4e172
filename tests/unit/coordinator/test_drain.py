"""A coordinator that ends with a grace: it answers what it has, and leaves the rest to others."""

from __future__ import annotations

import json
from collections.abc import Iterable

import pytest

from laneweave.coordinator.core import CoordinatorCore
from laneweave.protocol.runtime.node import (
    Decline,
    Delegate,
    Effect,
    End,
    QueryArrived,
    Reply,
    Send,
    Stopping,
    Withdraw,
    run_delegated,
)
from laneweave.protocol.runtime.transport import Answer
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.messages import Heartbeat, Name
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import COORDINATOR_ALIVE, SERVICE, Keys
from support.paper import PAPER
from support.service_desk import Desk, logged, messages
from support.service_lab import request

GRACE_S = 5.0
OWN = {"coordinator": "c1", "incarnation": 1}
REALM = "default"


def ask(desk: Desk, token: int, name: str) -> list[Effect]:
    return desk.give(QueryArrived(token, json.dumps(request(name)).encode()))


def answered(effects: Iterable[Effect]) -> list[int]:
    return [effect.token for effect in effects if isinstance(effect, Reply)]


def declined(effects: Iterable[Effect]) -> list[int]:
    return [effect.token for effect in effects if isinstance(effect, Decline)]


def ends(effects: list[Effect]) -> bool:
    """Check whether the core ends, and that it reports before."""
    assert not any(isinstance(effect, End) for effect in effects[:-1])
    if not effects or not isinstance(effects[-1], End):
        return False
    report = effects[-2]
    assert isinstance(report, Send)
    assert isinstance(report.message, Report)
    return True


def do_next(desk: Desk, orders: list[Delegate]) -> list[Effect]:
    return desk.give(run_delegated(orders.pop(0), lambda: desk.now_s))


def test_an_idle_coordinator_ends_at_once() -> None:
    desk = Desk()
    effects = desk.give(Stopping(GRACE_S))
    assert effects[0] == Withdraw(COORDINATOR_ALIVE, OWN)
    assert ends(effects)


def test_pending_requests_are_answered_and_new_ones_are_declined() -> None:
    desk = Desk()
    desk.lead()
    orders = [e for n in range(4) for e in ask(desk, n, f"r{n}") if isinstance(e, Delegate)]
    effects = desk.give(Stopping(GRACE_S))
    assert Withdraw(COORDINATOR_ALIVE, OWN) in effects
    assert logged(effects) == ["leader-stepped-down"]
    assert not ends(effects)
    assert declined(ask(desk, 10, "r10")) == [10]
    assert declined(ask(desk, 11, "r0")) == [11]  # also one that is pending already
    replies = []
    for left in range(3, -1, -1):
        effects = do_next(desk, orders)
        orders += [effect for effect in effects if isinstance(effect, Delegate)]
        replies += answered(effects)
        assert ends(effects) == (left == 0)
    assert replies == [0, 1, 2, 3]


def test_a_coordinator_that_ends_is_no_candidate_any_more() -> None:
    desk = Desk()
    desk.lead()
    ask(desk, 1, "r")
    desk.give(Stopping(GRACE_S))
    # It neither leads again, nor sends heartbeats: late ones would make it a candidate elsewhere.
    later = [effect for _ in range(40) for effect in desk.wait(0.1)]
    assert logged(later) == []
    assert messages(later, Heartbeat) == []
    assert messages(later, Report) != []


def test_what_is_left_at_the_end_of_the_grace_is_declined() -> None:
    desk = Desk()
    for n in range(4):  # two with the worker, two that wait
        ask(desk, n, f"r{n}")
    assert not ends(desk.give(Stopping(GRACE_S)))
    assert desk.core.wakeup_s is not None
    assert not ends(desk.wait(GRACE_S - 0.01))
    assert desk.core.wakeup_s <= desk.now_s + 0.011
    effects = desk.wait(0.01)
    assert ends(effects)
    assert sorted(declined(effects)) == [0, 1, 2, 3]
    assert answered(effects) == []


@pytest.mark.parametrize("pending", [False, True])
def test_a_second_signal_ends_at_once(*, pending: bool) -> None:
    desk = Desk()
    if pending:
        ask(desk, 1, "r")
        desk.give(Stopping(GRACE_S))
    (effect,) = desk.core.handle(Stopping(), desk.now_s)
    assert isinstance(effect, Send)
    assert isinstance(effect.message, Report)


# --- several coordinators ---------------------------------------------------------------------


def test_another_coordinator_leads_and_answers_meanwhile() -> None:
    # Plans take so long that the grace ends before the second one.
    network = SimulatedNetwork(1, Conditions(compute_s=3.0))
    cores = {name: CoordinatorCore(Name(name), 1, PAPER, workers=1) for name in ("c1", "c2")}
    for name, core in cores.items():
        network.add(name, core, REALM)
    network.run(5.0)
    assert [core.election.leading for core in cores.values()] == [True, False]
    assert list(cores["c2"].election.living(network.now_s)) == ["c1"]

    answers: dict[str, list[Answer | None]] = {}

    def put(name: str) -> None:
        answers[name] = []
        network.query(
            Keys(REALM).key(SERVICE), json.dumps(request(name)).encode(), answers[name].append
        )

    def of_c1(prefix: str, count: int) -> list[str]:
        """Ask until c1 has taken this many more requests; return their names."""
        taken: list[str] = []
        number = 0
        while len(taken) < count:
            before = cores["c1"].service.metrics.taken_total
            name = f"{prefix}{number}"
            put(name)
            network.run(network.now_s + 0.1)
            number += 1
            if cores["c1"].service.metrics.taken_total > before:
                taken.append(name)
        return taken

    pending = of_c1("before", 3)
    network.stop("c1", GRACE_S)
    network.run(network.now_s + 0.2)
    assert [core.election.leading for core in cores.values()] == [False, True]
    put("after")
    network.run(network.now_s + 2 * GRACE_S + 30.0)
    assert [answer.ok for answer in answers["after"] if answer is not None] == [True]
    first, *_, last = pending
    assert [answer.ok for answer in answers[first] if answer is not None] == [True]
    # Declined by all: the client sends it again, and c2 answers.
    assert answers[last] == [None]
    put(last)
    network.run(network.now_s + 30.0)
    assert [answer.ok for answer in answers[last] if answer is not None] == [True]
