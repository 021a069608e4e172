"""A light world for random search: real cores on the simulated network, motion by a timer.

Vehicles are `Body` objects: their motion controllers, which go on when their agent processes die.
A `LightAgent` runs the real `PlanExecution` at each tick and moves its body; a `Roadside` sends
clock and census; the coordinators are real. `Watchdog` looks at the bodies only and knows nothing
of the protocol: it computes what each of them occupies in its own way and notes every overlap.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping

from attrs import define, field, frozen

from laneweave.agents.execution import PlanExecution
from laneweave.coordinator.core import CoordinatorCore
from laneweave.protocol.lattice import Cell, Move
from laneweave.protocol.messages import (
    Census,
    CensusEntry,
    Name,
    Plan,
    Prepare,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.node import (
    Announce,
    Arrived,
    Effect,
    Event,
    Listen,
    Send,
    Started,
    Wakeup,
)
from laneweave.protocol.scenario import FormationSettings, Road, Runtime, Scenario
from laneweave.protocol.simulated_network import Conditions, SimulatedNetwork
from laneweave.protocol.topics import CENSUS, CLOCK, PLAN, PREPARE, STATE, VEHICLE_ALIVE

REALM = "simulated"
TICK_S = 0.1
MOVE_S = 0.8
SLOT_S = 1.0
OVERDUE_S = 1.5
CLOCK_S = 0.2
CENSUS_EVERY = 5
"""Clock messages per census."""
FAULTS_END_S = 10.0
NEW_WISHES_S = 2.5
"""Vehicles change their minds this often until the faults are over, so that plans never end."""
LAST_WISHES_S = FAULTS_END_S - NEW_WISHES_S
PATIENCE_S = 40.0
"""Time that everybody has to reach the preferred lane once the faults are over."""

SCENARIO = Scenario(
    road=Road(s1_m=0.0, s2_m=0.0, s3_m=20_000.0),
    # The bound on nodes ends a search; the clock of a busy machine must not.
    formation=FormationSettings(cycle_s=SLOT_S, move_s=MOVE_S, planning_deadline_s=60.0),
    runtime=Runtime(tick_s=TICK_S),
)


@define(eq=False)
class Body:
    """A vehicle on the road with its motion controller."""

    name: Name
    cell: Cell
    """Where it is, or where its motion began."""
    preferred_lane: int
    target: Cell = field(init=False)
    """Where it will hold; equal to `cell` when it does not move."""

    def __attrs_post_init__(self) -> None:
        """Begin at rest."""
        self.target = self.cell

    @property
    def moving(self) -> bool:
        return self.target != self.cell


@frozen
class Overlap:
    """Two vehicles claimed one cell."""

    t_s: float
    vehicles: tuple[Name, Name]
    cells: frozenset[Cell]


class Watchdog:
    """Compares what all bodies occupy whenever one of them begins a motion."""

    def __init__(self, bodies: Mapping[Name, Body]) -> None:
        """Watch all bodies of a world."""
        self._bodies = bodies
        self.overlaps: list[Overlap] = []
        self.motions = 0

    def motion_begins(self, mover: Body, t_s: float) -> None:
        self.motions += 1
        mine = self.occupied(mover)
        for other in self._bodies.values():
            if other is not mover and mine & self.occupied(other):
                self.overlaps.append(
                    Overlap(t_s, (mover.name, other.name), mine & self.occupied(other))
                )

    @staticmethod
    def occupied(body: Body) -> frozenset[Cell]:
        """Return the bounding box of the motion: both cells, and the corners if it is diagonal."""
        columns, lanes = zip(body.cell, body.target, strict=True)
        return frozenset(
            (column, lane)
            for column in range(min(columns), max(columns) + 1)
            for lane in range(min(lanes), max(lanes) + 1)
        )


class LightAgent:
    """An agent process without dynamics."""

    def __init__(self, body: Body, incarnation: int, world: World) -> None:
        """Take over whatever the body is doing (V1)."""
        self.body = body
        self._world = world
        self._own = {"vehicle": body.name}
        self._formation = SCENARIO.lattice.block_of(body.target[0])
        self._execution = PlanExecution(
            body.name, incarnation, body.target, OVERDUE_S, moving=body.moving
        )
        self._wakeup_s: float | None = None

    @property
    def wakeup_s(self) -> float | None:
        return self._wakeup_s

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        execution = self._execution
        match event:
            case Started():
                yield Listen(PREPARE, self._own)
                yield Listen(PLAN, self._own)
                yield Listen(STATE, {"formation": self._formation})
                yield Announce(VEHICLE_ALIVE, self._own)
                self._wakeup_s = now_s + TICK_S
            case Arrived(_, _, VehicleState() as state):
                if execution.needs_states(now_s):  # a real one does not even subscribe otherwise
                    execution.on_state(state)
            case Arrived(_, _, Prepare() as prepare):
                if execution.on_prepare(prepare):
                    yield self._show(now_s)
            case Arrived(_, _, Plan() as plan):
                if execution.on_plan(plan):
                    yield self._show(now_s)
            case Wakeup():
                self._wakeup_s = now_s + TICK_S
                self._tick(now_s)
                yield self._show(now_s)
            case _:
                pass

    def _tick(self, now_s: float) -> None:
        execution = self._execution
        if execution.moving and not self.body.moving:
            execution.end_motion()
        move = execution.next_move(now_s)
        if move is not None:
            execution.begin(move)
            self._world.move(self.body, move)

    def _show(self, now_s: float) -> Effect:
        execution = self._execution
        state = VehicleState(
            vehicle=execution.vehicle,
            incarnation=execution.incarnation,
            formation=self._formation,
            promised=execution.promised,
            accepted=execution.plan is not None,
            ready=execution.ready,
            completed=execution.completed,
            hold_cell=execution.hold_cell,
            moving=execution.moving,
            go=execution.go,
            done=execution.done,
            overdue=execution.overdue(now_s),
            s_m=0.0,
            y_m=0.0,
            speed_mps=0.0,
            t_s=now_s,
        )
        return Send(STATE, state, {"formation": self._formation, "vehicle": execution.vehicle})


class Roadside:
    """Sends clock and census; whoever is in the census stays there, preferences may change."""

    def __init__(self, bodies: Mapping[Name, Body]) -> None:
        """Remember where everybody is at the start."""
        self._entered = {body: body.cell for body in bodies.values()}
        self._sent = 0
        self._wakeup_s = 0.0

    @property
    def wakeup_s(self) -> float | None:
        return self._wakeup_s

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        if not isinstance(event, Started | Wakeup):
            return
        self._wakeup_s = now_s + CLOCK_S
        count = len(self._entered)
        yield Send(CLOCK, RoadClock(self._sent, now_s, count, count, count, 0, ended=False))
        if self._sent % CENSUS_EVERY == 0:
            entries = tuple(
                CensusEntry(body.name, cell, body.preferred_lane, 0.0)
                for body, cell in self._entered.items()
            )
            yield Send(CENSUS, Census(now_s, entries, ()))
        self._sent += 1


@frozen
class Faults:
    """How hard a run is; drawn per seed."""

    loss: float
    duplication: float
    jitter_s: float
    slow_moves: float
    """Share of motions that take up to three slots."""
    events: int
    """Kills, pauses, crashes and cuts before the faults end."""

    @classmethod
    def drawn(cls, rng: random.Random) -> Faults:
        return cls(
            loss=rng.choice((0.0, 0.2, 0.5, 0.8)),
            duplication=rng.choice((0.0, 0.3)),
            jitter_s=rng.choice((0.003, 0.05, 0.3, 1.0)),
            slow_moves=rng.choice((0.0, 0.2, 0.5)),
            events=rng.randrange(8),
        )


@frozen
class Outcome:
    """What a run came to."""

    overlaps: tuple[Overlap, ...]
    motions: int
    astray: tuple[Name, ...]
    """Vehicles that are not on their preferred lane at the end."""
    healed_s: float
    """Time from the end of the faults until all were there."""


class World:
    """One run; equal seeds give equal runs."""

    def __init__(self, seed: int, faults: Faults | None = None) -> None:
        """Draw the vehicles and, unless given, the faults."""
        self._rng = random.Random(f"world/{seed}")
        self.faults = faults or Faults.drawn(self._rng)
        faults = self.faults
        self.network = SimulatedNetwork(
            seed,
            Conditions(
                delay_s=0.002,
                jitter_s=faults.jitter_s,
                loss=faults.loss,
                duplication=faults.duplication,
            ),
        )
        self.bodies = {body.name: body for body in self._draw_bodies()}
        self._draw_wishes()
        self.watchdog = Watchdog(self.bodies)
        self._incarnation = 0
        self._coordinators = ("c1", "c2")
        self._healed = False
        self.network.add("roadside", Roadside(self.bodies), REALM)
        for name in (*self._coordinators, *self.bodies):
            self._start(name)

    def run(self) -> Outcome:
        """Run the faults, heal everything, and wait until all have arrived; stop on an overlap."""
        network = self.network
        for _ in range(self.faults.events):
            network.at(self._rng.uniform(0.3, FAULTS_END_S - 0.5), self._do_harm)
        for index in range(1, round(LAST_WISHES_S / NEW_WISHES_S) + 1):
            network.at(index * NEW_WISHES_S, self._draw_wishes)
        network.at(FAULTS_END_S, self._heal)
        network.run(FAULTS_END_S + PATIENCE_S, self._over)
        return Outcome(
            tuple(self.watchdog.overlaps),
            self.watchdog.motions,
            tuple(body.name for body in self.bodies.values() if not _arrived(body)),
            network.now_s - FAULTS_END_S,
        )

    def move(self, body: Body, move: Move) -> None:
        """Begin a motion of a body; it ends by itself, whatever becomes of its agent."""
        body.target = move[2]
        self.watchdog.motion_begins(body, self.network.now_s)
        slow = not self._healed and self._rng.random() < self.faults.slow_moves
        duration_s = self._rng.uniform(1.0, 3.0) * SLOT_S if slow else MOVE_S
        self.network.at(self.network.now_s + duration_s, lambda: self._rest(body))

    @staticmethod
    def _rest(body: Body) -> None:
        body.cell = body.target

    def _over(self) -> bool:
        return bool(self.watchdog.overlaps) or (
            self._healed and all(_arrived(body) for body in self.bodies.values())
        )

    # --- how it begins ------------------------------------------------------------------------

    def _draw_bodies(self) -> Iterator[Body]:
        rng, number = self._rng, 0
        for block in rng.sample((-1, -2, -3), rng.choice((1, 1, 2))):
            cells = sorted(SCENARIO.lattice.block_cells(block))
            for cell in rng.sample(cells, rng.choice((2, 3, 4, 6))):
                number += 1
                yield Body(Name(f"v{number}"), cell, preferred_lane=cell[1])

    def _draw_wishes(self) -> None:
        """Let every vehicle prefer a lane, in each formation at most as many as fit in it."""
        fit = [lane for lane in range(SCENARIO.road.lanes) for _ in range(4)]
        shuffled: dict[int, list[int]] = {}
        for body in self.bodies.values():
            block = SCENARIO.lattice.block_of(body.cell[0])
            lanes = shuffled.setdefault(block, self._rng.sample(fit, len(fit)))
            body.preferred_lane = lanes.pop()

    def _start(self, name: str) -> None:
        if name in self.network:
            return
        self._incarnation += 1
        if name in self.bodies:
            agent = LightAgent(self.bodies[Name(name)], self._incarnation, self)
            self.network.add(name, agent, REALM)
        else:
            self.network.add(name, CoordinatorCore(Name(name), self._incarnation, SCENARIO), REALM)

    # --- faults -------------------------------------------------------------------------------

    def _do_harm(self) -> None:
        rng, network = self._rng, self.network
        kind = rng.choice(("kill leader", "kill", "crash", "crash", "pause", "pause", "cut"))
        leaders = [name for name in self._coordinators if self._leads(name)]
        match kind:
            case "kill leader":
                victim = rng.choice(leaders or self._coordinators)
            case "kill":
                victim = rng.choice(self._coordinators)
            case "crash":
                victim = rng.choice(tuple(self.bodies))
            case _:
                victim = rng.choice(self._coordinators + tuple(self.bodies))
        if victim not in network:
            return
        later_s = network.now_s + rng.uniform(0.05, 2.5)
        if kind == "pause":
            network.pause(victim)
            network.at(later_s, lambda: self._resume(victim))
        elif kind == "cut":
            network.disconnect(victim)
            network.at(later_s, lambda: self._reconnect(victim))
        else:
            network.kill(victim)
            network.at(later_s, lambda: self._start(victim))

    def _leads(self, name: str) -> bool:
        if name not in self.network:
            return False
        core = self.network.node(name).core
        return isinstance(core, CoordinatorCore) and core.election.leading

    def _resume(self, name: str) -> None:
        if name in self.network:
            self.network.resume(name)

    def _reconnect(self, name: str) -> None:
        if name in self.network:
            self.network.reconnect(name)

    def _heal(self) -> None:
        self._healed = True
        self.network.conditions = Conditions()
        for name in (*self._coordinators, *self.bodies):
            self._start(name)
            self._resume(name)
            self._reconnect(name)


def _arrived(body: Body) -> bool:
    return not body.moving and body.cell[1] == body.preferred_lane
