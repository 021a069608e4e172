"""A run in this process: the same cores over the simulated network, in virtual time, repeatable."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from attrs import define, field

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.launch.faults import LEADER, Faults
from laneweave.launch.local_run import coordinator_names
from laneweave.launch.observer import TOPICS, View
from laneweave.launch.outcome import Outcome, complete_summary
from laneweave.launch.progress import RunProgress
from laneweave.protocol.messages import Name
from laneweave.protocol.node import Arrived, Effect, Event, Listen, Started
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.simulated_network import Conditions, SimulatedNetwork
from laneweave.sim_bridge.core import BridgeCore, Phase
from laneweave.sim_bridge.run_record import Ending, RunRecord
from laneweave.sim_bridge.sumo_world import SumoWorld

STALL_S = 600.0
"""A road clock that stands still for this much virtual time has stopped for good."""
PROGRESS_EVERY_TICKS = 20


class _Watcher:
    """A core that fills a view and reports each message."""

    wakeup_s = None

    def __init__(self, view: View, on_news: Callable[[], None]) -> None:
        self._view = view
        self._on_news = on_news

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        del now_s
        if isinstance(event, Started):
            for topic in TOPICS:
                yield Listen(topic)
        elif isinstance(event, Arrived):
            self._view.take(event.message)
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
    _view: View = field(factory=View)
    _known: set[Name] = field(factory=set)
    _problems: list[str] = field(factory=list)

    def run(self) -> Outcome:
        """Run the scenario and return what came of it."""
        scenario = self.scenario
        self.folder.mkdir(parents=True, exist_ok=True)
        network = SimulatedNetwork(scenario.seed, self.conditions)
        record = RunRecord(self.folder, scenario, self.method, time.perf_counter)
        with (
            tempfile.TemporaryDirectory(prefix="laneweave-sumo-") as sumo_folder,
            SumoWorld(scenario, Path(sumo_folder)) as world,
            RunProgress(scenario, show=self.show_progress) as progress,
        ):
            bridge = BridgeCore(scenario, world, record, pace=1.0)
            try:
                self._drive(network, bridge, progress)
            finally:
                record.close(bridge.t_s, Ending.INTERRUPTED)
        self._problems += self.faults.never_due()
        return complete_summary(
            self.folder,
            problems=self._problems,
            processes=1,
            dropped=network.dropped,
        )

    def _drive(self, network: SimulatedNetwork, bridge: BridgeCore, progress: RunProgress) -> None:
        scenario, realm = self.scenario, self.scenario.network.realm
        network.add("watcher", _Watcher(self._view, lambda: self._on_news(network)), realm)
        for index, name in enumerate(coordinator_names(scenario)):
            network.add(name, CoordinatorCore(Name(name), index + 1, scenario), realm)
        network.add("bridge", bridge, realm)
        shown = advanced_tick = 0
        advanced_s = 0.0
        while bridge.phase is not Phase.ENDED and network.step():
            if bridge.tick != advanced_tick:
                advanced_tick, advanced_s = bridge.tick, network.now_s
            elif network.now_s - advanced_s > STALL_S:
                self._problems.append(f"the road clock stands still at tick {bridge.tick}")
                return
            if bridge.tick >= shown + PROGRESS_EVERY_TICKS:
                shown = bridge.tick
                progress.update(self._view)

    def _on_news(self, network: SimulatedNetwork) -> None:
        self._start_agents(network)
        due, self.faults = self.faults.due(self._view.t_s)
        for kill in due:
            leader = self._view.leader
            name = leader if kill.target == LEADER else kill.target
            if name is None or name not in network:
                self._problems.append(f"no process to kill for target {kill.target}")
                continue
            network.kill(name)
            if name == leader:
                self._view.leader = None

    def _start_agents(self, network: SimulatedNetwork) -> None:
        census = self._view.census
        if census is None:
            return
        for announced in census.announced:
            vehicle = announced.vehicle
            if vehicle not in self._known:
                self._known.add(vehicle)
                host = AgentHost(self._make_agent(1000 + len(self._known)), [vehicle])
                network.add(f"agent-{vehicle}", host, self.scenario.network.realm)

    def _make_agent(self, incarnation: int) -> Callable[[Name], AgentCore]:
        return lambda vehicle: AgentCore(vehicle, incarnation, self.scenario)
