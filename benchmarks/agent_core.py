"""CPU time of an agent per tick without the network: `python benchmarks/agent_core.py [--json]`.

Formations drive from the entrance to the end of the road and sort their lanes, in a closed loop
with the real bodies and motion controllers and without disturbances. Each vehicle has its own node
and agent host, as in a separate process, and receives bytes as from the transport. CPU time of this
thread, including garbage collection:

    total      from the bytes of a SENSE to the bytes of the COMMAND and STATE that answer it
    tracking   `Driver.drive`, a part of the total
    rest       the difference: decode, decide, encode
    states     processing the states of other vehicles; not in the total

CPU caches are warmer here than in a process that wakes up once per tick.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, cast

from attrs import define, field

from laneweave.agents.core import AgentCore
from laneweave.agents.driving.driver import Drive, TrackingDriver
from laneweave.agents.host import AgentHost
from laneweave.coordinator.formations.formation_planner import LONGEST_DEADLINE_S
from laneweave.coordinator.formations.roster import start_time_s, steps_left
from laneweave.coordinator.formations.sorting import SortingTask, sort_lanes
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import territory
from laneweave.protocol.runtime.node import Node, Started, read_message
from laneweave.protocol.runtime.transport import Received
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import Ballot, Command, Name, Plan, Prepare, Sense
from laneweave.protocol.wire.topics import PLAN, PREPARE, SENSE, Keys, Quality, matches_any
from laneweave.sim_bridge.bodies.overlaps_and_gaps import OtherBody, Pose, Size, pose_of
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from laneweave.sim_bridge.world_interface import show_bodies

FORMATIONS = 3
VEHICLES = 6
PLAN_TICK = 50
REPEATS = 5
KEYS = Keys("bench")
SHIFT = (1, 2, 0)
"""Preferred lane of the vehicles in each lane, so that all have to move."""


@define
class CpuTimer:
    """Accumulated CPU time of an activity."""

    spent_ns: int = 0

    def call(self, work: Callable[..., Any], *args: object, **named: object) -> Any:  # noqa: ANN401
        """Call a function and add its CPU time."""
        began_ns = time.thread_time_ns()
        result = work(*args, **named)
        self.spent_ns += time.thread_time_ns() - began_ns
        return result


class TimedDriver(TrackingDriver):
    """The real driver with measured `drive`."""

    def __init__(self, scenario: Scenario, limits: Vehicle, timer: CpuTimer) -> None:
        """Create a driver that adds its CPU time to a timer."""
        super().__init__(scenario, limits)
        self._timer = timer

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Track the reference."""
        drive: Drive = self._timer.call(super().drive, sense, moving=moving)
        return drive


class Outbox:
    """A transport that records sent messages and subscriptions."""

    def __init__(self) -> None:
        """Start without messages and subscriptions."""
        self.sent: list[tuple[str, bytes]] = []
        self.expressions: set[str] = set()

    def publish(self, key: str, payload: bytes, quality: Quality) -> None:
        """Record a message."""
        del quality
        self.sent.append((key, payload))

    def subscribe(self, key_expression: str) -> None:
        """Record a subscription."""
        self.expressions.add(key_expression)

    def unsubscribe(self, key_expression: str) -> None:
        """Remove a subscription."""
        self.expressions.discard(key_expression)

    def announce(self, key: str) -> None:
        """Do nothing."""

    withdraw = watch = serve = announce

    def answer(self, token: int, payload: bytes, *, ok: bool, encoding: str = "") -> None:
        """Do nothing."""

    def decline(self, token: int) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


@define
class BodyStore:
    """A world that stores the states of bodies, and a record that discards everything."""

    at: dict[str, State] = field(factory=dict)

    def place(self, vehicle: str, state: State) -> None:
        """Set the state of a vehicle."""
        self.at[vehicle] = state

    def add(self, vehicle: str, state: State, vehicle_type: str = "car") -> None:
        """Add a vehicle."""
        del vehicle_type
        self.at[vehicle] = state

    def resize(self, vehicle: str, size: Size) -> None:
        """Do nothing."""

    def step(self) -> None:
        """Do nothing."""

    def positions(self) -> dict[str, Pose]:
        """Return the pose of each vehicle."""
        return {vehicle: pose_of(state) for vehicle, state in self.at.items()}

    def collisions(self) -> list[tuple[str, str]]:
        """Return no collisions."""
        return []

    def others(self) -> tuple[OtherBody, ...]:
        """Return no bodies."""
        return ()

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle."""
        del self.at[vehicle]

    def on_positions(self, t_s: float, vehicles: object, **measured: object) -> None:
        """Discard the measurements."""


@define
class Rig:
    """A vehicle with the node and the messages of its agent."""

    vehicle: RoadVehicle
    node: Node
    outbox: Outbox

    def take(self) -> list[tuple[str, bytes]]:
        """Return the messages that were sent since the last call."""
        sent, self.outbox.sent = self.outbox.sent, []
        return sent


@define
class Road:
    """Formations in a closed loop with their agents."""

    scenario: Scenario
    rigs: dict[Name, Rig] = field(factory=dict)
    tick: int = 0
    world: BodyStore = field(factory=BodyStore)
    total: CpuTimer = field(factory=CpuTimer)
    tracking: CpuTimer = field(factory=CpuTimer)
    states: CpuTimer = field(factory=CpuTimer)
    senses: list[tuple[str, bytes]] = field(factory=list)
    answers: list[tuple[str, bytes]] = field(factory=list)
    moving: int = 0
    """Number of vehicle ticks in which the vehicle moves."""

    def __attrs_post_init__(self) -> None:
        """Place the vehicles in interlaced cells of the first blocks, and start their agents."""
        lattice = self.scenario.lattice
        numbers = count(1)
        for block in range(FORMATIONS):
            cells = [
                cell for cell in sorted(lattice.block_cells(block)) if lattice.interlaced(cell)
            ]
            for cell in cells[:VEHICLES]:
                name = Name(f"v{next(numbers):04d}")
                arrival = Arrival(name, cell[1], SHIFT[cell[1]], 0.0)
                vehicle = RoadVehicle.entering(Admission(arrival, cell, 0.0), 0.0, self.scenario)
                self.rigs[name] = self._rig(vehicle)

    def _rig(self, vehicle: RoadVehicle) -> Rig:
        incarnations, outbox = count(1), Outbox()
        host = AgentHost(
            vehicle.name,
            lambda name: AgentCore(
                name,
                incarnations.__next__,
                self.scenario,
                lambda scenario, limits: TimedDriver(scenario, limits, self.tracking),
            ),
            next(incarnations),
            self.scenario.runtime,
            [vehicle.name],
        )
        node = Node(host, outbox, KEYS, lambda _: None, Name("bench"))
        node.dispatch(Started(), 0.0)
        return Rig(vehicle, node, outbox)

    def drive(self) -> None:
        """Drive until the first formation leaves the road."""
        lattice = self.scenario.lattice
        end_s = lattice.passing_time_s(0, self.scenario.road.length_m)
        while self.tick * self.scenario.runtime.tick_s < end_s:
            self._step()
            if self.tick == PLAN_TICK:
                for block in range(FORMATIONS):
                    self._sort(block)
        for name, rig in self.rigs.items():
            arrival = rig.vehicle.admission.arrival
            if rig.vehicle.controller.hold_cell[1] != arrival.preferred_lane:
                raise RuntimeError(f"{name} did not reach its lane")

    def _step(self) -> None:
        tick = self.tick
        for name, rig in self.rigs.items():
            self.senses.append((KEYS.key(SENSE, process=name, vehicle=name), self._sensed(rig)))
        now = self.senses[-len(self.rigs) :]
        nodes = [rig.node for rig in self.rigs.values()]
        self.total.call(_deliver, nodes, [Received(*each) for each in now])
        published = [sent for rig in self.rigs.values() for sent in self._handle_answers(rig)]
        for rig in self.rigs.values():
            received = [
                Received(*sent)
                for sent in published
                if matches_any(rig.outbox.expressions, sent[0])
            ]
            self.states.call(_deliver, [rig.node] * len(received), received)
        for rig in self.rigs.values():
            self.moving += rig.vehicle.controller.motion.end_tick > tick
            rig.vehicle.step(tick)
        self.tick = tick + 1
        self._update_sensors()

    def _sensed(self, rig: Rig) -> bytes:
        return encode(rig.vehicle.sense(self.tick, caretaker=False))

    def _handle_answers(self, rig: Rig) -> Iterator[tuple[str, bytes]]:
        """Pass the command to the motion controller; yield the state."""
        for key, payload in rig.take():
            self.answers.append((key, payload))
            message = decode(payload)
            if isinstance(message, Command):
                if not rig.vehicle.controller.accept_command(message):
                    raise RuntimeError(f"a command was refused at tick {self.tick}")
            else:
                yield key, payload

    def _update_sensors(self) -> None:
        """Update the sensors of all vehicles."""
        vehicles = {name: rig.vehicle for name, rig in self.rigs.items()}
        record = cast("RunRecord", self.world)
        t_s = self.tick * self.scenario.runtime.tick_s
        show_bodies(self.world, vehicles, self.scenario, record, t_s)

    def _sort(self, block: int) -> None:
        """Send PREPARE and PLAN to a formation, as its leader does."""
        plan = self._plan(block)
        members = [self.rigs[name] for name in plan.roster]
        prepare = Prepare(plan.ballot, plan.blocks, plan.roster)
        for topic, message in ((PREPARE, prepare), (PLAN, plan)):
            for rig in members:
                name = rig.vehicle.name
                key = KEYS.key(topic, process=name, vehicle=name)
                rig.node.deliver(Received(key, encode(message)), 0.0)
                for _, payload in rig.take():
                    answer = decode(payload)
                    if isinstance(answer, Command):
                        rig.vehicle.controller.store_requests(answer)
        # The controllers' confirmations come with the next tick.

    def _plan(self, block: int) -> Plan:
        scenario = self.scenario
        members = {
            name: rig.vehicle for name, rig in self.rigs.items() if rig.vehicle.formation == block
        }
        cells = {name: vehicle.controller.hold_cell for name, vehicle in members.items()}
        goal_lanes = {
            name: frozenset({each.admission.arrival.preferred_lane})
            for name, each in members.items()
        }
        start_s = start_time_s(cells.values(), self.tick * scenario.runtime.tick_s, scenario)
        task = SortingTask((block,), cells, goal_lanes, (), scenario, LONGEST_DEADLINE_S)
        moves = sort_lanes(task, scenario.formation.max_nodes, plan, time.monotonic).moves
        every = [move for each in moves.values() for move in each]
        slot_s = scenario.timing.cycles_s[0]
        if max(step for step, _, _ in every) >= steps_left(
            cells.values(), start_s, slot_s, scenario
        ):
            raise RuntimeError("the road is too short for the plan")
        return Plan(
            ballot=Ballot(1, Name("c1"), 1, block),
            blocks=(block,),
            roster=tuple(cells),
            incarnations={
                name: each.controller.record.incarnation for name, each in members.items()
            },
            start_cells=cells,
            moves=moves,
            t0_s=start_s,
            slot_s=slot_s,
            territory=tuple(sorted(territory(cells.values(), every))),
        )


def _deliver(nodes: list[Node], received: list[Received]) -> None:
    for node, each in zip(nodes, received, strict=True):
        node.deliver(each, 0.0)


def _each(work: Callable[[Any], object], items: list[Any]) -> None:
    for item in items:
        work(item)


def measured() -> dict[str, float]:
    """Return the figures of one simulation, in microseconds per vehicle and tick."""
    # As in processes of the fork server: loaded objects are not collected.
    gc.collect()
    gc.freeze()
    road = Road(Scenario(formation=FormationSettings(entry="interlaced", close="columns")))
    road.drive()
    reading, writing = CpuTimer(), CpuTimer()
    reading.call(_each, lambda sense: read_message(KEYS, *sense), road.senses)
    writing.call(_each, encode, [decode(payload) for _, payload in road.answers])
    spent_ns = {
        "total_us": road.total.spent_ns,
        "tracking_us": road.tracking.spent_ns,
        "rest_us": road.total.spent_ns - road.tracking.spent_ns,
        "decode_us": reading.spent_ns,
        "encode_us": writing.spent_ns,
        "states_us": road.states.spent_ns,
    }
    ticks = len(road.senses)
    figures = {name: ns / 1e3 / ticks for name, ns in spent_ns.items()}
    figures["decide_us"] = figures["rest_us"] - figures["decode_us"] - figures["encode_us"]
    figures["moving_share"] = road.moving / ticks
    return figures


def main() -> None:
    """Measure and print the medians of several simulations."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="number of simulations")
    options = parser.parse_args()
    simulations = [measured() for _ in range(options.repeats)]
    medians = {
        name: round(statistics.median(one[name] for one in simulations), 3)
        for name in simulations[0]
    }
    if options.json:
        sys.stdout.write(json.dumps(medians) + "\n")
        return
    for name, value in medians.items():
        sys.stdout.write(f"{name:14}{value:9.2f}\n")


if __name__ == "__main__":
    main()
