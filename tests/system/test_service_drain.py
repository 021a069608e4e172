"""Coordinators that get a stop signal finish what they have, or leave it to others."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import psutil
import pytest

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.service.client import PlanClient
from support.harness import END_S, Lab
from support.service_lab import ServiceLab, cpu_s, request, slow_request

NAMES = ("c1", "c2")
STATUSES = ("feasible", "optimal", "timeout")


@pytest.fixture
def serve(lab: Lab) -> Iterator[Callable[..., ServiceLab]]:
    """Start coordinators with a time to drain."""
    with ExitStack() as stack:

        def start(drain: str, names: tuple[str, ...] = NAMES) -> ServiceLab:
            options = ("--drain", drain)
            return stack.enter_context(ServiceLab(lab, names, options=options).running())

        yield start


@contextmanager
def busy(service: ServiceLab, deadline_s: float) -> Iterator[tuple[Future[str], psutil.Process]]:
    """Have c1 plan a request until its deadline; cancel it in the end if it has no answer."""
    process = psutil.Process(service.coordinators["c1"].pid)
    worker = service.worker("c1")
    spent_s = cpu_s(worker)
    asked = PlanRequest.from_dict(service.for_one("c1", slow_request("", deadline_s)))
    with PlanClient(service.access) as client, ThreadPoolExecutor(1) as pool:

        def ask() -> str:
            return client.plan(asked, END_S).status

        answer = pool.submit(ask)
        service.lab.wait_until(lambda: cpu_s(worker) > spent_s + 0.2, END_S)
        yield answer, process
        client.cancel(asked.id)


def test_pending_requests_are_answered_while_others_take_new_ones(
    serve: Callable[..., ServiceLab],
) -> None:
    service = serve("30")
    idle = service.worker("c2")
    with busy(service, 6.0) as (answer, process):
        stopping = service.coordinators.pop("c1")
        os.killpg(stopping.pid, signal.SIGTERM)  # also the workers get it, as from `timeout`
        # It is no candidate any more, and new requests go to the other one.
        service.lab.wait_until(lambda: service.alive == {"c2"}, END_S)
        with PlanClient(service.access) as other:
            for _ in range(5):
                assert other.plan(PlanRequest.from_dict(request()), 5.0).status == "optimal"
        assert process.is_running()
        assert not answer.done()
        assert answer.result(END_S) in STATUSES
    assert cpu_s(idle) < 3.0  # it did not plan the same once more
    ended = service.lab.finish(stopping, END_S)
    assert (ended.status, ended.out, ended.complaints) == (0, "", []), ended


def test_another_coordinator_answers_what_is_left_at_the_end_of_the_grace(
    serve: Callable[..., ServiceLab],
) -> None:
    service = serve("0.5")
    with busy(service, 8.0) as (answer, _):
        assert service.stop("c1") < 6.0  # and not 8 s
        assert not answer.done()
        assert answer.result(END_S) in STATUSES


def test_the_only_coordinator_drains_and_its_successor_answers(
    serve: Callable[..., ServiceLab],
) -> None:
    service = serve("0.5", ("c1",))
    with busy(service, 4.0) as (answer, _):
        service.stop("c1")
        service.revive()
        assert answer.result(END_S) in STATUSES


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_ends_at_once(
    serve: Callable[..., ServiceLab], number: signal.Signals
) -> None:
    service = serve("60")
    with busy(service, 30.0) as (answer, process):
        first_s = time.monotonic()
        process.send_signal(number)
        process.send_signal(number)  # as `timeout` does: still the first one
        service.lab.wait_until(lambda: service.alive == {"c2"}, END_S)
        time.sleep(max(0.0, first_s + 1.0 - time.monotonic()))
        assert process.is_running()
        assert service.stop("c1") < 10.0
        assert not answer.done()


def test_an_idle_coordinator_ends_at_once(serve: Callable[..., ServiceLab]) -> None:
    service = serve("60", ("c1",))
    assert service.stop("c1") < 10.0
