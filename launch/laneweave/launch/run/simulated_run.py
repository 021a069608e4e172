"""A reproducible run in this process: all cores over the simulated network, in virtual time."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

from attrs import Factory, define, field

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.launch.faults.breakdowns import breakdowns_of
from laneweave.launch.faults.fault_file import BRIDGE, ROUTER, FaultSpec
from laneweave.launch.faults.injection import FaultInjection
from laneweave.launch.faults.shared_counters import LocalBoard
from laneweave.launch.observe.observer import TOPICS
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run_methods import FORMATION
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.radio.radio_core import over_radio
from laneweave.protocol.runtime.message_faults import FaultyCore
from laneweave.protocol.runtime.node import Arrived, Core, Effect, Event, Listen, Started
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.events import FAULT_INJECTED
from laneweave.protocol.wire.messages import Census, Name
from laneweave.protocol.wire.topics import Party
from laneweave.sim_bridge.core import BridgeCore, TickPhase
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.obstacles import Breakdown
from laneweave.sim_bridge.road_sources import RunDemand, demand_of, open_road

STALL_S = 600.0
"""Virtual time after which a run fails if the road clock does not advance."""
STRIDE_S = 0.02
"""Virtual time between checks of a run without faults.

The network may run for this long after the bridge has ended, without effect on the results."""
PROGRESS_EVERY_TICKS = 20
AGENT_PREFIX = "agent-"


class _ObserverCore:
    """Core that updates a view, and calls `on_message` after each message."""

    wakeup_s = None

    def __init__(self, view: RoadView, on_message: Callable[[], None]) -> None:
        self._view = view
        self._on_message = on_message

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        if isinstance(event, Started):
            for topic in TOPICS:
                yield Listen(topic)
        elif isinstance(event, Arrived):
            self._view.update(event, now_s)
            self._on_message()


@define
class SimulatedRoles:
    """The roles of a simulated run by name; implements `RoleControl`."""

    network: SimulatedNetwork
    coordinators: tuple[str, ...]
    start: Callable[[str], None]
    """Starts a coordinator or agent by name."""
    agents: dict[str, str] = field(factory=dict)
    """Agent name of each vehicle that is announced, or on the road, or has a running agent."""
    _router_runs: bool = True

    @property
    def running(self) -> Collection[str]:
        """Names of the running roles."""
        router = (ROUTER,) if self._router_runs else ()
        roles = (BRIDGE, *self.coordinators, *self.agents.values())
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


@define
class SimulatedRun:
    """A run over the simulated network; call `run` once."""

    scenario: Scenario
    folder: Path
    faults: FaultSpec = field(factory=FaultSpec)
    conditions: Conditions = field(factory=Conditions)
    show_progress: bool = True
    watch: Callable[[RoadView], None] | None = None
    """Called every `PROGRESS_EVERY_TICKS` with the observed state."""
    demand: RunDemand = Factory(lambda self: demand_of(self.scenario), takes_self=True)
    """The vehicles of the run, if the caller has drawn them already."""
    _view: RoadView = field(factory=RoadView)
    _roles: SimulatedRoles = field(init=False)
    _injection: FaultInjection | None = None
    _board: LocalBoard = field(factory=LocalBoard)
    _handled_census: Census | None = None
    """Census for which agents were last started."""
    _injected_road_s: float = -1.0
    """Road time at which faults were last applied."""
    _incarnations: Iterator[int] = field(factory=lambda: count(1))
    """Unique incarnation numbers for agents and caretakers."""
    _coordinator_incarnations: Iterator[int] = field(factory=lambda: count(1))
    _problems: list[str] = field(factory=list)
    _stop: bool = False

    def run(self) -> Outcome:
        """Run the scenario and return its outcome.

        Raises:
            BadInputError: the simulated network does not support one of the faults.
            KeyboardInterrupt: a signal has stopped the run before it began.
        """
        scenario = self.scenario
        self.faults.check_simulated()
        breakdowns = breakdowns_of(self.faults, scenario)
        self.folder.mkdir(parents=True, exist_ok=True)
        network = SimulatedNetwork(scenario.seed, self.conditions, skip_codec=True)
        self._roles = SimulatedRoles(network, coordinator_names(scenario), self._start)
        with stop_signals(self._request_stop):
            self._simulate(network, breakdowns)
            return self._outcome(network.dropped + self._board.dropped)

    def _simulate(self, network: SimulatedNetwork, breakdowns: Sequence[Breakdown]) -> None:
        scenario = self.scenario
        with (
            open_road(self.demand, self.folder) as road,
            RunProgress(scenario, show=self.show_progress) as progress,
        ):
            record = RunRecord(self.folder, scenario, FORMATION, time.perf_counter, road.left_out)
            if self.faults:
                self._injection = FaultInjection(
                    self.faults,
                    scenario.seed,
                    self._roles,
                    self.conditions.lease_s,
                    log_event=lambda t_s, data: record.event(t_s, FAULT_INJECTED, **data),
                )
            bridge = BridgeCore(
                scenario,
                road.world,
                record,
                road.stream,
                new_incarnation=self._incarnations.__next__,
                pace=1.0,
                outside_traffic=road.outside_traffic,
                breakdowns=breakdowns,
            )
            try:
                self._drive(network, bridge, progress)
            finally:
                ending = Ending.UNFINISHED if self._end_by_faults else Ending.INTERRUPTED
                record.close(bridge.t_s, ending)

    @property
    def _end_by_faults(self) -> str:
        """Why the faults have ended the run; empty: they have not."""
        return "" if self._injection is None else self._injection.end

    def _outcome(self, dropped: int) -> Outcome:
        results: dict[str, Any] = {"dropped": dropped}
        if self._injection is not None:
            if self._end_by_faults:
                self._problems.append(self._end_by_faults)
            elif not self._stop:
                self._problems += self._injection.unused_faults()
            results = self._injection.results(dropped)
        return complete_summary(
            self.folder,
            problems=self._problems,
            interrupted=self._stop,
            cut_short=bool(self._end_by_faults),
            processes=1,
            **results,
        )

    def _request_stop(self) -> None:
        self._stop = True

    def _drive(self, network: SimulatedNetwork, bridge: BridgeCore, progress: RunProgress) -> None:
        realm = self.scenario.network.realm
        network.add("watcher", _ObserverCore(self._view, self._start_agents), realm)
        for name in self._roles.coordinators:
            self._start(name)
        self._add(BRIDGE, over_radio(bridge, self.scenario, Party.BRIDGE, BRIDGE), "bridge", BRIDGE)
        shown = advanced_tick = 0
        advanced_s = 0.0
        while bridge.phase is not TickPhase.ENDED and network.queue and not self._stop:
            if self._injection is None:
                network.run(network.now_s + STRIDE_S)
            else:
                network.step()
                self._inject(self._injection, network.now_s)
                if self._injection.end:
                    return
            if bridge.tick != advanced_tick:
                advanced_tick, advanced_s = bridge.tick, network.now_s
            elif network.now_s - advanced_s > STALL_S:
                self._problems.append(f"the road clock stopped at tick {bridge.tick}")
                return
            if bridge.tick >= shown + PROGRESS_EVERY_TICKS:
                shown = bridge.tick
                progress.show(self._view)
                if self.watch is not None:
                    self.watch(self._view)

    def _inject(self, injection: FaultInjection, now_s: float) -> None:
        """Apply faults if the road time has advanced, or a resume or restart is due."""
        wakeup_s, road_s = injection.wakeup_s, self._board.road_s
        if road_s != self._injected_road_s or (wakeup_s is not None and wakeup_s <= now_s):
            self._injected_road_s = road_s
            injection.step(road_s, now_s, self._view)

    def _start_agents(self) -> None:
        """Start the agents of newly announced vehicles, and forget those of departed ones."""
        roles, census = self._roles, self._view.census
        if census is None or census is self._handled_census:
            return
        self._handled_census = census
        listed = {announced.vehicle for announced in census.announced}
        listed |= {entry.vehicle for entry in census.on_road}
        for vehicle, name in list(roles.agents.items()):
            if vehicle not in listed and name not in roles.network:
                del roles.agents[vehicle]
        for announced in census.announced:
            if announced.vehicle not in roles.agents:
                roles.agents[announced.vehicle] = f"{AGENT_PREFIX}{announced.vehicle}"
                self._start(roles.agents[announced.vehicle])

    def _start(self, name: str) -> None:
        """Start or restart a coordinator or an agent."""
        if name in self._roles.coordinators:
            incarnation = next(self._coordinator_incarnations)
            coordinator = CoordinatorCore(Name(name), incarnation, self.scenario)
            core = over_radio(coordinator, self.scenario, Party.COORDINATOR, name)
            self._add(name, core, "coordinator", name)
        else:
            vehicle = Name(name.removeprefix(AGENT_PREFIX))
            incarnation, runtime = next(self._incarnations), self.scenario.runtime
            host = AgentHost(vehicle, self._make_agent, incarnation, runtime, [vehicle])
            core = over_radio(host, self.scenario, Party.VEHICLE, vehicle, host.listeners)
            self._add(name, core, "vehicle", vehicle)

    def _add(self, name: str, core: Core, receiver: str, own_name: str) -> None:
        """Add a role to the network.

        Args:
            name: name of the role.
            core: the role.
            receiver: its kind in message rules.
            own_name: its name in message rules.
        """
        injection = self._injection
        if injection is not None:
            rules, seed = injection.message_rules(), injection.seed_of_start(name)
            core = FaultyCore(
                core, rules, self._board, receiver=receiver, seed=seed, names=(own_name,)
            )
        self._roles.network.add(name, core, self.scenario.network.realm)

    def _make_agent(self, vehicle: Name) -> AgentCore:
        return AgentCore(vehicle, self._incarnations.__next__, self.scenario)
