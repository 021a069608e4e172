"""Overhead of the planning service: throughput, latency, and the loss of a coordinator.

    python benchmarks/service.py [--json docs/evidence/service.json]

Real processes: a router, coordinators started with `laneweave coordinator`, and clients in a
separate process. Requests are formations of 6 to 18 vehicles. Four measurements:

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
- *loss*: three coordinators with one worker each, of which one after another is killed. The figures
  count the requests that were in flight when one was killed, or were sent within the next second.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from attrs import define, field, frozen

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan, warm_up
from laneweave.coordinator.service.client import AsyncPlanClient, PlanClient, PlanError
from laneweave.launch.bench.request_families import formation_request
from laneweave.sim_bridge.recording.trips import percentiles_of

LANEWEAVE = str(Path(sys.executable).with_name("laneweave"))
REQUESTS, CLIENTS = 200, 20
SIZES = range(6, 19)
DEADLINE_S = 300.0
"""Longer than the whole measurement: no request is dropped, and plans do not depend on the load."""
SMALL = range(6, 11)
LOSSES = 10
LOSS_PAUSE_S = 3.0
LOSS_RATE_PER_S = 60.0
START_S = 60.0


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
    warm_up()
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
        "repeated_ms_p50": 1e3 * statistics.median(one.latency_s for one in again),
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


def quantiles(values: list[float]) -> dict[str, float | None]:
    """Return the percentiles and the maximum of a distribution."""
    return percentiles_of(np.array(values), 50, 95, 99, largest=True)


def main() -> None:
    """Run all measurements, or the selected one."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="output file")
    parser.add_argument("--only", choices=("load", "half", "loss"))
    options = parser.parse_args()
    found: dict[str, Any] = {"cores": len(os.sched_getaffinity(0))}
    if options.only in (None, "load"):
        found["alone"] = alone()
        rate = found["alone"]["rate_per_s"]
        found["load"] = [load(workers, rate) for workers in (1, 2)]
    if options.only in (None, "half"):
        warm_up()
        found["half"] = [half(1, SIZES, 300), half(2, SIZES, 300), half(1, SMALL, 1000)]
    if options.only in (None, "loss"):
        warm_up()
        found["loss"] = loss()
    text = json.dumps(found, indent=2) + "\n"
    if options.json:
        options.json.write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
