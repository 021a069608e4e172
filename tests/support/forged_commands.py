"""Runs in which commands are forged, or agents are configured for another road.

A forger receives every SENSE and answers it, too; its answer may arrive before that of the agent.
It attacks a vehicle for some seconds in one of many ways (`Attack`), with the incarnation of the
process in charge or a higher one.
"""

from __future__ import annotations

import random
from array import array
from collections.abc import Callable, Iterator
from enum import Enum

from attrs import define, field
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Arrived, Effect, Event, Listen, Send, Started
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.wire.messages import (
    Ballot,
    Command,
    CurrentMotion,
    Name,
    PendingTransfer,
    Sense,
)
from laneweave.protocol.wire.topics import COMMAND, SENSE
from laneweave.sim_bridge.core import BridgeCore

TICKS = 30
"""Length of a forged trajectory."""
LASTS_S = (0.5, 8.0)
"""Shortest and longest duration of an attack."""
COPIES = 3


class Attack(Enum):
    """What the forger makes a vehicle do."""

    BRAKE = "brake"
    SURGE = "surge"
    LEFT = "left"
    RIGHT = "right"
    WEAVE = "weave"
    NOISE = "noise"
    BRAKE_THEN_SURGE = "brake, then surge"
    MOVE = "move to a neighbouring cell"
    BRAKE_AND_MOVE = "brake, and move to a neighbouring cell"
    JUMP = "move far away"
    RECORD = "own all cells around"


@define
class _Victim:
    attack: Attack
    until_s: float
    from_s: float
    incarnation: int
    goal: Cell | None = None


@define
class Forger:
    """Core of the forger."""

    scenario: Scenario
    rng: random.Random
    share: float
    """Probability per SENSE that an attack on its vehicle begins."""
    commands: int = 0
    """Number of forged commands."""
    attacks: list[tuple[float, str, str]] = field(factory=list)
    """Road time, vehicle and kind of each attack."""
    wakeup_s: None = None
    _victims: dict[Name, _Victim] = field(factory=dict)

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Answer each SENSE for a victim."""
        del now_s
        match event:
            case Started():
                yield Listen(SENSE)
            case Arrived(_, _, Sense() as sense) if not sense.left:
                yield from self._on_sense(sense)
            case _:
                pass

    def _on_sense(self, sense: Sense) -> Iterator[Effect]:
        rng, victim = self.rng, self._victims.get(sense.vehicle)
        if victim is None or sense.t_s > victim.until_s:
            self._victims.pop(sense.vehicle, None)
            if rng.random() > self.share:
                return
            victim = _Victim(
                attack=rng.choice(list(Attack)),
                until_s=sense.t_s + rng.uniform(*LASTS_S),
                from_s=sense.t_s,
                incarnation=sense.record.incarnation + rng.choice((0, 0, 1)),
            )
            self._victims[sense.vehicle] = victim
            self.attacks.append((sense.t_s, sense.vehicle, victim.attack.value))
        victim.incarnation = max(victim.incarnation, sense.record.incarnation)
        command = self._forged(sense, victim)
        self.commands += 1
        for _ in range(COPIES):
            yield Send(COMMAND, command, {"vehicle": sense.vehicle})

    def _forged(self, sense: Sense, victim: _Victim) -> Command:
        rng, attack = self.rng, victim.attack
        goal, record = sense.hold_cell, replace(sense.record, incarnation=victim.incarnation)
        if attack in (Attack.MOVE, Attack.BRAKE_AND_MOVE, Attack.JUMP, Attack.RECORD):
            if victim.goal is None or rng.random() < 0.02:
                reach = 4 if attack is Attack.JUMP else 1
                victim.goal = (
                    goal[0] + rng.randint(-reach, reach),
                    min(max(goal[1] + rng.randint(-1, 1), 0), self.scenario.road.lanes - 1),
                )
            goal = victim.goal
        if attack is not Attack.RECORD:
            pass
        elif self.scenario.formation.traits.has_formations:
            record = replace(record, joined=tuple(rng.sample(range(200), 3)))
        else:
            known = sense.record.promised or Ballot(1, Name("c9"), 1, 0)
            own = known._replace(term=known.term + 1)
            cells = tuple((goal[0] + n, lane) for n in range(-2, 3) for lane in range(3))
            opens = rng.random() < 0.5
            transfer = PendingTransfer(own, sense.record.owned, cells, (sense.vehicle,))
            if opens and sense.record.transfer is not None:
                transfer = PendingTransfer(sense.record.transfer.ballot, open=True)
            record = replace(record, promised=own, transfer=transfer)
        origin = sense.hold_cell if rng.random() < 0.9 else goal
        jerks = array("f")
        for tick in range(TICKS):
            jerks.extend(self._jerk(victim, sense, tick))
        return Command(
            vehicle=sense.vehicle,
            record=record,
            tick=sense.tick,
            hold_cell=goal,
            motion=CurrentMotion(origin, sense.tick + rng.randint(0, 50), rng.choice((0, 38))),
            jerks=jerks.tobytes() if rng.random() < 0.97 else b"",
        )

    def _jerk(self, victim: _Victim, sense: Sense, tick: int) -> tuple[float, float]:
        rng, across = self.rng, 0.0
        if victim.goal is not None:
            across = 4.0 * (victim.goal[1] - sense.hold_cell[1]) * (1.0 if tick < 8 else -0.5)
        match victim.attack:
            case Attack.BRAKE:
                return -15.0, 0.0
            case Attack.SURGE:
                return 15.0, 0.0
            case Attack.LEFT:
                return 0.0, 8.0
            case Attack.RIGHT:
                return 0.0, -8.0
            case Attack.WEAVE:
                return 0.0, 8.0 if (sense.tick + tick) // 7 % 2 else -8.0
            case Attack.NOISE:
                return rng.gauss(0.0, 30.0), rng.gauss(0.0, 15.0)
            case Attack.BRAKE_THEN_SURGE:
                return (-15.0 if sense.t_s - victim.from_s < 2.5 else 15.0), 0.0
            case Attack.BRAKE_AND_MOVE:
                return -12.0, across
            case _:
                return rng.uniform(-3.0, 3.0), across


@define
class ForgedRun(SimulatedRun):
    """A simulated run with a forger, or with agents for another scenario."""

    forger: Forger | None = None
    mistaken: Callable[[Name], Scenario] | None = None
    """Returns the scenario of a vehicle's agent; None: that of the run."""

    def _drive(self, network: SimulatedNetwork, bridge: BridgeCore, progress: RunProgress) -> None:
        if self.forger is not None:
            network.add("forger", self.forger, self.scenario.network.realm)
        super()._drive(network, bridge, progress)

    def _make_agent(self, vehicle: Name) -> AgentCore:
        if self.mistaken is None:
            return super()._make_agent(vehicle)
        return AgentCore(vehicle, self._incarnations.__next__, self.mistaken(vehicle))
