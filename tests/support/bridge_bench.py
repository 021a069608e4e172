"""A bridge under test: real core, record and roadside; bodies are shown where they were placed."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from attrs import asdict, define, field

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import (
    Arrived,
    Core,
    Effect,
    End,
    Event,
    Node,
    PeerDown,
    PeerUp,
    Started,
    Wakeup,
)
from laneweave.protocol.runtime.settings_check import CheckedCore, Process
from laneweave.protocol.scenario.common_settings import settings_of
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.messages import (
    Command,
    CurrentMotion,
    Name,
    Prepare,
    Sense,
    VehicleRecord,
)
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import (
    CENSUS,
    COMMAND,
    PLAN,
    PREPARE,
    REPORT,
    SENSE,
    VEHICLE_ALIVE,
    Keys,
    Party,
)
from laneweave.sim_bridge.bodies.bodies_world import BodiesWorld
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.core import BRIDGE, BridgeCore, TickPhase
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.demand import arrivals as scenario_arrivals
from support.paper import EXACT
from support.road_vehicles import known
from support.states import changed, jerks, make_plan, sent

ROAD = {"lanes": 2, "s1_m": 20.0, "s2_m": 20.0, "s3_m": 160.0}
"""As short as the checks allow: a vehicle takes 14 s."""
A, B = Name("A"), Name("B")
REALM = "bench"
KEYS = Keys(REALM)
FOR_EVER_S = 1e6


def make_scenario(**tables: dict[str, Any]) -> Scenario:
    """Return the paper's operation on a short road with exact sensors, but for some tables."""
    formation = {"operation": "paper", **tables.pop("formation", {})}
    return parse_scenario({"road": ROAD, "sensing": asdict(EXACT), "formation": formation} | tables)


def arrival(vehicle: str, t_s: float, lane: int = 0, preferred_lane: int = 0) -> Arrival:
    return Arrival(vehicle, lane, preferred_lane, t_s)


TWO = (arrival(A, 0.5, lane=1), arrival(B, 0.6, lane=0))
"""A enters at 1 s, B at 2 s: when the first free cells pass that are in the structure."""


class PlainWorld(BodiesWorld):
    """Shows every body where it was placed, and records all poses."""

    def __init__(self) -> None:
        """Begin with an empty road."""
        super().__init__()
        self.shown: list[dict[str, Pose]] = []
        """After each tick."""

    def step(self) -> None:
        self.shown.append(self.positions())


def make_bridge(
    scenario: Scenario,
    folder: Path,
    arrivals: Iterable[Arrival] | None = None,
    *,
    pace: float | None = 1.0,
    incarnation: int = 0,
    new_incarnation: Callable[[], int] | None = None,
) -> tuple[BridgeCore, PlainWorld]:
    """Return a bridge with the given demand, or with the scenario's."""
    world = PlainWorld()
    record = RunRecord(folder, scenario, "formation", lambda: 0.0)
    core = BridgeCore(
        scenario,
        world,
        record,
        scenario_arrivals(scenario) if arrivals is None else tuple(arrivals),
        new_incarnation=new_incarnation or count(1).__next__,
        pace=pace,
        incarnation=incarnation,
        stopwatch=lambda: 0.0,
    )
    return core, world


def read_summary(folder: Path) -> dict[str, Any]:
    text = (folder / "summary.json").read_text(encoding="utf-8")
    summary: dict[str, Any] = json.loads(text)
    return summary


def read_events(folder: Path, kind: str) -> list[dict[str, Any]]:
    lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    return [event for event in map(json.loads, lines) if event["kind"] == kind]


def deadlines_until_silent(scenario: Scenario) -> int:
    """Return how many deadlines an agent misses before it is silent."""
    return round(scenario.runtime.agent_silent_s / scenario.runtime.tick_deadline_s)


# --- by hand ----------------------------------------------------------------------------------


@define
class Desk:
    """A bridge that is driven event by event, and its effects."""

    scenario: Scenario
    folder: Path
    arrivals: Iterable[Arrival] | None = None
    pace: float | None = 1.0
    now_s: float = 0.0
    effects: list[Effect] = field(factory=list)
    core: BridgeCore = field(init=False)
    world: PlainWorld = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Make the bridge; it is not started."""
        self.core, self.world = make_bridge(
            self.scenario, self.folder, self.arrivals, pace=self.pace
        )

    def give(self, event: Event) -> list[Effect]:
        effects = self.core.handle(event, self.now_s)
        self.effects += effects
        return effects

    def start(self, *up: str) -> list[Effect]:
        """Start the bridge, with agents that are there already."""
        for vehicle in up:
            self.core.road.answers.up.add(Name(vehicle))
        return self.give(Started())

    def up(self, vehicle: str, process: str | None = None) -> list[Effect]:
        """Show the token of a vehicle's agent in a process, by default in one of its name."""
        return self.give(PeerUp(VEHICLE_ALIVE, _of_agent(vehicle, process)))

    def down(self, vehicle: str, process: str | None = None) -> list[Effect]:
        return self.give(PeerDown(VEHICLE_ALIVE, _of_agent(vehicle, process)))

    def wake(self) -> list[Effect]:
        """Let time pass until the bridge wants to be woken."""
        assert self.core.wakeup_s is not None
        self.now_s = max(self.now_s, self.core.wakeup_s)
        return self.give(Wakeup())

    def answer(self, vehicle: str, **changes: Any) -> list[Effect]:  # noqa: ANN401 (fields)
        return self.give(Arrived(COMMAND, {"vehicle": vehicle}, self.command(vehicle, **changes)))

    def command(self, vehicle: str, **changes: Any) -> Command:  # noqa: ANN401 (fields)
        """Return an answer to the current tick that does not change the motion.

        As agents do, it comes with a new incarnation when the caretaker is in charge.
        """
        name = Name(vehicle)
        controller = self.core.vehicles[name].controller
        cared_for = name in self.core.road.caretakers
        unchanged: dict[str, Any] = {
            "vehicle": name,
            "record": VehicleRecord(max(controller.record.incarnation + cared_for, 1)),
            "tick": self.core.tick,
            "hold_cell": controller.hold_cell,
            "motion": CurrentMotion(controller.hold_cell),
            "jerks": jerks((0.0, 0.0), ticks=self.scenario.timing.horizon_ticks),
        }
        return changed(Command(**unchanged), **changes)

    def known(self, vehicle: str) -> tuple[object, ...]:
        return known(self.core.vehicles[Name(vehicle)].controller)

    def report(self, role: str, name: str, **counters: Any) -> list[Effect]:  # noqa: ANN401
        message = Report(Name(role), Name(name), **counters)
        return self.give(Arrived(REPORT, {"role": role, "name": name}, message))

    def report_own(self) -> list[Effect]:
        """Bring the bridge its own report, as the network does."""
        return self.report("bridge", BRIDGE)

    def drive(self, until: Callable[[], bool], *deaf: str) -> None:
        """Answer for all agents that are up, except some, until a condition is met."""
        for _ in range(20_000):
            if until():
                return
            awaited = sorted(self.core.road.answers.awaited - set(deaf))
            if self.core.phase is TickPhase.ANSWERS and awaited:
                self.answer(awaited[0])
            else:
                self.wake()
        raise AssertionError("the condition was never met")

    def drive_to(self, tick: int, *deaf: str) -> None:
        """Go on until a tick has begun and its vehicles have been asked."""
        self.drive(lambda: self.core.tick >= tick and self.core.phase is TickPhase.ANSWERS, *deaf)

    def drive_to_silence(self, *silent: str) -> None:
        """Go on without answers of some agents until they count as silent."""
        answers = self.core.road.answers
        self.drive(
            lambda: answers.silent >= set(silent) and self.core.phase is TickPhase.ANSWERS, *silent
        )

    def drive_to_entry(self, *vehicles: str) -> None:
        """Go on until vehicles are on the road and wait for their agents' answers."""
        self.drive(
            lambda: (
                self.core.phase is TickPhase.ANSWERS and set(vehicles) <= set(self.core.vehicles)
            )
        )


def asked(effects: Iterable[Effect]) -> list[str]:
    """Return the vehicles to which a SENSE was sent."""
    return [sense.vehicle for sense in sent(effects, Sense) if not sense.left]


def ended(effects: Iterable[Effect]) -> bool:
    return any(isinstance(effect, End) for effect in effects)


# --- with agents ------------------------------------------------------------------------------

CATCH_UP_S = 0.015
"""Time that a process needs for each event that it has missed."""


class Sleeper:
    """A process that can be put to sleep while its session lives on."""

    def __init__(self, core: Core) -> None:
        """Be awake."""
        self.asleep = False
        self._core = core
        self._missed: deque[Event] = deque()
        self._next_s = 0.0

    @property
    def wakeup_s(self) -> float | None:
        if self.asleep:
            return None
        return self._next_s if self._missed else self._core.wakeup_s

    def handle(self, event: Event, now_s: float) -> Iterable[Effect]:
        """Hand an event on, or keep it for later; after a sleep, one thing after the other."""
        if not (self.asleep or self._missed):
            return self._core.handle(event, now_s)
        if not isinstance(event, Wakeup):
            self._missed.append(event)
        if self.asleep or now_s < self._next_s:
            return ()
        self._next_s = now_s + CATCH_UP_S
        return self._core.handle(self._missed.popleft(), now_s)


@define
class Street:
    """A bridge and its agents on a simulated network."""

    scenario: Scenario
    folder: Path
    arrivals: Iterable[Arrival] | None = None
    conditions: Conditions = field(factory=Conditions)
    pace: float = 1.0
    seed: int = 1
    """Of the network."""
    network: SimulatedNetwork = field(init=False)
    bridge: BridgeCore = field(init=False)
    world: PlainWorld = field(init=False)
    nodes: list[Node] = field(factory=list)
    agents: dict[Name, AgentCore] = field(factory=dict)
    """The newest of each vehicle."""
    _incarnations: int = 0

    def __attrs_post_init__(self) -> None:
        """Start the bridge."""
        self.network = SimulatedNetwork(self.seed, self.conditions)
        self.start_bridge("bridge", self.folder)

    def start_bridge(self, name: str, folder: Path) -> None:
        self._incarnations += 1
        folder.mkdir(parents=True, exist_ok=True)
        self.bridge, self.world = make_bridge(
            self.scenario,
            folder,
            self.arrivals,
            pace=self.pace,
            incarnation=self._incarnations,
            new_incarnation=self._new_incarnation,
        )
        self._add(name, self.bridge)

    def start_coordinators(self, count: int = 1) -> None:
        for number in range(count):
            self.start_coordinator(f"c{number}", number + 1)

    def start_coordinator(
        self, name: str, incarnation: int, scenario: Scenario | None = None
    ) -> CoordinatorCore:
        """Start a candidate, perhaps with a scenario of its own."""
        scenario = scenario or self.scenario
        core = CoordinatorCore(Name(name), incarnation, scenario)
        process = Process.of(Identity(Party.COORDINATOR, name), incarnation)
        self._add(name, CheckedCore(core, process, settings_of(scenario), CENSUS))
        return core

    def start_agents(self, *vehicles: str) -> Sleeper:
        """Start one process for some vehicles."""
        names = [Name(vehicle) for vehicle in vehicles]
        host = Sleeper(self._make_host(names[0], self.scenario, names))
        identity = Identity(Party.VEHICLE, vehicles[0])
        self._add_agents(f"agent-{vehicles[0]}", host, identity, "named", self.scenario)
        return host

    def start_shard(
        self, index: int = 0, count: int = 1, scenario: Scenario | None = None
    ) -> AgentHost:
        """Start a process for all vehicles of its shard, perhaps with a scenario of its own."""
        scenario, shard = scenario or self.scenario, Shard(index, count)
        host = self._make_host(Name(shard.name), scenario, shard=shard)
        identity = Identity(Party.FLEET, shard.name)
        self._add_agents(f"shard-{index}", host, identity, shard.name, scenario)
        return host

    def _add_agents(
        self, name: str, core: Core, identity: Identity, drives: str, scenario: Scenario
    ) -> None:
        process = Process.of(identity, self._new_incarnation(), drives)
        settings = settings_of(scenario)
        self._add(name, CheckedCore(core, process, settings, SENSE))

    def _make_host(
        self,
        process: Name,
        scenario: Scenario,
        vehicles: Sequence[Name] = (),
        shard: Shard | None = None,
    ) -> AgentHost:
        make_agent = partial(self._make_agent, scenario)
        incarnation = self._new_incarnation()
        return AgentHost(process, make_agent, incarnation, scenario.runtime, vehicles, shard)

    def _make_agent(self, scenario: Scenario, vehicle: Name) -> AgentCore:
        self.agents[vehicle] = AgentCore(vehicle, self._new_incarnation, scenario)
        return self.agents[vehicle]

    def _new_incarnation(self) -> int:
        self._incarnations += 1
        return self._incarnations

    def _add(self, name: str, core: Core) -> None:
        self.nodes.append(self.network.add(name, core, REALM))

    def run(self, until: Callable[[], bool] | None = None) -> None:
        """Run the network until the bridge has ended, or until a condition is met."""
        stop = until or (lambda: self.bridge.phase is TickPhase.ENDED)
        self.network.run(self.network.now_s + FOR_EVER_S, stop)
        assert stop()

    def run_to(self, tick: int) -> None:
        self.run(lambda: self.bridge.tick >= tick)

    def order(self, vehicle: str, target: Cell, t0_s: float) -> None:
        """Give a vehicle a plan of its own, as a leader does: one move."""
        name, agent = Name(vehicle), self.agents[Name(vehicle)]
        start = self.bridge.vehicles[name].controller.hold_cell
        blocks = (self.scenario.lattice.block_of(start[0]),)
        plan = make_plan(
            {name: start},
            {name: ((0, start, target),)},
            blocks=blocks,
            incarnations={name: agent._claim.incarnation},
            t0_s=t0_s,
            slot_s=self.scenario.timing.cycles_s[0],
        )
        prepare = Prepare(plan.ballot, blocks, (name,))
        for topic, message in ((PREPARE, prepare), (PLAN, plan)):
            self.network.inject(KEYS.key(topic, process=vehicle, vehicle=vehicle), encode(message))
            self.network.run(self.network.now_s + 0.02)  # nothing overtakes it
        assert agent.execution is not None
        assert agent.execution.plan == plan


def _of_agent(vehicle: str, process: str | None) -> dict[str, str]:
    return {"process": process or vehicle, "vehicle": vehicle}
