"""A run in this process: the same cores over the simulated network, in virtual time, repeatable."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

from attrs import define, field

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.launch.faults.simulated_faults import (
    SimulatedFaults,
    SimulatedRoles,
    check_simulated,
)
from laneweave.launch.faults.specification import Faults
from laneweave.launch.observe.observer import TOPICS
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.runtime.node import Arrived, Core, Effect, Event, Listen, Started
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.core import BridgeCore, Phase
from laneweave.sim_bridge.recording.run_record import Ending, RunRecord
from laneweave.sim_bridge.sumo.world import SumoWorld

STALL_S = 600.0
"""A road clock that stands still for this much virtual time has stopped for good."""
STRIDE_S = 0.02
"""Virtual time in which nobody has to look what happens, if there are no faults.

So much may go on after the bridge has ended, too; it changes nothing that is recorded."""
PROGRESS_EVERY_TICKS = 20
AGENT_PREFIX = "agent-"


class _Watcher:
    """A core that fills a view and reports each message."""

    wakeup_s = None

    def __init__(self, view: RoadView, on_news: Callable[[], None]) -> None:
        self._view = view
        self._on_news = on_news

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        if isinstance(event, Started):
            for topic in TOPICS:
                yield Listen(topic)
        elif isinstance(event, Arrived):
            self._view.take(event, now_s)
            self._on_news()


@define
class SimulatedRun:
    """One run over the simulated network; `run` does it all."""

    scenario: Scenario
    folder: Path
    method: str = "formation"
    faults: Faults = field(factory=Faults)
    conditions: Conditions = field(factory=Conditions)
    show_progress: bool = True
    _view: RoadView = field(factory=RoadView)
    _roles: SimulatedRoles = field(init=False)
    _active_faults: SimulatedFaults | None = None
    _incarnations: Iterator[int] = field(factory=lambda: count(1))
    """Of agents and caretakers: each number once."""
    _coordinator_incarnations: Iterator[int] = field(factory=lambda: count(1))
    _problems: list[str] = field(factory=list)

    def run(self) -> Outcome:
        """Run the scenario and return what came of it.

        Raises:
            BadInputError: the faults are not for the simulated network.
        """
        scenario = self.scenario
        check_simulated(self.faults)
        self.folder.mkdir(parents=True, exist_ok=True)
        network = SimulatedNetwork(scenario.seed, self.conditions, in_kind=True)
        self._roles = SimulatedRoles(network, coordinator_names(scenario), self._start)
        if self.faults:
            self._active_faults = SimulatedFaults.open(self.faults, scenario, self._roles)
        record = RunRecord(self.folder, scenario, self.method, time.perf_counter)
        with (
            tempfile.TemporaryDirectory(prefix="laneweave-sumo-") as sumo_folder,
            SumoWorld(scenario, Path(sumo_folder)) as world,
            RunProgress(scenario, show=self.show_progress) as progress,
        ):
            bridge = BridgeCore(
                scenario,
                world,
                record,
                new_incarnation=self._incarnations.__next__,
                pace=1.0,
            )
            try:
                self._drive(network, bridge, progress)
            finally:
                record.close(bridge.t_s, Ending.INTERRUPTED)
        return self._outcome(network)

    def _outcome(self, network: SimulatedNetwork) -> Outcome:
        faults = self._active_faults
        if faults is None:
            return complete_summary(
                self.folder, problems=self._problems, processes=1, dropped=network.dropped
            )
        return complete_summary(
            self.folder,
            problems=[*self._problems, *faults.injection.never_happened()],
            processes=1,
            failover=faults.injection.failover,
            dropped=network.dropped + faults.board.dropped,
            faults=faults.summary(),
        )

    def _drive(self, network: SimulatedNetwork, bridge: BridgeCore, progress: RunProgress) -> None:
        realm, faults = self.scenario.network.realm, self._active_faults
        network.add("watcher", _Watcher(self._view, self._start_agents), realm)
        for name in self._roles.coordinators:
            self._start(name)
        self._add("bridge", bridge, "bridge")
        shown = advanced_tick = 0
        advanced_s = 0.0
        while bridge.phase is not Phase.ENDED and network.queue:
            if faults is None:
                network.run(network.now_s + STRIDE_S)
            else:
                network.step()
                faults.step(network.now_s, self._view)
            if bridge.tick != advanced_tick:
                advanced_tick, advanced_s = bridge.tick, network.now_s
            elif network.now_s - advanced_s > STALL_S:
                self._problems.append(f"the road clock stands still at tick {bridge.tick}")
                return
            if bridge.tick >= shown + PROGRESS_EVERY_TICKS:
                shown = bridge.tick
                progress.update(self._view)

    def _start_agents(self) -> None:
        agents, census = self._roles.agents, self._view.census
        for announced in census.announced if census is not None else ():
            if announced.vehicle not in agents:
                agents[announced.vehicle] = f"{AGENT_PREFIX}{announced.vehicle}"
                self._start(agents[announced.vehicle])

    def _start(self, name: str) -> None:
        """Start a coordinator or an agent, the first time or again."""
        if name in self._roles.coordinators:
            incarnation = next(self._coordinator_incarnations)
            core = CoordinatorCore(Name(name), incarnation, self.scenario)
            self._add(name, core, "coordinator")
        else:
            vehicle = Name(name.removeprefix(AGENT_PREFIX))
            self._add(name, AgentHost(self._make_agent, [vehicle]), "vehicle")

    def _add(self, name: str, core: Core, receiver: str) -> None:
        faults = self._active_faults
        faulty = core if faults is None else faults.wrap(core, name, receiver)
        self._roles.network.add(name, faulty, self.scenario.network.realm)

    def _make_agent(self, vehicle: Name) -> AgentCore:
        return AgentCore(vehicle, self._incarnations.__next__, self.scenario)
