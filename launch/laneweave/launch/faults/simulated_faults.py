"""The faults of a run over the simulated network: the same files, what this network can do."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from attrs import define, field

from laneweave.launch.faults.control_files import LocalBoard
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.faults.specification import MESSAGES, NAMESPACES, ROUTER, Faults
from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.message_faults import FaultyCore, MessageRule
from laneweave.protocol.runtime.node import Core
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.transports.simulated.network import SimulatedNetwork


@define
class SimulatedRoles:
    """The roles of a simulated run, by name; a `Stage` for faults."""

    network: SimulatedNetwork
    coordinators: tuple[str, ...]
    start_role: Callable[[str], None]
    """Starts a coordinator or an agent, given its name."""
    agents: dict[str, str] = field(factory=dict)
    """Name of the agent of each vehicle."""
    _router_up: bool = True

    @property
    def running(self) -> Collection[str]:
        """Roles that are up."""
        router = (ROUTER,) if self._router_up else ()
        roles = (*self.coordinators, *self.agents.values())
        return [*(name for name in roles if name in self.network), *router]

    def agent_of(self, vehicle: str) -> str | None:
        """Return the agent that drives a vehicle, if one has been started."""
        return self.agents.get(vehicle)

    def kill(self, name: str) -> None:
        """End a role without a word."""
        if name == ROUTER:
            self._router_up = False
            self.network.lose_router()
        else:
            self.network.kill(name)

    def pause(self, name: str) -> None:
        """Stop a role where it is."""
        self.network.pause(name)

    def resume(self, name: str) -> None:
        """Let a role go on."""
        if name in self.network:
            self.network.resume(name)

    def start_again(self, name: str) -> None:
        """Start a role that was killed."""
        if name == ROUTER:
            self._router_up = True
            self.network.restore_router()
        else:
            self.start_role(name)


@define
class SimulatedFaults:
    """All that a simulated run with faults has and a run without has not."""

    faults: Faults
    scenario: Scenario
    injection: FaultInjection
    board: LocalBoard = field(factory=LocalBoard)
    _starts: dict[str, int] = field(factory=dict)
    _stepped_s: float = -1.0

    @classmethod
    def open(cls, faults: Faults, scenario: Scenario, roles: SimulatedRoles) -> SimulatedFaults:
        """Prepare the faults of a run."""
        lease_s = roles.network.conditions.lease_s
        injection = FaultInjection.of(faults, scenario.seed, roles, lease_s)
        return cls(faults, scenario, injection)

    def wrap(self, core: Core, name: str, receiver: str) -> Core:
        """Put message faults before a role's core."""
        start = self._starts[name] = self._starts.get(name, 0) + 1
        faults = self.faults
        seed = self.scenario.seed if faults.seed is None else faults.seed
        partitions = (rule for part in faults.partition for rule in part.message_rules())
        rules: tuple[MessageRule, ...] = (*faults.messages, *partitions)
        return FaultyCore(core, rules, self.board, receiver=receiver, seed=f"{seed}/{name}/{start}")

    def step(self, now_s: float, view: RoadView) -> None:
        """Do what is due; `now_s` is virtual time."""
        wakeup_s = self.injection.wakeup_s
        if self.board.road_s != self._stepped_s or (wakeup_s is not None and wakeup_s <= now_s):
            self._stepped_s = self.board.road_s
            self.injection.step(self._stepped_s, now_s, view)

    def summary(self) -> dict[str, Any]:
        """Return what was done, for summary.json."""
        count = len(self.faults.partition)
        return {
            "injected": self.injection.injected,
            "partition_methods": {f"partition[{index}]": MESSAGES for index in range(count)},
        }


def check_simulated(faults: Faults) -> None:
    """Check that the simulated network can do what a faults file wants.

    Raises:
        BadInputError: it cannot.
    """
    for index, pause in enumerate(faults.pause):
        if pause.target == ROUTER:
            raise BadInputError(
                f"pause[{index}].target", ROUTER, "any other target with --transport simulated"
            )
    for index, partition in enumerate(faults.partition):
        if partition.method == NAMESPACES:
            raise BadInputError(
                f"partition[{index}].method", NAMESPACES, "messages with --transport simulated"
            )
