"""Plays stories: hand-written schedules of messages for the real protocol cores.

A story is a text file. `#` begins a comment; every other line is a command, and the lines below it
that begin with `=>` are exactly what must happen. Nothing happens by itself: a message that is not
delivered is lost, one that is delivered twice is duplicated, one delivered later is late.

| command | what it does |
|---|---|
| `vehicle A at 0,1 wants 2` | a vehicle holds cell (column 0, lane 1) and prefers lane 2 |
| `leader L1 term 1 leads A B` | a leader of the formation of A and B has taken over |
| `clock 4.0` | it is that late; step n of every plan may begin at n seconds |
| `L1 sends` | the leader's timers run; what it sends is listed and goes into the mail |
| `A gets PREPARE 1/L1/1/1` | mail to A arrives: now, late, or again (`PLAN` likewise) |
| `L1 hears A`, `B hears A` | the state that A shows now arrives |
| `note A as x`, then `B hears x` | the state that A showed then arrives late |
| `L1 plans A@0>0,2 B@1>0,1` | planning succeeds: A moves in step 0 to (0, 2), B in step 1 |
| `L1 fails to plan` | planning fails |
| `L1 census A B` | the census shows who is on the road |
| `A ticks` | A decides whether to move |
| `A arrives` | A's motion ends |
| `A restarts`, `L1 restarts` | the process is another one now; the motion controller goes on |
| `show A`, `show L1` | what it knows |

A ballot is written term/coordinator/incarnation/seq. Whatever the story says, no cell may ever be
occupied by two vehicles.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from attrs import define, frozen

from laneweave.agents.execution import PlanExecution
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.formation import Formation
from laneweave.coordinator.leader import FormationControl
from laneweave.protocol.lattice import Cell, Move, territory
from laneweave.protocol.messages import Ballot, CensusEntry, Name, Plan, Prepare, VehicleState
from laneweave.protocol.scenario import Scenario

SLOT_S = 1.0
OVERDUE_S = 1.5
RESEND_S = 0.2


class StoryError(AssertionError):
    """A story went otherwise, or cannot be read."""


@define(eq=False)
class Vehicle:
    """A vehicle: the protocol state of its agent process, and its body."""

    execution: PlanExecution
    preferred_lane: int
    came_from: Cell
    """Where the motion under way began."""

    def state(self, t_s: float) -> VehicleState:
        execution = self.execution
        return VehicleState(
            vehicle=execution.vehicle,
            incarnation=execution.incarnation,
            formation=0,
            promised=execution.promised,
            accepted=execution.plan is not None,
            ready=execution.ready,
            completed=execution.completed,
            hold_cell=execution.hold_cell,
            moving=execution.moving,
            go=execution.go,
            done=execution.done,
            overdue=execution.overdue(t_s),
            s_m=0.0,
            y_m=0.0,
            speed_mps=0.0,
            t_s=t_s,
        )

    def occupied(self) -> set[Cell]:
        """Return both cells of a motion, and the corners if it is diagonal."""
        if not self.execution.moving:
            return {self.execution.hold_cell}
        columns, lanes = zip(self.came_from, self.execution.hold_cell, strict=True)
        return {(column, lane) for column in columns for lane in lanes}


@define(eq=False)
class Leader:
    """A coordinator that leads."""

    core: CoordinatorCore
    incarnation: int
    control: FormationControl


@frozen
class Line:
    """One command of a story with what it must lead to."""

    number: int
    command: str
    expected: tuple[str, ...]


def read_story(path: Path) -> list[Line]:
    """Read a story's lines.

    Raises:
        StoryError: an expectation has no command above it.
    """
    lines: list[Line] = []
    for number, raw in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        text = raw.split("#")[0].strip()
        if text.startswith("=>"):
            if not lines:
                raise StoryError(f"{path.name}:{number}: `=>` without a command")
            last = lines.pop()
            lines.append(Line(last.number, last.command, (*last.expected, text[2:].strip())))
        elif text:
            lines.append(Line(number, text, ()))
    return lines


def check_story(path: Path) -> None:
    """Play a story.

    Raises:
        StoryError: it went otherwise; the message names the line.
    """
    player = Player()
    for line in read_story(path):
        happened = tuple(player.play(line.command))
        if happened != line.expected:
            shown = "".join(f"\n  => {each}" for each in happened) or "\n  nothing"
            raise StoryError(f"{path.name}:{line.number}: {line.command}{shown}")


class Player:
    """The world of one story."""

    def __init__(self) -> None:
        """Begin with an empty road at time 0."""
        self.t_s = 0.0
        self.vehicles: dict[str, Vehicle] = {}
        self.leaders: dict[str, Leader] = {}
        self._mail: dict[tuple[str, str, str], Prepare | Plan] = {}
        self._noted: dict[str, VehicleState] = {}
        self._grammar: tuple[tuple[str, Callable[..., Iterator[str]]], ...] = (
            (r"vehicle (\w+) at (\S+) wants (\d+)", self._vehicle),
            (r"leader (\w+) term (\d+) leads (.+)", self._leader),
            (r"clock ([\d.]+)", self._clock),
            (r"(\w+) sends", self._sends),
            (r"(\w+) gets (PREPARE|PLAN) (\S+)", self._gets),
            (r"(\w+) hears (\w+)", self._hears),
            (r"note (\w+) as (\w+)", self._note),
            (r"(\w+) plans (.+)", self._plans),
            (r"(\w+) fails to plan", self._fails),
            (r"(\w+) census (.+)", self._census),
            (r"(\w+) ticks", self._ticks),
            (r"(\w+) arrives", self._arrives),
            (r"(\w+) restarts", self._restarts),
            (r"show (\w+)", self._show),
        )

    def play(self, command: str) -> Iterator[str]:
        """Carry a command out and tell what happened.

        Raises:
            StoryError: the command is not known, or two vehicles occupy one cell.
        """
        for pattern, action in self._grammar:
            match = re.fullmatch(pattern, command)
            if match:
                yield from action(*match.groups())
                self._check_cells(command)
                return
        raise StoryError(f"no such command: {command}")

    def _check_cells(self, command: str) -> None:
        owner: dict[Cell, str] = {}
        for name, vehicle in self.vehicles.items():
            for cell in vehicle.occupied():
                if cell in owner:
                    raise StoryError(f"{command}: {name} and {owner[cell]} both occupy {cell}")
                owner[cell] = name

    # --- who there is -------------------------------------------------------------------------

    def _vehicle(self, name: str, cell: str, lane: str) -> Iterator[str]:
        execution = PlanExecution(Name(name), 1, _cell(cell), OVERDUE_S)
        self.vehicles[name] = Vehicle(execution, int(lane), _cell(cell))
        yield from ()

    def _leader(self, name: str, term: str, roster: str) -> Iterator[str]:
        yield from self._take_over(name, 1, int(term), self._formation(roster))

    def _take_over(
        self, name: str, incarnation: int, term: int, formation: Formation
    ) -> Iterator[str]:
        core = CoordinatorCore(Name(name), incarnation, Scenario())
        core.election.term = term
        rng = random.Random(0)
        control = FormationControl(formation, core._new_ballot, rng, RESEND_S)
        self.leaders[name] = Leader(core, incarnation, control)
        control.begin(self.t_s)
        yield from ()

    def _formation(self, roster: str) -> Formation:
        return Formation(
            0,
            tuple(
                CensusEntry(
                    Name(name),
                    self.vehicles[name].execution.hold_cell,
                    self.vehicles[name].preferred_lane,
                    0.0,
                )
                for name in sorted(roster.split())
            ),
        )

    def _restarts(self, name: str) -> Iterator[str]:
        if name in self.vehicles:
            vehicle = self.vehicles[name]
            old = vehicle.execution
            vehicle.execution = PlanExecution(
                old.vehicle, old.incarnation + 1, old.hold_cell, OVERDUE_S, moving=old.moving
            )
        else:
            leader = self.leaders[name]
            yield from self._take_over(name, leader.incarnation + 1, 0, leader.control.formation)

    # --- leaders ------------------------------------------------------------------------------

    def _clock(self, t_s: str) -> Iterator[str]:
        self.t_s = float(t_s)
        yield from ()

    def _sends(self, name: str) -> Iterator[str]:
        control = self.leaders[name].control
        yield from self._watching(name, lambda: control.on_time(self.t_s))
        for vehicle, message in control.outgoing(self.t_s):
            kind = "PLAN" if isinstance(message, Plan) else "PREPARE"
            ballot = _written(message.ballot)
            self._mail[kind, ballot, vehicle] = message
            yield f"{kind} {ballot} to {vehicle}"

    def _plans(self, name: str, text: str) -> Iterator[str]:
        control = self.leaders[name].control
        if not control.take_planning_order(self.t_s) or control.ballot is None:
            yield f"{name} cannot plan"
            return
        cells = control.hold_cells
        moves: dict[Name, tuple[Move, ...]] = dict.fromkeys(cells, ())
        at = dict(cells)
        for item in text.split():
            vehicle, step, target = re.split("[@>]", item)
            mover = Name(vehicle)
            moves[mover] = (*moves[mover], (int(step), at[mover], _cell(target)))
            at[mover] = _cell(target)
        every_move = [move for each in moves.values() for move in each]
        plan = Plan(
            ballot=control.ballot,
            formation=0,
            roster=tuple(cells),
            incarnations=control.incarnations,
            start_cells=cells,
            moves=moves,
            t0_s=0.0,
            slot_s=SLOT_S,
            territory=tuple(sorted(territory(cells.values(), every_move))),
        )
        yield from self._watching(name, lambda: control.on_plan(plan, self.t_s))

    def _fails(self, name: str) -> Iterator[str]:
        control = self.leaders[name].control
        if not control.take_planning_order(self.t_s):
            yield f"{name} cannot plan"
            return
        yield from self._watching(name, lambda: control.on_planning_failed(self.t_s))

    def _census(self, name: str, roster: str) -> Iterator[str]:
        control = self.leaders[name].control
        formation = self._formation(roster)
        yield from self._watching(name, lambda: control.on_members(formation, self.t_s))

    def _watching(self, name: str, action: Callable[[], None]) -> Iterator[str]:
        """Tell what a leader is about when an action has changed it."""
        before = self._about(name)
        action()
        if self._about(name) != before:
            yield self._about(name)

    def _about(self, name: str) -> str:
        control = self.leaders[name].control
        ballot = f" {_written(control.ballot)}" if control.ballot is not None else ""
        return f"{name} {control.phase.value}{ballot}"

    # --- vehicles -----------------------------------------------------------------------------

    def _gets(self, name: str, kind: str, ballot: str) -> Iterator[str]:
        execution = self.vehicles[name].execution
        message = self._mail.get((kind, ballot, name))
        if message is None:
            raise StoryError(f"nobody has sent {kind} {ballot} to {name}")
        if isinstance(message, Plan):
            yield f"{name} accepts" if execution.on_plan(message) else f"{name} ignores it"
            return
        before = execution.promised
        execution.on_prepare(message)
        yield f"{name} promises" if execution.promised != before else f"{name} ignores it"

    def _hears(self, name: str, whom: str) -> Iterator[str]:
        state = self._noted.get(whom)
        if state is None:
            state = self.vehicles[whom].state(self.t_s)
        if name in self.leaders:
            control = self.leaders[name].control
            yield from self._watching(name, lambda: control.on_state(state, self.t_s))
        else:
            execution = self.vehicles[name].execution
            before = execution.go
            execution.on_state(state)
            if execution.go and not before:
                yield f"{name}'s gate is open"

    def _note(self, name: str, label: str) -> Iterator[str]:
        self._noted[label] = self.vehicles[name].state(self.t_s)
        yield from ()

    def _ticks(self, name: str) -> Iterator[str]:
        vehicle = self.vehicles[name]
        execution = vehicle.execution
        gate, origin = execution.go, execution.hold_cell
        move = execution.next_move(self.t_s)
        if execution.go and not gate:
            yield f"{name}'s gate is open"
        if move is None:
            yield f"{name} goes on" if execution.moving else f"{name} holds {_shown(origin)}"
            return
        vehicle.came_from = origin
        execution.begin(move)
        yield f"{name} moves {_shown(origin)} > {_shown(execution.hold_cell)}"

    def _arrives(self, name: str) -> Iterator[str]:
        execution = self.vehicles[name].execution
        execution.end_motion()
        yield f"{name} holds {_shown(execution.hold_cell)}, completed {execution.completed}"

    # --- looking at things --------------------------------------------------------------------

    def _show(self, name: str) -> Iterator[str]:
        if name in self.leaders:
            yield self._about(name)
            return
        execution = self.vehicles[name].execution
        verb = "moves to" if execution.moving else "holds"
        parts = [f"{name} {verb} {_shown(execution.hold_cell)}"]
        if execution.promised is not None:
            has = "accepted" if execution.plan is not None else "promised"
            parts.append(f"{has} {_written(execution.promised)}")
        if execution.plan is not None:
            parts.append(f"completed {execution.completed}")
        for word, holds in (
            ("ready", execution.ready),
            ("gate open", execution.go),
            ("done", execution.done),
            ("overdue", execution.overdue(self.t_s)),
        ):
            if holds:
                parts.append(word)
        yield ", ".join(parts)


def _cell(text: str) -> Cell:
    column, lane = text.split(",")
    return int(column), int(lane)


def _shown(cell: Cell) -> str:
    return f"{cell[0]},{cell[1]}"


def _written(ballot: Ballot) -> str:
    return "/".join(str(part) for part in ballot)
