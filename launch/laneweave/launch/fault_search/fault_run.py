"""A run of the fault search: real cores, a simplified road, random faults, a checker.

During the fault phase, preferred lanes change repeatedly, which requires new plans. Then all faults
end, and all vehicles must arrive. The same seed gives the same run.
"""

from __future__ import annotations

import random
import time
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count
from typing import Any

import attrs
from attrs import field, frozen

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.rolling.checked_planner import Planner, stream_planner
from laneweave.launch.fault_search.arrivals import Arrivals
from laneweave.launch.fault_search.checks.checker import Checker
from laneweave.launch.fault_search.checks.geometry import Geometry
from laneweave.launch.fault_search.checks.violations import Violation
from laneweave.launch.fault_search.coverage import ADOPTION, PLANNING, Rules
from laneweave.launch.fault_search.events.fault_context import ROAD
from laneweave.launch.fault_search.events.faults import RandomFaults
from laneweave.launch.fault_search.events.lasting_faults import CLOCK_DRIFT, CLOCK_OFFSET_S
from laneweave.launch.fault_search.road.light_road import LightRoad, Reception
from laneweave.launch.fault_search.road.stand_ins import LightDriver, LightPlanner
from laneweave.launch.fault_search.story import Story
from laneweave.launch.fault_search.timeline import Timeline
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import Compute, Core, Effect, Event, Send
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import TraceDigest
from laneweave.protocol.wire.messages import Name

RULES = Rules()
TWIN = ".2"
"""Suffix of the name of the second process of a vehicle."""
COORDINATORS = ("c1", "c2", "c3")
INCARNATIONS_PER_S = 10_000
"""Lead of incarnations per second by which a clock is ahead."""
MAX_MOTION_SLOTS = 3.0
"""Maximum duration of a slow motion, in slots."""
NOTICE_S = 0.1
"""Time after which a candidate must have noticed that it is disconnected."""
ELECTED_S = 5.0
"""Time after all faults have ended after which there must be one leader."""
CHECK_S = 0.5
"""Virtual time between checks of whether a run is over."""


@frozen
class Totals:
    """Totals of one or more runs."""

    runs: int = 0
    virtual_s: float = 0.0
    cpu_s: float = 0.0
    vehicles: int = 0
    motions: int = 0
    plans: int = 0
    joint_plans: int = 0
    takeovers: int = 0
    """Number of takeovers by caretakers."""
    delivered: int = 0
    dropped: int = 0
    longest_recovery_s: float = 0.0
    faults: Counter[str] = field(factory=Counter)

    def __add__(self, other: Totals) -> Totals:
        """Return the sums, and the maximum of the recovery times."""
        names = [attribute.name for attribute in attrs.fields(Totals)]
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        sums["longest_recovery_s"] = max(self.longest_recovery_s, other.longest_recovery_s)
        return Totals(**sums)


@frozen
class SeedResult:
    """Result of one run."""

    seed: int
    violations: tuple[Violation, ...]
    totals: Totals
    digest: str = ""
    """Digest of all delivered messages, if requested."""
    profile: str = ""
    """Profile from which the run was drawn."""
    features: frozenset[str] = frozenset()
    """Rules and guards that the run has reached (`coverage`)."""


class _ListenedCore:
    """Core that passes its sent messages through a listener, which may change them."""

    def __init__(
        self,
        core: Core,
        name: str,
        listener: Callable[[str, Send], Send],
        on_compute: Callable[[str], None],
    ) -> None:
        self.core = core
        self._name = name
        self._listener = listener
        self._on_compute = on_compute

    @property
    def wakeup_s(self) -> float | None:
        return self.core.wakeup_s

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        effects = list(self.core.handle(event, now_s))
        for index, effect in enumerate(effects):
            if type(effect) is Send:
                effects[index] = self._listener(self._name, effect)
            elif type(effect) is Compute:
                self._on_compute(self._name)
        return effects


class FaultRun:
    """A run of one story; call `run` once."""

    coordinators: tuple[str, ...] = COORDINATORS

    def __init__(
        self,
        story: Story,
        rules: Rules = RULES,
        timeline: Timeline | None = None,
        *,
        digest: bool = False,
    ) -> None:
        """Start all processes.

        Args:
            story: what happens in the run.
            rules: rules of vehicles and leaders, which tests replace with faulty ones.
            timeline: timeline to which events are added.
            digest: whether to compute a digest of all delivered messages.
        """
        self.story = story
        self.setup = story.setup
        self._rng = random.Random(story.seed)  # noqa: S311 (simulation, no secrets)
        scenario, lasting = self.setup.scenario, self.setup.lasting
        self.network = SimulatedNetwork(story.seed, lasting.conditions)
        self._trace = TraceDigest() if digest else None
        self.network.trace = self._trace
        size = scenario.vehicle
        self.checker = Checker(
            Geometry(
                scenario.formation.gap_m, scenario.road.lane_width_m, size.length_m, size.width_m
            ),
            timeline.add if timeline is not None else None,
            rolling=self.setup.road.rolling,
        )
        self._features: set[str] = set()
        """Rules and guards reached so far."""
        self._rules = rules.observed(self._on_reached)
        self._timeline = timeline
        self._incarnations = count(1)
        self.faults = RandomFaults(
            self.network,
            self,
            lasting,
            scenario.network.realm,
            self.checker.claims.harmful,
            self._log,
        )
        self._arrivals = Arrivals(self.setup, story.fault_s)
        self._preferences = story.preferences[0].lanes
        self._takeovers = 0
        """Number of takeovers by caretakers on earlier roads."""
        self.road = self._make_road()
        self._set_clocks()
        self._add(ROAD, self.road)
        for name in (*COORDINATORS, *self.agents):
            self.start(name)

    def run(self) -> SeedResult:
        """Run the fault phase, then wait until all vehicles have arrived; stop at a violation."""
        began_s = time.process_time()
        network, story = self.network, self.story
        self.faults.plan(story.events)
        for change in story.preferences[1:]:
            network.at(change.t_s, self._change_preferences, change.lanes)
        network.at(story.fault_s, self._heal)
        while network.now_s < self._arrivals.limit_s and not self._is_over():
            network.run(network.now_s + CHECK_S)
            while network.failed_jobs:
                failed = network.failed_jobs.pop()
                # States of an earlier road may contradict others; the leader plans again later.
                if not failed[-1].startswith(BadInputError.__name__):
                    self.checker.crashed(*failed)
            self._check_leaders()
            if self.faults.healed:
                self._restart_agents()
        self.checker.advance(network.now_s)
        self._arrivals.check(network.now_s, self.road, self.checker)
        return self._result(time.process_time() - began_s)

    # --- processes ----------------------------------------------------------------------------

    @property
    def agents(self) -> tuple[str, ...]:
        """Agents of the vehicles that have not left the road."""
        road_s = self.network.now_s - self.road.began_s
        return tuple(visit.vehicle for visit in self.setup.visits if road_s < visit.until_s)

    @property
    def leaders(self) -> tuple[str, ...]:
        """Coordinators that consider themselves the leader."""
        return tuple(name for name in COORDINATORS if self._leads(name))

    def start_twin(self, name: str) -> str:
        """Start a second process for the vehicle of an agent, and return its name."""
        twin = f"{name}{TWIN}"
        self.start(twin)
        return twin

    def start(self, name: str) -> None:
        """Start a process unless it is running; the road begins anew."""
        if name in self.network:
            return
        scenario, rules = self.setup.scenario, self._rules
        incarnation = self._incarnations.__next__
        core: Core
        if name == ROAD:
            self._takeovers += self.road.takeovers
            core = self.road = self._make_road()
            self.checker.begin_road(self.network.now_s)
        elif name in COORDINATORS:
            core = CoordinatorCore(
                Name(name),
                incarnation(),
                scenario,
                rules.leader,
                self._make_planner,
                transfer_rules=rules.transfer,
            )
        else:
            vehicle = Name(name.removesuffix(TWIN))
            incarnation = partial(self._new_incarnation, vehicle)
            agent = AgentCore(vehicle, incarnation, scenario, LightDriver, rules.vehicle)
            core = AgentHost(vehicle, lambda _: agent, incarnation(), scenario.runtime, [vehicle])
        self._add(name, core)

    def _new_incarnation(self, vehicle: Name) -> int:
        """Return an incarnation by the clock of a vehicle's host, which may be ahead of others."""
        ahead_s = max(0.0, self.setup.visit_of[vehicle].clock_offset_s)
        return next(self._incarnations) + round(INCARNATIONS_PER_S * ahead_s)

    def _add(self, name: str, core: Core) -> None:
        listened = _ListenedCore(core, name, self._on_message, self._on_compute)
        self.network.add(name, listened, self.setup.scenario.network.realm)

    def _make_road(self) -> LightRoad:
        """Return a road without vehicles, which begins now."""
        bridge = next(self._incarnations)
        road = LightRoad(
            self.setup.scenario,
            self.setup.make_roadside(self.story.preferences[0].lanes, bridge),
            self.setup.visit_of,
            self.checker,
            self._incarnations.__next__,
            self._move_lasts_s,
            self._reception,
            bridge=bridge,
            began_s=self.network.now_s,
        )
        road.prefer(self._preferences)
        return road

    def _make_planner(self, scenario: Scenario) -> Planner:
        exact = self.setup.road.stream_planner
        planner = stream_planner(scenario) if exact else LightPlanner(scenario).plan
        return self._arrivals.counted(planner)

    def _leads(self, name: str) -> bool:
        if name not in self.network:
            return False
        core = self.network.node(name).core
        core = core.core if isinstance(core, _ListenedCore) else core
        return isinstance(core, CoordinatorCore) and core.election.leading

    def _restart_agents(self) -> None:
        """Restart agents that have ended, for example because of a late message of another road."""
        for name in self.agents:
            self.start(name)

    def _check_leaders(self) -> None:
        """Check that disconnected candidates do not lead, and that one leads without faults."""
        now_s = self.network.now_s
        for name in self.leaders:
            if self.network.offline_s(name) > NOTICE_S:
                self.checker.leads(now_s, name, "leads without a connection")
        if now_s > self.story.fault_s + ELECTED_S and len(self.leaders) != 1:
            self.checker.leads(now_s, " ".join(self.leaders), "there is not one leader")

    # --- clocks -------------------------------------------------------------------------------

    def _set_clocks(self) -> None:
        if not self.setup.lasting.wrong_clocks:
            return
        for name in (*COORDINATORS, *(visit.vehicle for visit in self.setup.visits)):
            offset_s = self._rng.uniform(-CLOCK_OFFSET_S, CLOCK_OFFSET_S)
            rate = 1.0 + self._rng.uniform(-CLOCK_DRIFT, CLOCK_DRIFT)
            self.network.set_clock(name, offset_s, rate)

    def jump_clock(self, name: str, jump_s: float) -> None:
        """Change the clock of a vehicle or coordinator; 0: end its error by jumps.

        The clock of a process cannot be set back, so only a vehicle's road time jumps back.
        """
        vehicle = self.road.vehicles.get(Name(name))
        if vehicle is not None:
            vehicle.clock_jump_s = jump_s
        elif name in COORDINATORS and jump_s:
            self.network.advance_clock(name, abs(jump_s))

    # --- draws for the road -------------------------------------------------------------------

    def _move_lasts_s(self) -> float:
        rng = self._rng
        if not self.faults.healed and rng.random() < self.setup.lasting.slow_moves:
            slot_s = self.setup.scenario.timing.cycles_s[0]
            return rng.uniform(slot_s, MAX_MOTION_SLOTS * slot_s)
        return self.setup.scenario.timing.move_s

    def _reception(self, vehicle: Name) -> Reception:
        lasting = self.setup.lasting
        if self.faults.healed:
            return Reception.IN_TIME
        if lasting.command_loss and self._rng.random() < lasting.command_loss:
            return Reception.LOST
        if vehicle in self.faults.processes.refused:
            return Reception.LATE
        if lasting.late_commands and self._rng.random() < lasting.late_commands:
            return Reception.LATE
        return Reception.IN_TIME

    def _change_preferences(self, lanes: Mapping[Name, int]) -> None:
        self._preferences = lanes
        self.road.prefer(lanes)
        self._log(f"new preferred lanes: {dict(lanes)}")

    # --- messages -----------------------------------------------------------------------------

    def _on_message(self, sender: str, effect: Send) -> Send:
        now_s = self.network.now_s
        effect = self.faults.messages.changed(effect)
        self.faults.on_sent(sender, effect)
        self.checker.sent(now_s, effect.message)
        if self._timeline is not None:
            self._timeline.add_message(now_s, sender, effect)
        return effect

    def _on_reached(self, feature: str, machine: Any) -> None:  # noqa: ANN401 (a state machine)
        self._features.add(feature)
        claims, now_s = self.checker.claims, self.network.now_s
        if feature == ADOPTION:
            claims.on_adoption(now_s, machine.ballot, machine.roster, machine.states)
        elif feature == PLANNING:
            claims.on_planning(
                now_s, machine.now_s, machine.ballot, machine.promises, machine.states
            )

    def _on_compute(self, name: str) -> None:
        self.checker.computes(self.network.now_s, name)

    def _log(self, text: str) -> None:
        if self._timeline is not None:
            self._timeline.add(self.network.now_s, text)

    # --- outcome ------------------------------------------------------------------------------

    def _heal(self) -> None:
        self.faults.heal()
        self._arrivals.healed = True

    def _is_over(self) -> bool:
        complete = self._arrivals.complete(self.network.now_s, self.road)
        return complete or bool(self.checker.violations)

    def _result(self, cpu_s: float) -> SeedResult:
        network, checker = self.network, self.checker
        plans = checker.plans.values()
        totals = Totals(
            runs=1,
            virtual_s=network.now_s,
            cpu_s=cpu_s,
            vehicles=len(self.setup.visits),
            motions=checker.motions,
            plans=len(plans),
            joint_plans=sum(len(plan.blocks) > 1 for plan in plans),
            takeovers=self._takeovers + self.road.takeovers,
            delivered=network.delivered,
            dropped=network.dropped,
            longest_recovery_s=network.now_s - self.story.fault_s,
            faults=self.faults.counts,
        )
        digest = self._trace.hexdigest() if self._trace is not None else ""
        return SeedResult(
            self.story.seed,
            tuple(checker.violations),
            totals,
            digest,
            features=frozenset(self._features),
        )
