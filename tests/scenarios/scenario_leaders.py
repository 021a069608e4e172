"""Coordinators of a scenario: leaders that have taken a formation over, and whole candidates."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterable, Iterator, Mapping

from laneweave.coordinator.ballots.ballot_round import FAILED, PROMISED, TIME
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.operation import FormationsOperation
from laneweave.coordinator.formations.roster import Formation
from laneweave.protocol.lattice import PlannedMove, territory
from laneweave.protocol.runtime import node
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.wire import messages, process_messages
from laneweave.protocol.wire.topics import CENSUS, HEARTBEAT, STATE, Topic
from scenarios.scenario_road import SCENARIO, SLOT_S, Vehicle
from scenarios.scenario_text import cell_of, shown, written
from support.paper import PAPER, closed_blocks

Mail = dict[tuple[str, str, str], messages.Prepare | messages.Plan]
"""What has been sent: (PREPARE or PLAN, ballot, vehicle) to message."""

RESEND_S = 0.2


class Leader:
    """A coordinator that has taken a formation over; the scenario plans for it."""

    def __init__(
        self, name: str, incarnation: int, term: int, formation: Formation, rules: RuleBook
    ) -> None:
        """Make a leader that has not begun to observe."""
        core = CoordinatorCore(messages.Name(name), incarnation, PAPER)
        core.election.term = term
        self.name, self.incarnation = name, incarnation
        self.control = FormationLeader(
            formation,
            core._new_ballot,
            random.Random(0),
            has_formed=lambda *_: True,
            resend_s=RESEND_S,
            rules=rules,
        )

    @property
    def controls(self) -> tuple[FormationLeader, ...]:
        return (self.control,)

    def wake(self, mail: Mail, now_s: float) -> Iterator[str]:
        """Let timers run; list what is sent."""
        yield from self._watched(lambda: self.control.take(TIME, now_s))
        for vehicle, message in self.control.outgoing(now_s):
            yield post(mail, message, vehicle)

    def hear(self, state: messages.VehicleState, mail: Mail, now_s: float) -> Iterator[str]:
        del mail
        yield from self._watched(lambda: self.control.on_state(state, now_s))

    def census(self, formation: Formation, now_s: float) -> Iterator[str]:
        yield from self._watched(lambda: self.control.on_members(formation, now_s))

    def plan(self, text: str, now_s: float) -> Iterator[str]:
        """Issue a plan that the scenario gives."""
        control = self.control
        if not control.take(PROMISED, now_s) or control.ballot is None:
            yield f"{self.name} cannot plan"
            return
        plan = written_plan(text, control, control.ballot)
        yield from self._watched(lambda: control.on_plan(plan, now_s))

    def fail(self, now_s: float) -> Iterator[str]:
        if not self.control.take(PROMISED, now_s):
            yield f"{self.name} cannot plan"
            return
        yield from self._watched(lambda: self.control.take(FAILED, now_s))

    def about(self) -> str:
        return about(self.name, self.control)

    def _watched(self, action: Callable[[], object]) -> Iterator[str]:
        before = self.about()
        action()
        if self.about() != before:
            yield self.about()


class Candidate:
    """A whole coordinator: election, census, blocks, joint ballots, and the real planner."""

    def __init__(self, name: str, incarnation: int, rules: RuleBook) -> None:
        """Make a process that has not started."""
        self.name, self.incarnation = name, incarnation
        self.core = CoordinatorCore(messages.Name(name), incarnation, SCENARIO, rules)
        self.heartbeat: messages.Heartbeat | None = None
        """The newest that it has sent."""
        self.jobs: list[node.Compute] = []
        """Plannings that it has ordered."""

    @property
    def leaders(self) -> dict[int, FormationLeader]:
        operation = self.core.operation
        assert isinstance(operation, FormationsOperation)
        return operation.leaders

    @property
    def controls(self) -> tuple[FormationLeader, ...]:
        return tuple(self.leaders.values())

    def wake(self, mail: Mail, now_s: float) -> Iterator[str]:
        """Let timers run; list what is sent."""
        yield from self.handle(node.Wakeup(), mail, now_s)

    def hear(
        self, what: messages.VehicleState | messages.Heartbeat, mail: Mail, now_s: float
    ) -> Iterator[str]:
        topic = HEARTBEAT if isinstance(what, messages.Heartbeat) else STATE
        yield from self.get(topic, what, mail, now_s)

    def census(self, on_road: Iterable[Vehicle], mail: Mail, now_s: float) -> Iterator[str]:
        entries = tuple(map(entry_of, on_road))
        census = messages.Census(now_s, entries, (), *closed_blocks(entries, now_s, SCENARIO))
        yield from self.get(CENSUS, census, mail, now_s)

    def get(self, topic: Topic, message: object, mail: Mail, now_s: float) -> Iterator[str]:
        yield from self.handle(node.Arrived(topic, {}, message), mail, now_s)

    def plan(self, mail: Mail, now_s: float) -> Iterator[str]:
        """Let the planner finish what was ordered first."""
        if not self.jobs:
            yield f"{self.name} cannot plan"
            return
        yield from self.handle(node.run_job(self.jobs.pop(0)), mail, now_s)

    def handle(self, event: node.Event, mail: Mail, now_s: float) -> Iterator[str]:
        """Pass an event to the core; yield its effects."""
        before = self.about()
        effects = self.core.handle(event, now_s)
        lines = [line for effect in effects if (line := self._effect(effect, mail))]
        # Log entries first, then changed leaders, then messages.
        yield from (line for line in lines if not line.startswith(("PREPARE", "PLAN")))
        yield from (line for line in self.about() if line not in before)
        yield from (line for line in lines if line.startswith(("PREPARE", "PLAN")))

    def about(self) -> list[str]:
        lines = []
        for control in self.leaders.values():
            numbers = " ".join(map(str, control.formation.numbers))
            line = f"{about(self.name, control)} for {numbers}"
            if control.plan is not None:
                line += f": {_moves_of(control.plan)}"
            lines.append(line)
        return lines

    def rank(self) -> str:
        """Write whether it leads."""
        election = self.core.election
        return f"{self.name} {'leads' if election.leading else 'waits'}, term {election.term}"

    def _effect(self, effect: node.Effect, mail: Mail) -> str:
        match effect:
            case node.Send(_, (messages.Prepare() | messages.Plan()) as message, parameters):
                return post(mail, message, str(parameters["vehicle"]))
            case node.Send(_, messages.Heartbeat() as heartbeat):
                self.heartbeat = heartbeat
            case node.Send(_, process_messages.LogEvent() as event):
                return self._log(event)
            case node.Compute():
                self.jobs.append(effect)
            case _:
                pass
        return ""

    def _log(self, event: process_messages.LogEvent) -> str:
        match event.kind:
            case "leader-elected":
                return f"{self.name} leads, term {event.data['term']}"
            case "leader-stepped-down":
                return f"{self.name} leads no more"
            case "formations-joined":
                joined = " ".join(map(str, event.data["formations"]))
                return f"{self.name} joins formations {joined}"
            case "lane-out-of-reach":
                return f"{self.name} cannot bring {' '.join(event.data['vehicles'])} to their lanes"
            case "plan-made":
                return ""
            case kind:
                return f"{self.name}: {kind}"


def entry_of(vehicle: Vehicle) -> messages.CensusEntry:
    """Return how the census lists a vehicle."""
    return messages.CensusEntry(vehicle.name, vehicle.entry_cell, vehicle.preferred_lane, 0.0)


def formation_of(vehicles: Mapping[str, Vehicle], roster: str) -> Formation:
    """Return the formation of some vehicles: the blocks in which they entered."""
    members = tuple(entry_of(vehicles[name]) for name in sorted(roster.split()))
    lattice = SCENARIO.lattice
    numbers = tuple(sorted({lattice.block_of(member.cell[0]) for member in members}))
    goals = tuple(frozenset({member.preferred_lane}) for member in members)
    return Formation(numbers, members, goals=goals)


def written_plan(text: str, control: FormationLeader, ballot: messages.Ballot) -> messages.Plan:
    """Return the plan that a scenario gives, as the leader would issue it.

    Args:
        text: `A@0>0,2 B@1>0,1`; with `A:0,1@0>0,2` the leader takes A to be in (0, 1), with
            `A@0>0,2 in blocks 0 1` it claims the blocks of these formations, and with
            `A@0>0,2 in blocks 0 for A B` it plans for A and B only.
        control: that has all promises.
        ballot: of the control.
    """
    text, _, roster = text.partition(" for ")
    members = frozenset(roster.split()) or frozenset(control.hold_cells)
    cells = {name: cell for name, cell in control.hold_cells.items() if name in members}
    moves: dict[messages.Name, tuple[PlannedMove, ...]] = dict.fromkeys(cells, ())
    at = dict(cells)
    text, _, blocks = text.partition(" in blocks ")
    for item in text.split():
        who, step, target = re.split("[@>]", item)
        name, _, believed = who.partition(":")
        mover = messages.Name(name)
        if believed:
            at[mover] = cells[mover] = cell_of(believed)
        moves[mover] = (*moves[mover], (int(step), at[mover], cell_of(target)))
        at[mover] = cell_of(target)
    every_move = [move for each in moves.values() for move in each]
    return messages.Plan(
        ballot=ballot,
        blocks=tuple(map(int, blocks.split())) or control.formation.numbers,
        roster=tuple(cells),
        incarnations={name: control.incarnations[name] for name in cells},
        start_cells=cells,
        moves=moves,
        t0_s=0.0,
        slot_s=SLOT_S,
        territory=tuple(sorted(territory(cells.values(), every_move))),
    )


def post(mail: Mail, message: messages.Prepare | messages.Plan, vehicle: str) -> str:
    """Put a message into the mail; return the line that says so."""
    kind = "PLAN" if isinstance(message, messages.Plan) else "PREPARE"
    mail[kind, written(message.ballot), vehicle] = message
    return f"{kind} {written(message.ballot)} to {vehicle}"


def about(name: str, control: FormationLeader) -> str:
    """Write the phase and the ballot of a leader."""
    ballot = f" {written(control.ballot)}" if control.ballot is not None else ""
    return f"{name} {control.phase.value}{ballot}"


def _moves_of(plan: messages.Plan) -> str:
    moves = [
        f"{name}@{step}>{shown(target)}"
        for name, moves in sorted(plan.moves.items())
        for step, _, target in moves
    ]
    return " ".join(moves) or "no vehicle moves"
