"""Cost of one more agent process: `python benchmarks/startup.py [--json] [--agents N]`.

The real fork server starts a router and agent processes of one vehicle each, one after the other.
An agent is ready when its token appears: by then it has its tracker and its subscriptions. Some
ticks follow, in which the vehicles hold their cells. For each process:

    ready_cpu_ms   CPU time of all threads, user and system, from the fork to the token
    first_cpu_ms   the same from the first SENSE to the COMMAND that answers it
    own_mb         private memory (USS) after some ticks, not shared with other processes

The CPU time of starting the fork server, which happens once, is reported separately.
"""

from __future__ import annotations

import argparse
import json
import queue
import statistics
import sys
import time
from collections.abc import Iterable
from contextlib import closing, suppress
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import psutil
from attrs import define, evolve, field

from laneweave.launch.run.roles import end_role, fork_server, start_role
from laneweave.protocol.config.scenario_files import to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.runtime.transport import Delivery, Received, TokenUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.connection import Access
from laneweave.protocol.transports.zenoh.transport import ZenohTransport
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Name, Sense
from laneweave.protocol.wire.topics import COMMAND, SENSE, VEHICLE_ALIVE, Keys
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle

AGENTS = 20
WAIT_S = 60.0
TICKS = 20


def cpu_ms(process_id: int) -> float:
    """Return the CPU time of a process in ms.

    The argument of `clock_gettime` is Linux's id of the process's CPU clock. The resolution of this
    clock is 1 ns, that of /proc 10 ms.
    """
    return time.clock_gettime((~process_id << 3) | 2) * 1e3


@define
class Fleet:
    """Started agent processes and their measurements."""

    scenario: Scenario
    processes: dict[Name, ForkServerProcess] = field(factory=dict)
    ready_ms: dict[Name, float] = field(factory=dict)
    first_ms: dict[Name, float] = field(factory=dict)

    def start(self, count: int, folder: str) -> None:
        """Start a router and agents; wait for each agent, then run some ticks."""
        context, network = fork_server(), self.scenario.network
        tables, options = to_tables(self.scenario), {"folder": folder, "temporary": folder}
        router = Name("router")
        self.processes[router] = start_role(context, router, router, tables, options)
        inbox: queue.SimpleQueue[Delivery] = queue.SimpleQueue()
        keys = Keys(network.realm)
        with closing(_connected(network.endpoint, inbox)) as transport:
            transport.watch(keys.all_of(VEHICLE_ALIVE))
            transport.subscribe(keys.all_of(COMMAND))
            for number in range(1, count + 1):
                name = Name(f"v{number:04d}")
                self.processes[name] = start_role(
                    context, "agent", f"agent-{name}", tables, options | {"vehicles": [name]}
                )
                _await_key(inbox, keys.key(VEHICLE_ALIVE, process=name, vehicle=name))
                self.ready_ms[name] = self._cpu_ms(name)
            for tick in range(TICKS):
                for name in self.ready_ms:
                    before_ms = self._cpu_ms(name)
                    payload = encode(self._sense(name, tick))
                    transport.publish(
                        keys.key(SENSE, process=name, vehicle=name), payload, SENSE.quality
                    )
                    _await_key(inbox, keys.key(COMMAND, vehicle=name))
                    if tick == 0:
                        self.first_ms[name] = self._cpu_ms(name) - before_ms

    def _cpu_ms(self, name: Name) -> float:
        return cpu_ms(self.processes[name].pid or 0)

    def _sense(self, name: Name, tick: int) -> Sense:
        admission = Admission(Arrival(name, 1, 1, 0.0), (-1, 1), 0.0)
        t_s = tick * self.scenario.runtime.tick_s
        return RoadVehicle.entering(admission, t_s, self.scenario).sense(tick, caretaker=False)

    def end(self) -> None:
        """End all processes."""
        for process in reversed(self.processes.values()):
            end_role(process)
            process.join()


def _connected(endpoint: str, inbox: queue.SimpleQueue[Delivery]) -> ZenohTransport:
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return ZenohTransport(Access(endpoint), inbox.put)
        except BadInputError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def _await_key(inbox: queue.SimpleQueue[Delivery], key: str) -> None:
    """Wait for a token or a message on a key."""
    deadline = time.monotonic() + WAIT_S
    while time.monotonic() < deadline:
        with suppress(queue.Empty):
            delivery = inbox.get(timeout=1.0)
            if isinstance(delivery, (TokenUp, Received)) and delivery.key == key:
                return
    raise RuntimeError(f"no token or message on {key}")


def measured(count: int) -> dict[str, Any]:
    """Start agents and return the cost of one more."""
    # Each process executes the main file of its supervisor: use the one of `laneweave` here, too.
    sys.modules["__main__"].__file__ = str(Path(sys.executable).with_name("laneweave"))
    with temporary_folder() as folder:
        base = Scenario()
        network = evolve(base.network, endpoint=f"unixsock-stream/{folder}/router.sock")
        fleet = Fleet(evolve(base, network=network))
        try:
            fleet.start(count, str(folder))
            return _figures(fleet)
        finally:
            fleet.end()


def _figures(fleet: Fleet) -> dict[str, Any]:
    agents = [psutil.Process(fleet.processes[name].pid) for name in fleet.ready_ms]
    server = agents[0].parent()
    if server is None:
        raise RuntimeError("the fork server has ended")
    memory = [agent.memory_full_info() for agent in agents]
    return {
        "agents": len(agents),
        "ready_cpu_ms": _median(fleet.ready_ms.values()),
        "first_cpu_ms": _median(fleet.first_ms.values()),
        "own_mb": _median(each.uss / 1e6 for each in memory),
        "resident_mb": _median(each.rss / 1e6 for each in memory),
        "threads": _median(agent.num_threads() for agent in agents),
        "server_cpu_ms": round(cpu_ms(server.pid), 1),
        "server_resident_mb": round(server.memory_info().rss / 1e6, 1),
        "server_threads": server.num_threads(),
    }


def _median(values: Iterable[float]) -> float:
    return round(statistics.median(values), 2)


def main() -> None:
    """Measure and print the figures."""
    parser = argparse.ArgumentParser(description="Cost of one more agent process.")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--agents", type=int, default=AGENTS, help="number of agents")
    options = parser.parse_args()
    figures = measured(options.agents)
    if options.json:
        sys.stdout.write(json.dumps(figures) + "\n")
        return
    for name, value in figures.items():
        sys.stdout.write(f"{name:20}{value:10.2f}\n")


if __name__ == "__main__":
    main()
