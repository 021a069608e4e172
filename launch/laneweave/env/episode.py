"""One run of the real roles in virtual time, without SUMO and files, that advances on request."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.driver import TrackingDriver
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.env.record import EpisodeRecord
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.runtime.node import Core
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.bodies.bodies_world import BodiesWorld
from laneweave.sim_bridge.core import BridgeCore, TickPhase
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.vehicle import RoadVehicle

STALL_S = 600.0
"""Virtual time after which an episode fails if the road clock does not advance."""
STRIDE_S = 0.02
"""Virtual time between checks whether a tick is complete; the next one opens later."""


def _no_time() -> float:
    """Return 0: reading the clock of a thread takes longer than a solve that it measures."""
    return 0.0


class Episode:
    """A simulated run: coordinators, one process with all agents, and the bridge."""

    def __init__(
        self,
        scenario: Scenario,
        make_coordinator: Callable[[Name, int, Scenario], CoordinatorCore],
        stream: tuple[Arrival, ...],
    ) -> None:
        """Start all roles; the road time is 0.

        Args:
            scenario: road, demand, vehicles; its seed determines everything that is drawn.
            make_coordinator: returns the core of a coordinator of this name and incarnation.
            stream: the arrivals, by time.
        """
        self.scenario = scenario
        self.record = EpisodeRecord(scenario)
        self.network = SimulatedNetwork(scenario.seed, skip_codec=True)
        self._incarnations = count(1)
        self._bridge = BridgeCore(
            scenario,
            BodiesWorld(),
            self.record,
            stream,
            new_incarnation=self._incarnations.__next__,
            pace=1.0,
            stopwatch=_no_time,
        )
        agents = AgentHost(
            Name("agents"),
            self._make_agent,
            next(self._incarnations),
            scenario.runtime,
            shard=Shard(0, 1),
        )
        cores: dict[str, Core] = {
            name: make_coordinator(Name(name), 1, scenario) for name in coordinator_names(scenario)
        }
        for name, core in (cores | {"agents": agents, "bridge": self._bridge}).items():
            self.network.add(name, core, scenario.network.realm)

    def _make_agent(self, vehicle: Name) -> AgentCore:
        make_driver = partial(TrackingDriver, stopwatch=_no_time)
        return AgentCore(vehicle, self._incarnations.__next__, self.scenario, make_driver)

    @property
    def vehicles(self) -> Mapping[Name, RoadVehicle]:
        """The vehicles on the road, by name, in the order in which they entered."""
        return self._bridge.vehicles

    @property
    def tick(self) -> int:
        """Number of completed ticks."""
        return self._bridge.tick

    @property
    def t_s(self) -> float:
        """Road time."""
        return self._bridge.t_s

    @property
    def ended(self) -> bool:
        """Whether all demanded vehicles have left, or the scenario's time is over."""
        return self._bridge.phase in (TickPhase.SHUTTING_DOWN, TickPhase.ENDED)

    def advance(self, stop: Callable[[], bool]) -> None:
        """Advance until `stop` returns True after a tick, or until the episode has ended.

        Raises:
            RuntimeError: the road clock has stopped.
        """
        while not self.ended:
            self._finish_tick()
            if stop():
                return

    def _finish_tick(self) -> None:
        """Advance to the time before the next tick, at which all messages have arrived."""
        network, bridge = self.network, self._bridge
        tick, began_s = bridge.tick, network.now_s
        while bridge.tick == tick and not self.ended:
            network.run(network.now_s + STRIDE_S)
            if network.now_s - began_s > STALL_S:
                raise RuntimeError(f"the road clock has stopped at {bridge.t_s:g} s")
        if bridge.phase is TickPhase.PACE and bridge.wakeup_s is not None:
            network.run(math.nextafter(bridge.wakeup_s, 0.0))
