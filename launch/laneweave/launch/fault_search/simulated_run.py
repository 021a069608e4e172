"""One simulated run: real cores, a light road, a network full of faults, and a checker.

First a phase of faults, in which wishes change so that plans never end; then everything is made
whole, and everybody must arrive. Equal seeds give equal runs.
"""

from __future__ import annotations

import random
import time
from collections import Counter, deque
from collections.abc import Sequence
from itertools import count

from attrs import field, frozen

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.formations.leader_rules import LEADER_RULES
from laneweave.coordinator.rolling.planner import Planner, stream_planner
from laneweave.launch.fault_search.bodies import Geometry
from laneweave.launch.fault_search.checker import Checker, Violation
from laneweave.launch.fault_search.faults import CLOCK_DRIFT, CLOCK_OFFSET_S, ROAD, Injector
from laneweave.launch.fault_search.light_driver import LightDriver
from laneweave.launch.fault_search.light_road import LightRoad
from laneweave.launch.fault_search.message_tap import Tap
from laneweave.launch.fault_search.planners import LightPlanner, Watched
from laneweave.launch.fault_search.profiles import Profile
from laneweave.launch.fault_search.setup import Setup
from laneweave.launch.fault_search.story import Story
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Core, Send
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import TraceDigest
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Command, Name, Plan, Prepare, Sense, VehicleState
from laneweave.protocol.wire.topics import Keys

TWIN = ".2"
"""Of the name of a second process of a vehicle."""
COORDINATORS = ("c1", "c2", "c3")
SLOWEST_SLOTS = 3.0
"""A slow motion takes at most this many slots."""
NEW_WISHES_S = (0.8, 3.0)
"""While faults happen vehicles change their minds after such times."""
PATIENCE_S = 90.0
"""Time that everybody has to arrive once everything is whole."""
FUTILE = 5
"""A vehicle that does not move though so many plans would move it is stuck."""
SLOTS_WHOLE = 8
"""Slots that a run of the rolling operation goes on for once everything is whole."""
LOOK_S = 0.5
"""How often it is looked whether a run is over."""
KEPT = 400
"""Old messages that may be replayed or damaged."""
KEEP_EVERY = 7
_REPLAYABLE = (Prepare, Plan, VehicleState, Command, Sense)


@frozen
class Totals:
    """What a run, or many of them, consisted of."""

    runs: int = 0
    virtual_s: float = 0.0
    cpu_s: float = 0.0
    vehicles: int = 0
    motions: int = 0
    plans: int = 0
    joint_plans: int = 0
    takeovers: int = 0
    """Of vehicles by caretakers."""
    delivered: int = 0
    dropped: int = 0
    longest_healing_s: float = 0.0
    faults: Counter[str] = field(factory=Counter)

    def __add__(self, other: Totals) -> Totals:
        """Return the sum."""
        return Totals(
            self.runs + other.runs,
            self.virtual_s + other.virtual_s,
            self.cpu_s + other.cpu_s,
            self.vehicles + other.vehicles,
            self.motions + other.motions,
            self.plans + other.plans,
            self.joint_plans + other.joint_plans,
            self.takeovers + other.takeovers,
            self.delivered + other.delivered,
            self.dropped + other.dropped,
            max(self.longest_healing_s, other.longest_healing_s),
            self.faults + other.faults,
        )


@frozen
class Outcome:
    """What a run came to."""

    seed: int
    violations: tuple[Violation, ...]
    totals: Totals
    digest: str = ""
    """Of everything that was delivered, if asked for."""


class World:
    """One run; `run` does it all."""

    coordinators: tuple[str, ...] = COORDINATORS

    def __init__(
        self,
        seed: int,
        profile: Profile,
        vehicle_rules: RuleBook = VEHICLE_RULES,
        leader_rules: RuleBook = LEADER_RULES,
        story: Story | None = None,
        *,
        digest: bool = False,
    ) -> None:
        """Draw road, vehicles and faults, and start all processes.

        Args:
            seed: decides everything, together with the profile's name.
            profile: what to draw from.
            vehicle_rules: of plan execution; others only to plant a bug.
            leader_rules: of leaders; likewise.
            story: collects what happens.
            digest: whether to make a digest of all that is delivered.
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
            story.tell if story is not None else None,
            rolling=profile.rolling,
        )
        self._rules = vehicle_rules, leader_rules
        self._story = story
        self._keys = Keys(scenario.network.realm)
        self._incarnations = count(1)
        self._kept: deque[Send] = deque(maxlen=KEPT)
        self._said = 0
        self.injector = Injector(
            self.network, self, mix, self._rng, scenario.network.realm, self._note
        )
        self._proposed: Counter[str] = Counter()
        """How often a planner meant to move each vehicle since everything was made whole, or was
        told that it must hold."""
        self._first_cells: dict[Name, Cell] = {}
        """Where each vehicle was found first since then (rolling operation)."""
        self._moved: set[Name] = set()
        """Who has been found elsewhere since."""
        self._wishes = self.setup.wishes(self._rng, last=False)
        self.road = LightRoad(
            scenario,
            self.setup.visits,
            self._wishes,
            self.checker,
            self._incarnations.__next__,
            self._move_lasts_s,
            self._loses_command,
            self.setup.formations,
            self.setup.grants,
        )
        self._set_clocks()
        self.network.add(ROAD, Tap(self.road, ROAD, self._on_sent), scenario.network.realm)
        for name in (*COORDINATORS, *self.agents):
            self.start(name)

    def run(self) -> Outcome:
        """Run the faults, heal everything, and wait until all have arrived; end on a violation."""
        began_s = time.process_time()
        network, fault_s = self.network, self.setup.mix.fault_s
        self.injector.plan(self.profile.harm)
        change_s, last = 0.0, False
        while not last:
            change_s += self._rng.uniform(*NEW_WISHES_S)
            last = change_s + NEW_WISHES_S[1] > fault_s
            network.at(change_s, self._change_wishes, last)
        network.at(fault_s, self.injector.heal)
        end_s = fault_s + self._patience_s
        while network.now_s < end_s and not self._is_over():
            network.run(network.now_s + LOOK_S)
        self.checker.advance(network.now_s)
        for name in self._astray():
            vehicle = self.road.vehicles[name]
            text = f"in {vehicle.controller.hold_cell}, wants lane {vehicle.preferred_lane}"
            self.checker.stuck(network.now_s, name, text)
        return self._outcome(time.process_time() - began_s)

    # --- processes ----------------------------------------------------------------------------

    @property
    def agents(self) -> tuple[str, ...]:
        """Processes of the vehicles that have not left."""
        now_s = self.network.now_s
        return tuple(
            visit.vehicle
            for visit in self.setup.visits
            if visit.leaves_s is None or now_s < visit.leaves_s
        )

    @property
    def leaders(self) -> tuple[str, ...]:
        """Coordinators that take themselves for the leader."""
        return tuple(name for name in COORDINATORS if self._leads(name))

    def start_twin(self, name: str) -> str:
        """Start a second process for an agent's vehicle, and return the name of its node."""
        twin = f"{name}{TWIN}"
        self.start(twin)
        return twin

    def start(self, name: str) -> None:
        """Start a process, unless it runs."""
        if name in self.network:
            return
        vehicle = Name(name.removesuffix(TWIN))
        scenario, (vehicle_rules, leader_rules) = self.setup.scenario, self._rules
        core: Core
        if name in COORDINATORS:
            incarnation = next(self._incarnations)
            core = CoordinatorCore(
                Name(name), incarnation, scenario, leader_rules, self._make_planner
            )
        else:
            agent = AgentCore(
                vehicle, self._incarnations.__next__, scenario, LightDriver, vehicle_rules
            )
            core = AgentHost(lambda _: agent, [vehicle])
        self.network.add(name, Tap(core, name, self._on_sent), scenario.network.realm)

    def _make_planner(self, scenario: Scenario) -> Planner:
        planner = stream_planner(scenario) if self.setup.thorough else LightPlanner(scenario)
        return Watched(planner, self._on_planned)

    def _on_planned(self, movers: Sequence[str]) -> None:
        if self.injector.healed:
            self._proposed.update(movers)

    def old_payload(self, rng: random.Random) -> tuple[str, bytes] | None:
        """Return a message that was sent some time ago, with its key."""
        if not self._kept:
            return None
        old = rng.choice(self._kept)
        return self._keys.key(old.topic, **old.parameters), encode(old.message)

    def _leads(self, name: str) -> bool:
        if name not in self.network:
            return False
        tap = self.network.node(name).core
        core = tap.core if isinstance(tap, Tap) else tap
        return isinstance(core, CoordinatorCore) and core.election.leading

    def _set_clocks(self) -> None:
        if not self.setup.mix.wrong_clocks:
            return
        for name in (*COORDINATORS, *(visit.vehicle for visit in self.setup.visits)):
            offset_s = self._rng.uniform(-CLOCK_OFFSET_S, CLOCK_OFFSET_S)
            rate = 1.0 + self._rng.uniform(-CLOCK_DRIFT, CLOCK_DRIFT)
            self.network.set_clock(name, offset_s, rate)

    # --- what the road asks for ---------------------------------------------------------------

    def _move_lasts_s(self) -> float:
        rng = self._rng
        if not self.injector.healed and rng.random() < self.setup.mix.slow_moves:
            slot_s = self.setup.scenario.cycles_s[0]
            return rng.uniform(slot_s, SLOWEST_SLOTS * slot_s)
        return self.setup.scenario.move_s

    def _loses_command(self) -> bool:
        share = self.setup.mix.command_loss
        return share > 0.0 and not self.injector.healed and self._rng.random() < share

    def _change_wishes(self, last: bool) -> None:
        self._wishes = self.setup.wishes(self._rng, last=last)
        self.road.prefer(self._wishes)
        self._note(f"new wishes: {self._wishes}")

    # --- what is said -------------------------------------------------------------------------

    def _on_sent(self, sender: str, effect: Send) -> None:
        now_s = self.network.now_s
        self.checker.sent(now_s, effect.message)
        self._said += 1
        if self._said % KEEP_EVERY == 0 and isinstance(effect.message, _REPLAYABLE):
            self._kept.append(effect)
        if self._story is not None:
            self._story.said(now_s, sender, effect)

    def _note(self, text: str) -> None:
        if self._story is not None:
            self._story.tell(self.network.now_s, text)

    # --- the end ------------------------------------------------------------------------------

    def _is_over(self) -> bool:
        if self.profile.rolling:
            self._astray()
            return bool(self.checker.violations)
        return bool(self.checker.violations) or (self.injector.healed and not self._astray())

    @property
    def _patience_s(self) -> float:
        scenario = self.setup.scenario
        if scenario.formation.rolling:
            return SLOTS_WHOLE * scenario.cycles_s[0]
        return PATIENCE_S

    def _astray(self) -> list[Name]:
        """Return who is on the road but does not rest on the lane that it prefers."""
        if self.checker.violations or not self.injector.healed:
            return []
        now_s = self.network.now_s
        astray = [
            name
            for name, vehicle in self.road.vehicles.items()
            if vehicle.controller.hold_cell[1] != vehicle.preferred_lane
            or not vehicle.body.has_arrived(now_s)
        ]
        if not self.profile.rolling:
            return astray
        return [name for name in astray if not self._has_done_its_part(name)]

    def _has_done_its_part(self, name: Name) -> bool:
        """Tell whether a vehicle of the rolling operation moves, or nobody means to move it.

        Who has been on its lane may have made room for others since, and some lanes are full.
        """
        cell = self.road.vehicles[name].controller.hold_cell
        moved = self._first_cells.setdefault(name, cell) != cell
        if moved:
            self._moved.add(name)
        return name in self._moved or self._proposed[name] < FUTILE

    def _outcome(self, cpu_s: float) -> Outcome:
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
            longest_healing_s=network.now_s - self.setup.mix.fault_s,
            faults=self.injector.counts,
        )
        digest = self._trace.hexdigest() if self._trace is not None else ""
        return Outcome(self.seed, tuple(checker.violations), totals, digest)
