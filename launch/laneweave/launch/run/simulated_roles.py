"""The roles of a simulated run: coordinators, agents and the bridge over the simulated network."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from itertools import count

from attrs import define, field

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.driver import Driver, TrackingDriver
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.launch.faults.specification import ROUTER
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.runtime.node import Core
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.wire.messages import Census, Name

AGENT_PREFIX = "agent-"


def _unchanged(_name: str, core: Core, _receiver: str) -> Core:
    return core


@define
class SimulatedRoles:
    """The roles of a simulated run by name; implements `RoleControl`."""

    scenario: Scenario
    network: SimulatedNetwork
    make_coordinator: Callable[[Name, int, Scenario], CoordinatorCore] = CoordinatorCore
    """Returns the core of a coordinator of this name and incarnation."""
    make_driver: Callable[[Scenario], Driver] = TrackingDriver
    """Returns the driver of a vehicle."""
    wrap: Callable[[str, Core, str], Core] = _unchanged
    """Returns the core to run for a role's name, core and kind: faults wrap cores."""
    agents: dict[str, str] = field(factory=dict)
    """Agent name of each vehicle that is announced, or on the road, or has a running agent."""
    incarnations: Iterator[int] = field(factory=lambda: count(1))
    """Unique incarnation numbers for agents and caretakers."""
    coordinators: tuple[str, ...] = field(init=False)
    _coordinator_incarnations: Iterator[int] = field(factory=lambda: count(1))
    _handled_census: Census | None = None
    """Census for which agents were last started."""
    _router_runs: bool = True

    def __attrs_post_init__(self) -> None:
        """Read the names of the coordinators from the scenario."""
        self.coordinators = coordinator_names(self.scenario)

    @property
    def running(self) -> Collection[str]:
        """Names of the running roles."""
        router = (ROUTER,) if self._router_runs else ()
        roles = (*self.coordinators, *self.agents.values())
        return [*(name for name in roles if name in self.network), *router]

    def agent_of(self, vehicle: str) -> str | None:
        """Return the agent of a vehicle, or None before it is started."""
        return self.agents.get(vehicle)

    def kill(self, name: str) -> None:
        """Kill a role immediately, without clean-up."""
        if name == ROUTER:
            self._router_runs = False
            self.network.lose_router()
        else:
            self.network.kill(name)

    def pause(self, name: str) -> None:
        """Suspend a role."""
        self.network.pause(name)

    def resume(self, name: str) -> None:
        """Resume a role if it still exists."""
        if name in self.network:
            self.network.resume(name)

    def restart(self, name: str) -> None:
        """Restart a killed role."""
        if name == ROUTER:
            self._router_runs = True
            self.network.restore_router()
        else:
            self.start(name)

    # --- starting -----------------------------------------------------------------------------

    def start(self, name: str) -> None:
        """Start or restart a coordinator or an agent by name."""
        scenario = self.scenario
        if name in self.coordinators:
            incarnation = next(self._coordinator_incarnations)
            self.add(name, self.make_coordinator(Name(name), incarnation, scenario), "coordinator")
        else:
            vehicle = Name(name.removeprefix(AGENT_PREFIX))
            incarnation = next(self.incarnations)
            host = AgentHost(self._make_agent, incarnation, scenario.runtime, [vehicle])
            self.add(name, host, "vehicle")

    def start_agents(self, census: Census | None) -> None:
        """Start the agents of newly announced vehicles, and forget those of departed ones."""
        if census is None or census is self._handled_census:
            return
        self._handled_census = census
        listed = {announced.vehicle for announced in census.announced}
        listed |= {entry.vehicle for entry in census.on_road}
        for vehicle, name in list(self.agents.items()):
            if vehicle not in listed and name not in self.network:
                del self.agents[vehicle]
        for announced in census.announced:
            if announced.vehicle not in self.agents:
                self.agents[announced.vehicle] = f"{AGENT_PREFIX}{announced.vehicle}"
                self.start(self.agents[announced.vehicle])

    def add(self, name: str, core: Core, receiver: str) -> None:
        """Start a role; `receiver`: its kind as a receiver of messages in fault specifications."""
        self.network.add(name, self.wrap(name, core, receiver), self.scenario.network.realm)

    def _make_agent(self, vehicle: Name) -> AgentCore:
        return AgentCore(vehicle, self.incarnations.__next__, self.scenario, self.make_driver)
