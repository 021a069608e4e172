"""Clients while the only coordinator is away: they wait until their own deadline."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.service.client import (
    AsyncPlanClient,
    PlanClient,
    ServiceUnavailableError,
)
from support.harness import END_S, Lab
from support.service_lab import ServiceLab, cpu_s, request, slow_request

TIMEOUT_S = 20.0
AWAY_S = 5.0
"""Time without a coordinator: longer than the 3 s after which clients once gave up."""
CLIENTS = 4
"""Number of clients of each kind."""


@pytest.fixture
def service(lab: Lab) -> Iterator[ServiceLab]:
    with ServiceLab(lab, ("c1",)).running() as running:
        yield running


def ask(service: ServiceLab, asked: PlanRequest, timeout_s: float) -> str:
    with PlanClient(service.access) as client:
        return client.plan(asked, timeout_s).status


def ask_as_task(service: ServiceLab, asked: PlanRequest, timeout_s: float) -> str:
    async def plan() -> str:
        async with AsyncPlanClient(service.access) as client:
            return (await client.plan(asked, timeout_s)).status

    return asyncio.run(plan())


Ask = Callable[[ServiceLab, PlanRequest, float], str]
KINDS: tuple[Ask, ...] = (ask, ask_as_task)


def test_waiting_clients_get_their_answers_from_a_coordinator_that_restarts(
    service: ServiceLab,
) -> None:
    path = service.lab.path("request.json", json.dumps(request()))
    worker = service.worker("c1")
    spent_s = cpu_s(worker)
    with ThreadPoolExecutor(1 + 2 * CLIENTS) as pool:

        def submit(kind: Ask, data: dict[str, Any]) -> Future[str]:
            return pool.submit(kind, service, PlanRequest.from_dict(data), TIMEOUT_S)

        answers = [submit(ask, slow_request("first", 5.0))]
        service.lab.wait_until(lambda: cpu_s(worker) > spent_s + 0.2, END_S)
        # These wait behind the first one when the coordinator is killed.
        answers += [submit(KINDS[n % 2], request(f"r{n}")) for n in range(2 * CLIENTS)]
        time.sleep(1.0)
        service.kill("c1")
        command = service.lab.start("plan", path, "--connect", service.endpoint)
        time.sleep(AWAY_S)
        assert not any(each.done() for each in answers)
        service.revive()
        assert {each.result(TIMEOUT_S) for each in answers} <= {"optimal", "feasible"}
    ended = service.lab.finish(command, END_S)
    assert (ended.status, ended.complaints) == (0, []), ended
    assert json.loads(ended.out)["status"] == "optimal"


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_coordinator_the_error_comes_at_the_deadline(
    service: ServiceLab, kind: Ask
) -> None:
    service.kill("c1")
    begun_s = time.monotonic()
    with pytest.raises(ServiceUnavailableError) as caught:
        kind(service, PlanRequest.from_dict(request()), AWAY_S)
    assert AWAY_S - 0.1 <= time.monotonic() - begun_s < AWAY_S + 3.0
    assert str(caught.value) == (
        f"no coordinator has answered at {service.endpoint}, realm default, within 5 s"
    )


def test_the_command_says_what_it_has_waited_for(service: ServiceLab) -> None:
    service.kill("c1")
    path = service.lab.path("request.json", json.dumps(request(deadline_s=0.5)))
    ended = service.lab.finish(
        service.lab.start("plan", path, "--connect", service.endpoint), END_S
    )
    assert ended.status == 2
    (line,) = ended.err.splitlines()
    assert line.endswith(
        f"--connect: got {service.endpoint!r}; "
        "allowed: a network on which a coordinator answers within 8.5 s"
    )
