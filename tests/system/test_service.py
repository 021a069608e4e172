"""The planning service over a real network: coordinators that share it, and die while they do."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgpack
import psutil
import pytest

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.service.client import (
    AsyncPlanClient,
    PlanClient,
    RequestCancelledError,
    RequestRefusedError,
    ServiceUnavailableError,
)
from laneweave.protocol.runtime.queries import LATE, OVERLOADED
from laneweave.protocol.runtime.transport import Answer
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import SERVICE, Keys
from support.harness import END_S, Ended, laboratory
from support.mutations import ask_all, mutants
from support.service_lab import REALM, Load, ServiceLab, cpu_s, request, slow_request
from support.variants import variants

QUEUE_LIMIT, CLIENT_LIMIT = 64, 32
FLOOD = 500
SLOW_S = 60.0
"""Deadline of a request that takes as long as it may."""
FLAT_MB = 20.0
KEY = Keys(REALM).key(SERVICE)
NAMES = ("c1", "c2", "c3")
THREADS = 6


def start(folder: Path, names: tuple[str, ...]) -> Iterator[ServiceLab]:
    limit = f"queue_limit = {QUEUE_LIMIT}\nclient_queue_limit = {CLIENT_LIMIT}"
    with laboratory(folder) as lab, ServiceLab(lab, names, limit).running() as running:
        yield running


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceLab]:
    yield from start(tmp_path_factory.mktemp("service"), NAMES)


@pytest.fixture
def service(processes: ServiceLab) -> ServiceLab:
    """Three coordinators, whatever became of them in the test before."""
    processes.revive()
    return processes


@pytest.fixture
def client(service: ServiceLab) -> Iterator[PlanClient]:
    with PlanClient(service.access) as client:
        yield client


@pytest.fixture
def transport(service: ServiceLab) -> Iterator[ZenohTransport]:
    transport = ZenohTransport(service.access, lambda _: None)
    yield transport
    transport.close()


def asked(transport: ZenohTransport, payload: bytes, encoding: str = "") -> Answer:
    answer = transport.query(KEY, payload, END_S, encoding).result()
    assert answer is not None
    return answer


# --- malformed requests -----------------------------------------------------------------------


def check_malformed(service: ServiceLab, seed: int, count: int) -> None:
    verdicts = ask_all(service.access, mutants(seed, 1000))
    before_mb = {name: service.rss_mb(name) for name in service.names}
    verdicts += ask_all(service.access, mutants(seed + 1, count - 1000))
    grown_mb = {name: service.rss_mb(name) - before_mb[name] for name in service.names}
    assert verdicts.total() >= count
    assert verdicts["invalid"] > 0.7 * count
    assert verdicts["optimal"] > 0
    assert max(grown_mb.values()) < FLAT_MB
    with PlanClient(service.access) as client:
        for name in service.names:
            valid = PlanRequest.from_dict(service.for_one(name, request()))
            assert client.plan(valid).status == "optimal"


def test_malformed_requests(service: ServiceLab) -> None:
    check_malformed(service, seed=100, count=500)


@pytest.mark.full
def test_ten_thousand_malformed_requests_to_one(tmp_path: Path) -> None:
    for one in start(tmp_path, ("c1",)):
        check_malformed(one, seed=200, count=10_000)


# --- encodings, ids, clients ------------------------------------------------------------------


def pack(data: Any) -> bytes:  # noqa: ANN401 (JSON)
    packed = msgpack.packb(data)
    assert isinstance(packed, bytes)
    return packed


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize(
    ("write", "read", "encoding"),
    [
        (lambda data: json.dumps(data).encode(), json.loads, "application/json"),
        (pack, msgpack.unpackb, "application/msgpack"),
    ],
    ids=["JSON", "MessagePack"],
)
def test_an_id_that_is_repeated_gets_the_same_plan(
    transport: ZenohTransport,
    write: Callable[[Any], bytes],
    read: Callable[[bytes], Any],
    encoding: str,
    *,
    told: bool,
) -> None:
    payload = write(request(f"again-{encoding}-{told}"))
    asking = [transport.query(KEY, payload, END_S, encoding if told else "") for _ in range(5)]
    plans = []
    for answer in [*(each.result() for each in asking), asked(transport, payload, encoding)]:
        assert answer is not None
        assert (answer.ok, answer.encoding) == (True, encoding)
        plan = read(answer.payload)
        plans.append([plan[key] for key in ("status", "cost", "assignment", "paths")])
    assert plans[0][0] == "optimal"
    assert all(plan == plans[0] for plan in plans)


PLAIN = """
import json, sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    for selector in ("laneweave/default/service/plan", "laneweave/*/service/*", "laneweave/**"):
        for request in sys.argv[2:]:
            (reply,) = session.get(selector, payload=request, timeout=120.0)
            answer = reply.ok or reply.err
            print(bool(reply.ok), answer.encoding, answer.payload.to_string())
"""


def test_zenoh_and_json_are_enough(service: ServiceLab) -> None:
    bodies = [json.dumps(data) for data in (request(), request(mode=3))]
    run = subprocess.run(
        [sys.executable, "-c", PLAIN, service.endpoint, *bodies],
        capture_output=True,
        text=True,
        timeout=END_S,
        check=False,
    )
    assert Ended(run.returncode, run.stdout, run.stderr).complaints == []
    lines = [line.split(" ", 2) for line in run.stdout.splitlines()]
    assert len(lines) == 6
    for ok, encoding, text in lines:
        assert encoding == "application/json"
        assert json.loads(text).get("status" if ok == "True" else "field") in ("optimal", "mode")
    assert Counter(ok for ok, _, _ in lines) == {"True": 3, "False": 3}


def test_a_refusal_names_the_field(transport: ZenohTransport, client: PlanClient) -> None:
    # What a client cannot send of itself: it is checked when it is made.
    refused = asked(transport, json.dumps(request(deadline_s=601.0)).encode())
    assert json.loads(refused.payload)["field"] == "deadline_s"
    with pytest.raises(RequestRefusedError, match="at this service") as caught:
        client.plan(PlanRequest.from_dict(request(deadline_s=601.0)))
    assert caught.value.field == "deadline_s"


def test_a_client_waits_at_most_its_timeout(client: PlanClient) -> None:
    slow = PlanRequest.from_dict(slow_request("slow", 1.0))
    for timeout_s in (0.2, 0.0, -1.0, float("nan")):
        with pytest.raises(TimeoutError):
            client.plan(slow, timeout_s)
    for timeout_s in (1e30, float("inf")):
        assert client.plan(PlanRequest.from_dict(request()), timeout_s).status == "optimal"


def test_a_client_that_is_closed_says_so(service: ServiceLab) -> None:
    client = PlanClient(service.access)
    with Load(client.plan, threads=1, make=lambda: slow_request("", 2.0)) as load:
        service.lab.wait_until(lambda: load.asked == 1, END_S)
        client.close()
    (outcome,) = load.failures
    assert isinstance(outcome, ServiceUnavailableError)
    with pytest.raises(ServiceUnavailableError, match="closed"):
        client.plan(PlanRequest.from_dict(request()))


# --- limits -----------------------------------------------------------------------------------


@pytest.mark.more
def test_a_queue_that_is_full_refuses_and_drops_what_is_late(
    service: ServiceLab, transport: ZenohTransport, client: PlanClient
) -> None:
    # The first one keeps the worker until long after the deadlines of the others. All are made
    # before one is sent, so that they come at once, on a slow machine too.
    deadlines_s = (6.0, *(QUEUE_LIMIT + 5) * (2.5,))
    made = [service.for_one("c1", slow_request("", deadline_s)) for deadline_s in deadlines_s]
    begun_s = time.monotonic()
    asking = [transport.query(KEY, json.dumps(data).encode(), END_S) for data in made]
    # A client asks again until there is room.
    patient = PlanRequest.from_dict(service.for_one("c1", request()))
    assert client.plan(patient, END_S).status == "optimal"

    codes: Counter[str] = Counter()
    for answer in (future.result() for future in asking):
        assert answer is not None
        data = json.loads(answer.payload)
        codes[data["status"] if answer.ok else data["code"]] += 1
        assert answer.ok or len(data["message"].splitlines()) == 1
    assert codes[OVERLOADED] >= 1
    # A few may have come when others had been dropped, or be what the worker has last.
    assert codes[LATE] >= CLIENT_LIMIT / 2
    assert set(codes) <= {OVERLOADED, LATE, "feasible", "optimal", "timeout"}
    # Late requests are answered before a worker gets to them, which would take 150 s.
    assert time.monotonic() < begun_s + 75.0


def test_a_flood_does_not_exclude_another_client(
    service: ServiceLab, transport: ZenohTransport, client: PlanClient
) -> None:
    # The first one keeps the worker until the others have come, on a slow machine too.
    first = service.for_one("c1", slow_request("", 2.5))
    made = [first, *(service.for_one("c1", request()) for _ in range(FLOOD))]
    quiet = [PlanRequest.from_dict(service.for_one("c1", request())) for _ in range(10)]
    asking = [transport.query(KEY, json.dumps(data).encode(), END_S) for data in made]
    for each in quiet:
        # Clients are served in turn, and the limit is that of the other one.
        assert client.plan(each, END_S).status == "optimal"
    answers = [future.result() for future in asking]
    refusals = [json.loads(one.payload) for one in answers if one is not None and not one.ok]
    assert len(refusals) >= FLOOD / 4
    for refusal in refusals:
        assert refusal["code"] == OVERLOADED
        assert "service.client_queue_limit: got 32 pending" in refusal["message"]
        assert refusal["retry_after_s"] > 0


# --- cancelled requests -----------------------------------------------------------------------

KILLED = """
import sys
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.service.client import PlanClient
import json
with PlanClient(sys.argv[1]) as client:
    client.plan(PlanRequest.from_dict(json.loads(sys.argv[2])), timeout_s=100.0)
"""


def leave_by_timeout(service: ServiceLab, asked: PlanRequest, begun: Callable[[], None]) -> None:
    with PlanClient(service.access) as client:
        with pytest.raises(TimeoutError):
            client.plan(asked, timeout_s=1.0)
        begun()


def leave_by_cancelling(service: ServiceLab, asked: PlanRequest, begun: Callable[[], None]) -> None:
    with PlanClient(service.access) as client, ThreadPoolExecutor(1) as pool:
        planning = pool.submit(client.plan, asked, END_S)
        begun()
        client.cancel(asked.id)
        with pytest.raises(RequestCancelledError):
            planning.result(END_S)


def leave_by_task(service: ServiceLab, asked: PlanRequest, begun: Callable[[], None]) -> None:
    async def ask_and_cancel() -> None:
        async with AsyncPlanClient(service.access) as client:
            task = asyncio.create_task(client.plan(asked, END_S))
            await asyncio.to_thread(begun)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    asyncio.run(ask_and_cancel())


def leave_by_death(service: ServiceLab, asked: PlanRequest, begun: Callable[[], None]) -> None:
    command = [sys.executable, "-c", KILLED, service.endpoint, json.dumps(asked.to_dict())]
    with subprocess.Popen(command) as process:
        begun()
        process.kill()


@pytest.mark.parametrize(
    "leave", variants([leave_by_cancelling, leave_by_death, leave_by_timeout, leave_by_task], 2)
)
def test_a_request_whose_client_leaves_frees_its_worker(
    service: ServiceLab,
    client: PlanClient,
    leave: Callable[[ServiceLab, PlanRequest, Callable[[], None]], None],
) -> None:
    worker = service.worker("c1")
    server = psutil.Process(worker).ppid()
    spent_s = cpu_s(worker)
    slow = PlanRequest.from_dict(service.for_one("c1", slow_request("", SLOW_S)))
    next_one = PlanRequest.from_dict(service.for_one("c1", request()))
    began_s = time.monotonic()
    leave(
        service,
        slow,
        lambda: service.lab.wait_until(lambda: cpu_s(worker) > spent_s + 0.1, END_S),
    )
    assert client.plan(next_one, END_S).status == "optimal"
    assert time.monotonic() < began_s + SLOW_S
    # The worker goes on, or is replaced by another fork: no interpreter had to start.
    assert psutil.Process(service.worker("c1")).ppid() == server


# --- death ------------------------------------------------------------------------------------


def check_load(load: Load, fault_s: float) -> None:
    """Check that all requests were answered in time, some of them in flight at a fault."""
    assert load.failures == []
    assert load.in_flight(fault_s) >= 3


@pytest.mark.more
def test_a_coordinator_that_hangs(service: ServiceLab, client: PlanClient) -> None:
    process = service.coordinators["c3"]
    with Load(client.plan, threads=THREADS) as load:
        load.wait_answers(2 * THREADS)
        process.send_signal(signal.SIGSTOP)
        stopped_s = time.monotonic()
        service.lab.wait_until(lambda: "c3" not in service.alive, END_S)
        process.send_signal(signal.SIGCONT)
        load.wait_answers(2 * THREADS)
    check_load(load, stopped_s)
    service.lab.wait_until(lambda: service.alive == set(NAMES), END_S)


@pytest.mark.more
def test_a_worker_that_is_killed(service: ServiceLab, client: PlanClient) -> None:
    with Load(client.plan, threads=THREADS) as load:
        load.wait_answers(2 * THREADS)
        killed = service.worker("c1")
        os.kill(killed, signal.SIGKILL)
        killed_s = time.monotonic()
        load.wait_answers(4 * THREADS)
    check_load(load, killed_s)
    assert service.worker("c1", other_than=killed) > 0


def test_a_coordinator_that_is_killed(service: ServiceLab, client: PlanClient) -> None:
    async def ask_and_kill() -> tuple[Load, float]:
        async with AsyncPlanClient(service.access) as tasks_client:
            load = Load(tasks_client.plan)
            tasks = [asyncio.create_task(load.ask_in_turn()) for _ in range(THREADS)]
            await asyncio.to_thread(load.wait_answers, 2 * THREADS)
            killed_s = await asyncio.to_thread(service.kill, "c2")
            await asyncio.to_thread(load.wait_answers, 4 * THREADS)
            load.over.set()
            await asyncio.gather(*tasks)
        return load, killed_s

    with Load(client.plan, threads=THREADS) as of_threads:
        of_tasks, killed_s = asyncio.run(ask_and_kill())
    check_load(of_threads, killed_s)
    check_load(of_tasks, killed_s)


@pytest.mark.more
def test_an_end_while_requests_are_in_flight(processes: ServiceLab) -> None:
    processes.revive(least=2)
    name = max(processes.coordinators)

    def slow() -> dict[str, Any]:
        return processes.for_one(name, slow_request("", 3.0))

    children = psutil.Process(processes.coordinators[name].pid).children(recursive=True)
    with PlanClient(processes.access) as client, Load(client.plan, threads=3, make=slow) as load:
        processes.lab.wait_until(lambda: load.asked == 3, END_S)
        load.over.set()
        took_s = processes.stop(name)
    # The others have answered: a plan, or that the deadline passed first.
    assert took_s < END_S
    assert len(load.outcomes) == 3
    assert set(load.outcomes) <= {"feasible", "optimal", "timeout", "DeadlinePassedError"}
    assert load.outcomes.count("DeadlinePassedError") < 3
    processes.lab.wait_until(lambda: not any(child.is_running() for child in children), END_S)
