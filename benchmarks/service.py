"""Overhead of the planning service: throughput, latency, and the loss of a coordinator.

    python benchmarks/service.py [--json docs/evidence/service.json]

Real processes: a router, coordinators started with `laneweave coordinator`, and clients in a
separate process. Requests are formations of 6 to 18 vehicles. The measurements:

- *alone*: the solver in a process without other work, one request after the other. Its rate is the
  upper bound for a worker.
- *load*: 200 requests in flight from 20 clients. Each must be answered, and a repetition of the
  request with the same id must get the same plan. The figures are the rate, also relative to that
  of the solver alone, measured some minutes earlier, and the share of the workers' time spent
  solving, which does not depend on other load on the machine.
- *half*: requests arrive at random, at half the rate that the workers can process. The overhead of
  the service is the latency minus the solver's time and minus the time that the request waited for
  a busy worker: even at half load, any single server has a queue. Measured with the same
  formations, and with small ones at hundreds of requests per second.
- *turns*: one client, then four, each with one small request in flight, of the paper's kinds of
  conflict. The figures are the rate and the overhead.
- *loss*: three coordinators with one worker each, of which one after another is killed. The figures
  count the requests that were in flight when one was killed, or were sent within the next second.
- *cancel*: a client asks for a plan that takes 5 s, and cancels its task, exceeds its timeout, or
  is killed; or its request is so large that the planner does not read the clock for seconds. The
  figures are the latencies of a small request that another client sends at that moment to the same
  single worker.
- *flood*: the latency of small requests that one client sends one after the other, alone and while
  another client has 1000 requests in flight. The flooding client is a `PlanClient`, which waits
  before it repeats a refused request, or a program that sends another request at once.
- *road*: a run at the pace of real time, alone and under each of these floods.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from attrs import define, field, frozen

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.coordinator.service.client import AsyncPlanClient, PlanClient, PlanError
from laneweave.launch.bench.request_families import block_request, formation_request
from laneweave.protocol.runtime.queries import JSON
from laneweave.protocol.scenario.formation_table import DEFAULT_CONFLICTS
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.topics import SERVICE, Keys
from laneweave.sim_bridge.recording.statistics import percentiles_of

LANEWEAVE = str(Path(sys.executable).with_name("laneweave"))
REQUESTS, CLIENTS = 200, 20
SIZES = range(6, 19)
DEADLINE_S = 300.0
"""Longer than the whole measurement: no request is dropped, and plans do not depend on the load."""
SMALL = range(6, 11)
TURNS, TURNS_START_S = 1000, 10.0
LOSSES = 10
LOSS_PAUSE_S = 3.0
LOSS_RATE_PER_S = 60.0
START_S = 60.0
LONG_S = 5.0
LONG_VEHICLES = 40
LEAVE_AFTER_S = 0.5
LEAVES = 10
FLOOD_REQUESTS = 1000
"""Number of requests that a flooding client has in flight."""
FLOOD_START_S = 5.0
QUIET_REQUESTS = 60
QUIET_PAUSE_S = 0.02
RUN_OPTIONS = ("--duration", "15", "--pace", "1", "--no-progress")


def instance(seed: int, sizes: Sequence[int]) -> PlanRequest:
    """Return a request for one formation; the seed selects its size."""
    request = formation_request(seed, vehicles=sizes[seed % len(sizes)], deadline_s=DEADLINE_S)
    return attrs.evolve(request, id=f"request-{seed}", solver="branching")


@define
class Network:
    """A router and coordinators, as processes."""

    folder: Path
    workers: int
    processes: dict[str, subprocess.Popen[bytes]] = field(factory=dict)

    @property
    def endpoint(self) -> str:
        """Endpoint of the router."""
        return f"unixsock-stream/{self.folder}/router.sock"

    def start(self, *arguments: str, name: str) -> None:
        """Start a role."""
        config = self.folder / "deployment.toml"
        config.write_text(
            f'[network]\nendpoint = "{self.endpoint}"\n'
            f"[service]\nworkers = {self.workers}\nqueue_limit = 1000\n"
        )
        self.processes[name] = subprocess.Popen(  # noqa: S603
            [LANEWEAVE, *arguments, "--config", str(config)], stderr=subprocess.DEVNULL
        )

    def start_coordinator(self, name: str) -> None:
        """Start a coordinator."""
        self.start("coordinator", "--name", name, name=name)

    def end(self) -> None:
        """End all processes."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            process.wait(30)


@contextlib.contextmanager
def network(coordinators: int, workers: int) -> Iterator[Network]:
    """Start a router and coordinators, and wait until they answer requests."""
    with tempfile.TemporaryDirectory(prefix="laneweave-") as folder:
        started = Network(Path(folder), workers)
        try:
            started.start("router", name="router")
            _until((Path(folder) / "router.sock").exists)
            time.sleep(1.0)
            for number in range(coordinators):
                started.start_coordinator(f"c{number + 1}")
            with PlanClient(started.endpoint) as client:
                _until(lambda: _answers(client))
                # Warm up every worker of every coordinator.
                for seed in range(60):
                    client.plan(formation_request(seed), START_S)
            time.sleep(3.0)
            yield started
        finally:
            started.end()


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + START_S
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit("the network did not start")
        time.sleep(0.1)


def _answers(client: PlanClient) -> bool:
    try:
        client.plan(formation_request(1), START_S)
    except PlanError:
        return False
    return True


@frozen
class Exchange:
    """One request and its response, with the client's timing."""

    sent_s: float
    latency_s: float
    response: PlanResponse

    @property
    def added_ms(self) -> float:
        """Latency minus the solver's time and the wait for a busy worker."""
        waited_ms = self.response.waited_ms or 0.0
        return 1e3 * self.latency_s - self.response.solve_ms - waited_ms


async def request_plan(client: AsyncPlanClient, request: PlanRequest) -> Exchange:
    """Send a request and return the response with the latency."""
    begun_s = time.monotonic()
    response = await client.plan(request, timeout_s=2 * DEADLINE_S)
    return Exchange(begun_s, time.monotonic() - begun_s, response)


async def with_clients(
    endpoint: str, work: Callable[[list[AsyncPlanClient]], Awaitable[Any]], count: int = CLIENTS
) -> Any:  # noqa: ANN401
    """Connect clients and run `work` with them."""
    async with contextlib.AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(AsyncPlanClient(endpoint)) for _ in range(count)]
        return await work(clients)


def alone() -> dict[str, Any]:
    """Measure the solver by itself."""
    BRANCHING.load()
    requests = [instance(seed, SIZES) for seed in range(REQUESTS)]
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    for request in requests:
        plan(request)
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    return {"requests": REQUESTS, "rate_per_s": REQUESTS / wall_s, "wall_s": wall_s, "cpu_s": cpu_s}


def plan_of(exchange: Exchange) -> tuple[object, ...]:
    """Return the plan in a response, without the times."""
    response = exchange.response
    return response.status, response.cost, response.assignment, response.paths


def load(workers: int, solver_rate_per_s: float) -> dict[str, Any]:
    """Measure 200 requests in flight from 20 clients, each repeated with the same id."""

    async def work(clients: list[AsyncPlanClient]) -> tuple[list[Exchange], list[Exchange], float]:
        requests = [instance(seed, SIZES) for seed in range(REQUESTS)]
        begun_s = time.monotonic()
        first = await asyncio.gather(
            *(request_plan(clients[i % CLIENTS], request) for i, request in enumerate(requests))
        )
        took_s = time.monotonic() - begun_s
        again = await asyncio.gather(
            *(request_plan(clients[-i % CLIENTS], request) for i, request in enumerate(requests))
        )
        return first, again, took_s

    with network(coordinators=1, workers=workers) as net:
        first, again, took_s = asyncio.run(with_clients(net.endpoint, work))
    differ = sum(plan_of(a) != plan_of(b) for a, b in zip(first, again, strict=True))
    rate = REQUESTS / took_s
    return {
        "workers": workers,
        "clients": CLIENTS,
        "requests": REQUESTS,
        "answered": len(first),
        "answered_differently": differ,
        "took_s": took_s,
        "rate_per_s": rate,
        "of_solvers_rate": rate / (workers * solver_rate_per_s),
        "of_workers_time": sum(one.response.solve_ms for one in first) / (1e3 * workers * took_s),
    }


def half(workers: int, sizes: Sequence[int], count: int) -> dict[str, Any]:
    """Measure the overhead for requests that arrive at random, at half load."""
    mean_s = statistics.mean(plan(instance(seed, sizes)).solve_ms / 1e3 for seed in range(200))
    rng = random.Random(1)  # noqa: S311

    async def work(clients: list[AsyncPlanClient]) -> list[Exchange]:
        tasks = []
        due_s = time.monotonic()
        for seed in range(count):
            due_s += rng.expovariate(0.5 * workers / mean_s)
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            tasks.append(
                asyncio.create_task(request_plan(clients[seed % CLIENTS], instance(seed, sizes)))
            )
        return await asyncio.gather(*tasks)

    with network(coordinators=1, workers=workers) as net:
        exchanges = asyncio.run(with_clients(net.endpoint, work))
    added = [one.added_ms for one in exchanges]
    return {
        "workers": workers,
        "sizes": [sizes[0], sizes[-1]],
        "requests": count,
        "solve_ms_mean": 1e3 * mean_s,
        "added_ms": quantiles(added),
        "waited_ms": quantiles([one.response.waited_ms or 0.0 for one in exchanges]),
        "solve_ms": quantiles([one.response.solve_ms for one in exchanges]),
    }


def turns(clients: int) -> dict[str, Any]:
    """Measure clients that send one request after the other, each in its own process."""
    context = multiprocessing.get_context("spawn")
    count = TURNS // clients
    with network(coordinators=1, workers=2) as net, context.Pool(clients) as pool:
        start_s = time.monotonic() + TURNS_START_S
        shares = [(net.endpoint, start_s, number * count, count) for number in range(clients)]
        exchanges = [one for share in pool.starmap(_ask_in_turn, shares, 1) for one in share]
    end_s = max(one.sent_s + one.latency_s for one in exchanges)
    beyond = [1e3 * one.latency_s - one.response.solve_ms for one in exchanges]
    return {
        "clients": clients,
        "requests": len(exchanges),
        "rate_per_s": len(exchanges) / (end_s - start_s),
        "beyond_solving_ms": quantiles(beyond),
        "added_ms": quantiles([one.added_ms for one in exchanges]),
        "solve_ms": quantiles([one.response.solve_ms for one in exchanges]),
    }


def _ask_in_turn(endpoint: str, start_s: float, first: int, count: int) -> list[Exchange]:
    requests = [
        block_request(seed, vehicles=6, columns=4, conflicts=("node", "edge"))
        for seed in range(first, first + count)
    ]
    exchanges = []
    with PlanClient(endpoint) as client:
        client.plan(requests[0])
        time.sleep(max(0.0, start_s - time.monotonic()))
        for request in requests:
            begun_s = time.monotonic()
            response = client.plan(request)
            exchanges.append(Exchange(begun_s, time.monotonic() - begun_s, response))
    return exchanges


def loss() -> dict[str, Any]:
    """Kill one of three coordinators after another, under load."""
    rng = random.Random(2)  # noqa: S311
    killed_s: list[float] = []

    async def work(clients: list[AsyncPlanClient], net: Network) -> list[Exchange]:
        tasks: list[asyncio.Task[Exchange]] = []
        seed = 0
        for number in range(LOSSES):
            name = f"c{1 + number % 3}"
            kill_s, restart_s = time.monotonic() + LOSS_PAUSE_S, None
            while time.monotonic() < kill_s + LOSS_PAUSE_S:
                seed += 1
                tasks.append(
                    asyncio.create_task(
                        request_plan(clients[seed % CLIENTS], instance(seed, SMALL))
                    )
                )
                await asyncio.sleep(rng.expovariate(LOSS_RATE_PER_S))
                if restart_s is None and time.monotonic() > kill_s:
                    net.processes[name].kill()
                    killed_s.append(time.monotonic())
                    restart_s = time.monotonic() + 1.0
            net.processes[name].wait()
            net.start_coordinator(name)
            await asyncio.sleep(5.0)
        return await asyncio.gather(*tasks)

    with network(coordinators=3, workers=1) as net:
        exchanges = asyncio.run(with_clients(net.endpoint, lambda clients: work(clients, net)))
    hit = [
        one
        for one in exchanges
        for at_s in killed_s
        if one.sent_s < at_s + 1.0 and one.sent_s + one.latency_s > at_s
    ]
    beyond = [1e3 * one.latency_s - one.response.solve_ms for one in hit]
    return {
        "coordinators": 3,
        "rate_per_s": LOSS_RATE_PER_S,
        "killed": len(killed_s),
        "requests": len(exchanges),
        "answered": sum(one.response.status in ("optimal", "feasible") for one in exchanges),
        "around_the_kills": len(hit),
        "beyond_solving_ms": quantiles(beyond),
    }


def long_request(seed: int) -> PlanRequest:
    """Return a request that is planned until its deadline."""
    return formation_request(seed, vehicles=LONG_VEHICLES, deadline_s=LONG_S)


def large_request(seed: int) -> PlanRequest:
    """Return a request for which the planner hardly reads the clock."""
    columns, lanes = 1000, 16
    vehicles = tuple(
        VehicleRequest(f"v{i}", (i // lanes * 2, i % lanes), lanes - 1 - i % lanes)
        for i in range(200)
    )
    targets = tuple((i // lanes, i % lanes) for i in range(400))
    grid = Grid(columns, lanes)
    name = f"large-{seed}"
    return PlanRequest(grid, 2, DEFAULT_CONFLICTS[2], vehicles, targets, LONG_S, id=name)


async def cancel_task(endpoint: str, request: PlanRequest) -> None:
    """Ask, and cancel the task that waits for the answer."""
    async with AsyncPlanClient(endpoint) as client:
        task = asyncio.create_task(client.plan(request))
        await asyncio.sleep(LEAVE_AFTER_S)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def exceed_timeout(endpoint: str, request: PlanRequest) -> None:
    """Ask, and wait for less time than the plan takes."""
    async with AsyncPlanClient(endpoint) as client:
        with contextlib.suppress(TimeoutError):
            await client.plan(request, LEAVE_AFTER_S)


async def be_killed(endpoint: str, request: PlanRequest) -> None:
    """Ask in a process that is killed."""
    context = multiprocessing.get_context("spawn")
    asked = context.Event()
    process = context.Process(target=_ask_forever, args=(endpoint, request, asked))
    process.start()
    await asyncio.to_thread(asked.wait)
    await asyncio.sleep(LEAVE_AFTER_S)
    os.kill(process.pid or 0, signal.SIGKILL)
    process.join()


def _ask_forever(endpoint: str, request: PlanRequest, asked: threading.Event) -> None:
    with PlanClient(endpoint) as client:
        asked.set()
        client.plan(request)


def cancel() -> list[dict[str, Any]]:
    """Measure how soon a worker is free after the client of its request has left."""
    ways = {
        "task cancelled": (cancel_task, long_request),
        "timeout": (exceed_timeout, long_request),
        "client killed": (be_killed, long_request),
        "timeout, 200 vehicles": (exceed_timeout, large_request),
    }

    async def latencies_ms(
        endpoint: str,
        leave: Callable[..., Awaitable[None]],
        make: Callable[[int], PlanRequest],
    ) -> list[float]:
        found = []
        async with AsyncPlanClient(endpoint) as client:
            for seed in range(LEAVES):
                await leave(endpoint, make(seed))
                small = formation_request(seed, deadline_s=DEADLINE_S)
                found.append(1e3 * (await request_plan(client, small)).latency_s)
        return found

    with network(coordinators=1, workers=1) as net:
        return [
            {"client": name, "times": LEAVES, "plan_s": LONG_S}
            | {"next_ms": quantiles(asyncio.run(latencies_ms(net.endpoint, leave, make)))}
            for name, (leave, make) in ways.items()
        ]


def flood_patiently(endpoint: str) -> None:
    """Keep requests in flight with a client that waits before it repeats a refused one."""

    async def ask_in_turn(client: AsyncPlanClient, seed: int) -> None:
        while True:
            with contextlib.suppress(PlanError, TimeoutError):
                await client.plan(formation_request(seed), DEADLINE_S)

    async def work() -> None:
        async with AsyncPlanClient(endpoint) as client:
            await asyncio.gather(*(ask_in_turn(client, seed) for seed in range(FLOOD_REQUESTS)))

    asyncio.run(work())


def flood_at_once(endpoint: str) -> None:
    """Keep requests in flight without a pause, whatever the answers are."""
    transport = ZenohTransport(Access(endpoint), lambda _: None)
    key = Keys("default").key(SERVICE)
    payloads = [JSON.write(formation_request(seed).to_dict()) for seed in range(FLOOD_REQUESTS)]
    free = threading.Semaphore(FLOOD_REQUESTS)
    number = 0
    while True:
        free.acquire()
        number += 1
        payload = payloads[number % FLOOD_REQUESTS]
        query = transport.query(key, payload, DEADLINE_S, JSON.encoding)
        query.add_done_callback(lambda _: free.release())


FLOODS: dict[str, Callable[[str], None] | None] = {
    "none": None,
    "waits when refused": flood_patiently,
    "sends at once": flood_at_once,
}


@contextlib.contextmanager
def flooded(endpoint: str, flood: Callable[[str], None] | None) -> Iterator[None]:
    """Run a flooding client in another process."""
    if flood is None:
        yield
        return
    process = multiprocessing.get_context("spawn").Process(target=flood, args=(endpoint,))
    process.start()
    try:
        time.sleep(FLOOD_START_S)
        yield
    finally:
        process.kill()
        process.join()


def flood() -> list[dict[str, Any]]:
    """Measure the latency of a client while another one floods the service."""

    async def latencies_ms(endpoint: str) -> list[float]:
        found = []
        async with AsyncPlanClient(endpoint) as client:
            for seed in range(QUIET_REQUESTS):
                small = formation_request(seed, deadline_s=DEADLINE_S)
                found.append(1e3 * (await request_plan(client, small)).latency_s)
                await asyncio.sleep(QUIET_PAUSE_S)
        return found

    with network(coordinators=1, workers=1) as net:
        rows = []
        for name, other in FLOODS.items():
            with flooded(net.endpoint, other):
                quiet_ms = asyncio.run(latencies_ms(net.endpoint))
            rows.append(
                {"flood": name, "requests": QUIET_REQUESTS, "quiet_ms": quantiles(quiet_ms)}
            )
            time.sleep(FLOOD_START_S)
        return rows


def road() -> list[dict[str, Any]]:
    """Measure runs while a client floods the leader's planning service."""
    return [{"flood": name} | _run_flooded(other) for name, other in FLOODS.items()]


def _run_flooded(other: Callable[[str], None] | None) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="lw-") as name:
        folder = Path(name)
        with subprocess.Popen(  # noqa: S603
            [LANEWEAVE, "run", *RUN_OPTIONS, "--out", str(folder / "out")],
            env=os.environ | {"TMPDIR": name},
            stdout=subprocess.DEVNULL,
        ) as run:
            _until(lambda: any(folder.glob("laneweave-*/router.sock")))
            (socket,) = folder.glob("laneweave-*/router.sock")
            with flooded(f"unixsock-stream/{socket}", other):
                run.wait()
        summary = json.loads((folder / "out" / "summary.json").read_text(encoding="utf-8"))
    return {
        "real_time_factor": summary["runtime"]["real_time_factor"],
        "tick_ms": summary["runtime"]["tick_ms"],
        "leader_changes": summary["failover"]["leader_changes"],
        "overlaps": summary["safety"]["overlaps"],
        "vehicles": summary["vehicles"],
    }


def quantiles(values: list[float]) -> dict[str, float | None]:
    """Return the percentiles and the maximum of a distribution."""
    return percentiles_of(np.array(values), 50, 95, 99, largest=True)


MEASUREMENTS = ("load", "half", "turns", "loss", "cancel", "flood", "road")


def main() -> None:
    """Run all measurements, or the selected one."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="output file; `--only` replaces one part of it")
    parser.add_argument("--only", choices=MEASUREMENTS)
    options = parser.parse_args()
    found: dict[str, Any] = {}
    if options.only is not None and options.json and options.json.exists():
        found = json.loads(options.json.read_text(encoding="utf-8"))
    found["cores"] = len(os.sched_getaffinity(0))
    if options.only in (None, "load"):
        found["alone"] = alone()
        rate = found["alone"]["rate_per_s"]
        found["load"] = [load(workers, rate) for workers in (1, 2)]
    if options.only in (None, "half"):
        BRANCHING.load()
        found["half"] = [half(1, SIZES, 300), half(2, SIZES, 300), half(1, SMALL, 1000)]
    if options.only in (None, "turns"):
        found["turns"] = [turns(clients) for clients in (1, 4)]
    if options.only in (None, "loss"):
        BRANCHING.load()
        found["loss"] = loss()
    found |= {
        name: measure()
        for name, measure in (("cancel", cancel), ("flood", flood), ("road", road))
        if options.only in (None, name)
    }
    text = json.dumps(found, indent=2) + "\n"
    if options.json:
        options.json.write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
