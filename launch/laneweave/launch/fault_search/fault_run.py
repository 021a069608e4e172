"""A run of the fault search: real cores, a simplified road, random faults, a checker.

During the fault phase, preferred lanes change repeatedly, which requires new plans. Then all faults
end, and all vehicles must arrive. The same seed gives the same run.
"""

from __future__ import annotations

import random
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from itertools import count

import attrs
from attrs import field, frozen

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.planning.rolling.problem import StreamPlan, StreamVehicle
from laneweave.coordinator.rolling.checked_planner import Planner, stream_planner
from laneweave.launch.fault_search.checker import Checker, Violation
from laneweave.launch.fault_search.checker_geometry import Geometry
from laneweave.launch.fault_search.faults import CLOCK_DRIFT, CLOCK_OFFSET_S, ROAD, RandomFaults
from laneweave.launch.fault_search.light_road import LightRoad
from laneweave.launch.fault_search.profiles import Profile
from laneweave.launch.fault_search.setup import Setup
from laneweave.launch.fault_search.stand_ins import LightDriver, LightPlanner
from laneweave.launch.fault_search.timeline import Timeline
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Core, Effect, Event, Send
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import TraceDigest
from laneweave.protocol.vehicle.plan_execution import VEHICLE_RULES
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Command, Name, Plan, Prepare, Sense, VehicleState
from laneweave.protocol.wire.topics import Keys

TWIN = ".2"
"""Suffix of the name of the second process of a vehicle."""
COORDINATORS = ("c1", "c2", "c3")
MAX_MOTION_SLOTS = 3.0
"""Maximum duration of a slow motion, in slots."""
NEW_PREFERENCES_S = (0.8, 3.0)
"""Range of intervals at which the preferred lanes change during the fault phase."""
PATIENCE_S = 90.0
"""Time limit for all vehicles to arrive after the fault phase."""
MAX_FUTILE_PLANS = 5
"""Number of plans after which a vehicle that has not moved counts as stuck."""
HEALTHY_SLOTS = 8
"""Number of slots after the fault phase (rolling operation)."""
CHECK_S = 0.5
"""Virtual time between checks of whether a run is over."""
MAX_OLD_MESSAGES = 400
"""Maximum number of old messages kept for replay or corruption."""
KEEP_EVERY = 7
"""One in this many sent messages is kept."""
_REPLAYABLE = (Prepare, Plan, VehicleState, Command, Sense)


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


class _ListenedCore:
    """Core that passes its sent messages to a listener."""

    def __init__(self, core: Core, name: str, listener: Callable[[str, Send], None]) -> None:
        self.core = core
        self._name = name
        self._listener = listener

    @property
    def wakeup_s(self) -> float | None:
        return self.core.wakeup_s

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        effects = list(self.core.handle(event, now_s))
        for effect in effects:
            if type(effect) is Send:
                self._listener(self._name, effect)
        return effects


class FaultRun:
    """A run of one seed; call `run` once."""

    coordinators: tuple[str, ...] = COORDINATORS

    def __init__(
        self,
        seed: int,
        profile: Profile,
        vehicle_rules: RuleBook = VEHICLE_RULES,
        leader_rules: RuleBook = LEADER_RULES,
        timeline: Timeline | None = None,
        *,
        digest: bool = False,
    ) -> None:
        """Draw the setup and start all processes.

        Args:
            seed: determines all draws, together with the profile name.
            profile: profile from which the setup is drawn.
            vehicle_rules: rules of plan execution, which tests replace with faulty ones.
            leader_rules: rules of leaders, which tests replace with faulty ones.
            timeline: timeline to which events are added.
            digest: whether to compute a digest of all delivered messages.
        """
        self.seed = seed
        self.profile = profile
        self._rng = random.Random(f"{profile.name}/{seed}")  # noqa: S311 (simulation, no secrets)
        self.setup = Setup.drawn(profile, self._rng)
        scenario, mix = self.setup.scenario, self.setup.mix
        self.network = SimulatedNetwork(seed, mix.conditions)
        self._trace = TraceDigest() if digest else None
        self.network.trace = self._trace
        size = scenario.vehicle
        self.checker = Checker(
            Geometry(
                scenario.formation.gap_m, scenario.road.lane_width_m, size.length_m, size.width_m
            ),
            timeline.add if timeline is not None else None,
            rolling=profile.rolling,
        )
        self._rules = vehicle_rules, leader_rules
        self._timeline = timeline
        self._keys = Keys(scenario.network.realm)
        self._incarnations = count(1)
        self._old_messages: deque[Send] = deque(maxlen=MAX_OLD_MESSAGES)
        self._sent = 0
        self.faults = RandomFaults(
            self.network, self, mix, self._rng, scenario.network.realm, self._log
        )
        self._proposed: Counter[str] = Counter()
        """Number of plans after the fault phase that move or hold each vehicle."""
        self._first_cells: dict[Name, Cell] = {}
        """First cell of each vehicle after the fault phase (rolling operation)."""
        self._moved: set[Name] = set()
        """Vehicles that have moved since the fault phase."""
        self._preferences = self.setup.preferences(self._rng, last=False)
        self.road = LightRoad(
            scenario,
            self.setup.visits,
            self._preferences,
            self.checker,
            self._incarnations.__next__,
            self._move_lasts_s,
            self._loses_command,
            self.setup.formations,
            self.setup.grants,
        )
        self._set_clocks()
        self.network.add(
            ROAD, _ListenedCore(self.road, ROAD, self._on_message), scenario.network.realm
        )
        for name in (*COORDINATORS, *self.agents):
            self.start(name)

    def run(self) -> SeedResult:
        """Run the fault phase, then wait until all vehicles have arrived; stop at a violation."""
        began_s = time.process_time()
        network, fault_s = self.network, self.setup.mix.fault_s
        self.faults.plan(self.profile.event_kinds)
        change_s, last = 0.0, False
        while not last:
            change_s += self._rng.uniform(*NEW_PREFERENCES_S)
            last = change_s + NEW_PREFERENCES_S[1] > fault_s
            network.at(change_s, self._change_preferences, last)
        network.at(fault_s, self.faults.heal)
        end_s = fault_s + self._patience_s
        while network.now_s < end_s and not self._is_over():
            network.run(network.now_s + CHECK_S)
            while network.failed_jobs:
                self.checker.crashed(*network.failed_jobs.pop())
        self.checker.advance(network.now_s)
        for name in self._not_arrived():
            vehicle = self.road.vehicles[name]
            text = f"in {vehicle.controller.hold_cell}, prefers lane {vehicle.preferred_lane}"
            self.checker.stuck(network.now_s, name, text)
        return self._result(time.process_time() - began_s)

    # --- processes ----------------------------------------------------------------------------

    @property
    def agents(self) -> tuple[str, ...]:
        """Agents of the vehicles that have not left the road."""
        now_s = self.network.now_s
        return tuple(
            visit.vehicle
            for visit in self.setup.visits
            if visit.leaves_s is None or now_s < visit.leaves_s
        )

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
        """Start a process unless it is running."""
        if name in self.network:
            return
        scenario, (vehicle_rules, leader_rules) = self.setup.scenario, self._rules
        core: Core
        if name in COORDINATORS:
            incarnation = next(self._incarnations)
            core = CoordinatorCore(
                Name(name), incarnation, scenario, leader_rules, self._make_planner
            )
        else:
            vehicle = Name(name.removesuffix(TWIN))
            agent = AgentCore(
                vehicle, self._incarnations.__next__, scenario, LightDriver, vehicle_rules
            )
            core = AgentHost(lambda _: agent, [vehicle])
        self.network.add(name, _ListenedCore(core, name, self._on_message), scenario.network.realm)

    def _make_planner(self, scenario: Scenario) -> Planner:
        """Return a planner that, after the fault phase, counts its plans for each vehicle."""
        exact = self.setup.uses_stream_planner
        planner = stream_planner(scenario) if exact else LightPlanner(scenario).plan

        def plan(
            slot: int,
            vehicles: Sequence[StreamVehicle],
            before: StreamPlan | None,
            blocked: Collection[Cell],
        ) -> StreamPlan:
            table = planner(slot, vehicles, before, blocked)
            if self.faults.healed:
                paths = table.paths.items()
                self._proposed.update(vehicle.vehicle for vehicle in vehicles if vehicle.held)
                self._proposed.update(
                    name for name, path in paths if len(path) > 1 and path[0] != path[1]
                )
            return table

        return plan

    def old_payload(self, rng: random.Random) -> tuple[str, bytes] | None:
        """Return the key and payload of a random old message, or None."""
        if not self._old_messages:
            return None
        old = rng.choice(self._old_messages)
        return self._keys.key(old.topic, **old.parameters), encode(old.message)

    def _leads(self, name: str) -> bool:
        if name not in self.network:
            return False
        core = self.network.node(name).core
        core = core.core if isinstance(core, _ListenedCore) else core
        return isinstance(core, CoordinatorCore) and core.election.leading

    def _set_clocks(self) -> None:
        if not self.setup.mix.wrong_clocks:
            return
        for name in (*COORDINATORS, *(visit.vehicle for visit in self.setup.visits)):
            offset_s = self._rng.uniform(-CLOCK_OFFSET_S, CLOCK_OFFSET_S)
            rate = 1.0 + self._rng.uniform(-CLOCK_DRIFT, CLOCK_DRIFT)
            self.network.set_clock(name, offset_s, rate)

    # --- draws for the road -------------------------------------------------------------------

    def _move_lasts_s(self) -> float:
        rng = self._rng
        if not self.faults.healed and rng.random() < self.setup.mix.slow_moves:
            slot_s = self.setup.scenario.cycles_s[0]
            return rng.uniform(slot_s, MAX_MOTION_SLOTS * slot_s)
        return self.setup.scenario.move_s

    def _loses_command(self) -> bool:
        share = self.setup.mix.command_loss
        return share > 0.0 and not self.faults.healed and self._rng.random() < share

    def _change_preferences(self, last: bool) -> None:
        self._preferences = self.setup.preferences(self._rng, last=last)
        self.road.prefer(self._preferences)
        self._log(f"new preferred lanes: {self._preferences}")

    # --- messages -----------------------------------------------------------------------------

    def _on_message(self, sender: str, effect: Send) -> None:
        now_s = self.network.now_s
        self.checker.sent(now_s, effect.message)
        self._sent += 1
        if self._sent % KEEP_EVERY == 0 and isinstance(effect.message, _REPLAYABLE):
            self._old_messages.append(effect)
        if self._timeline is not None:
            self._timeline.add_message(now_s, sender, effect)

    def _log(self, text: str) -> None:
        if self._timeline is not None:
            self._timeline.add(self.network.now_s, text)

    # --- outcome ------------------------------------------------------------------------------

    def _is_over(self) -> bool:
        # In the rolling operation, this call also records which vehicles have moved.
        not_arrived = self._not_arrived()
        if self.checker.violations:
            return True
        return self.faults.healed and not not_arrived and not self.profile.rolling

    @property
    def _patience_s(self) -> float:
        if self.profile.rolling:
            return HEALTHY_SLOTS * self.setup.scenario.cycles_s[0]
        return PATIENCE_S

    def _not_arrived(self) -> list[Name]:
        """Return the vehicles that should be at rest in their preferred lanes, but are not."""
        if self.checker.violations or not self.faults.healed:
            return []
        now_s = self.network.now_s
        not_arrived = [
            name
            for name, vehicle in self.road.vehicles.items()
            if vehicle.controller.hold_cell[1] != vehicle.preferred_lane
            or not vehicle.body.has_arrived(now_s)
        ]
        if not self.profile.rolling:
            return not_arrived
        return [name for name in not_arrived if self._is_stuck(name)]

    def _is_stuck(self, name: Name) -> bool:
        """Return whether a vehicle has not moved although plans move it (rolling operation).

        A vehicle that has moved need not be in its preferred lane, which may be full.
        """
        cell = self.road.vehicles[name].controller.hold_cell
        if self._first_cells.setdefault(name, cell) != cell:
            self._moved.add(name)
        return name not in self._moved and self._proposed[name] >= MAX_FUTILE_PLANS

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
            joint_plans=sum(len(plan.formations) > 1 for plan in plans),
            takeovers=self.road.takeovers,
            delivered=network.delivered,
            dropped=network.dropped,
            longest_recovery_s=network.now_s - self.setup.mix.fault_s,
            faults=self.faults.counts,
        )
        digest = self._trace.hexdigest() if self._trace is not None else ""
        return SeedResult(self.seed, tuple(checker.violations), totals, digest)
