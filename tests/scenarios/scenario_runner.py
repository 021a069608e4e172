"""Runs the commands of a scenario; `scenario_files` explains them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from attrs import frozen

from laneweave.coordinator.formations.leader import LEADER_RULES, FormationLeader
from laneweave.coordinator.formations.roster import Formation
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import PeerDown, PeerUp, Started
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.wire.messages import Heartbeat, Plan, VehicleState
from laneweave.protocol.wire.topics import COORDINATOR_ALIVE
from scenarios.scenario_leaders import Candidate, Leader, Mail, formation_of
from scenarios.scenario_road import TICK_S, Agent, CaretakerProcess, Process, Vehicle
from scenarios.scenario_text import (
    CollisionError,
    ScenarioError,
    cell_of,
    shown,
    state_text,
    written,
)

Lines = Iterator[str]


class Runner:
    """The world of one scenario."""

    def __init__(
        self, vehicle_rules: RuleBook = VEHICLE_RULES, leader_rules: RuleBook = LEADER_RULES
    ) -> None:
        """Begin with an empty road at time 0; other rules plant a bug."""
        self.tick = 0
        self.vehicles: dict[str, Vehicle] = {}
        self.processes: dict[str, Process] = {}
        self.leaders: dict[str, Leader] = {}
        self.candidates: dict[str, Candidate] = {}
        self._vehicle_rules = vehicle_rules
        self._leader_rules = leader_rules
        self._mail: Mail = {}
        self._noted: dict[str, VehicleState | Heartbeat] = {}
        self._grammar: tuple[tuple[str, Callable[..., Lines | None]], ...] = (
            (r"vehicle (\w+) at (\S+) wants (\d+)", self._vehicle),
            (r"agent (\w+) for (\w+)", self._agent),
            (r"caretaker (\w+) for (\w+)", self._caretaker),
            (r"leader (\w+) term (\d+) leads (.+)", self._leader),
            (r"candidate (\w+)", self._candidate),
            (r"clock ([\d.]+)", self._clock),
            (r"(\w+) sends", self._sends),
            (r"(\w+) gets (PREPARE|PLAN) (\S+)", self._gets),
            (r"(\w+) hears (\w+)", self._hears),
            (r"note (\w+) as (\w+)", self._note),
            (r"(\w+) sees (\w+) (appear|vanish)", self._sees),
            (r"(\w+) (loses|finds) the router", self._router),
            (r"(\w+) plans ?(.*)", self._plans),
            (r"(\w+) fails to plan", self._fails),
            (r"(\w+) census ?(.*)", self._census),
            (r"(\w+) collects promises", self._collects),
            (r"(\w+) brings (.+) into force", self._brings),
            (r"(\w+) ticks", self._ticks),
            (r"(\w+) senses", self._senses),
            (r"(\w+) commands", self._commands),
            (r"(\w+) arrives", self._arrives),
            (r"body of (\w+) arrives", self._body_arrives),
            (r"body of (\w+) falls back to (\S+)", self._body_falls_back),
            (r"(\w+) leaves", self._leaves),
            (r"(\w+) restarts", self._restarts),
            (r"show (\w+)", self._show),
        )

    @property
    def t_s(self) -> float:
        """Road time, which all clocks show."""
        return self.tick * TICK_S

    def run(self, command: str) -> Lines:
        """Execute a command; yield what happened.

        Raises:
            ScenarioError: the command is unknown, or names an unknown process or vehicle.
            CollisionError: two vehicles occupy one cell.
        """
        for pattern, action in self._grammar:
            match = re.fullmatch(pattern, command)
            if match:
                try:
                    yield from action(*match.groups()) or ()
                except KeyError as error:
                    raise ScenarioError(f"{command}: there is no {error}") from error
                self._check_cells(command)
                return
        raise ScenarioError(f"no such command: {command}")

    def _check_cells(self, command: str) -> None:
        owner: dict[Cell, str] = {}
        for name, vehicle in self.vehicles.items():
            for cell in vehicle.occupied:
                if cell in owner:
                    raise CollisionError(f"{command}: {name} and {owner[cell]} both occupy {cell}")
                owner[cell] = name

    # --- vehicles and processes ---------------------------------------------------------------

    def _vehicle(self, name: str, cell: str, lane: str) -> None:
        self.vehicles[name] = Vehicle.entering(name, cell_of(cell), int(lane), self.t_s)
        self._put_in_charge(name, self.vehicles[name])

    def _agent(self, name: str, vehicle: str) -> None:
        self.processes[name] = Agent(name, self.vehicles[vehicle], self._vehicle_rules)

    def _caretaker(self, name: str, vehicle: str) -> None:
        self.processes[name] = CaretakerProcess(name, self.vehicles[vehicle], self.tick)

    def _put_in_charge(self, name: str, vehicle: Vehicle) -> None:
        agent = Agent(name, vehicle, self._vehicle_rules)
        self.processes[name] = agent
        # In the first tick it claims the vehicle, in the second one it senses that it has it.
        for _ in range(2):
            list(self._ticks(name))
        if not agent.in_charge:
            raise ScenarioError(f"{name} is not put in charge")

    def _leader(self, name: str, term: str, roster: str) -> None:
        self._start_leader(name, 1, int(term), formation_of(self.vehicles, roster))

    def _start_leader(self, name: str, incarnation: int, term: int, formation: Formation) -> None:
        leader = Leader(name, incarnation, term, formation, self._leader_rules)
        leader.control.begin(self.t_s)
        self.leaders[name] = leader

    def _candidate(self, name: str, incarnation: int = 1) -> None:
        self.candidates[name] = Candidate(name, incarnation, self._leader_rules)
        list(self.candidates[name].handle(Started(), self._mail, self.t_s))

    def _restarts(self, name: str) -> None:
        if name in self.processes:
            self._put_in_charge(name, self.processes[name].vehicle)
        elif name in self.leaders:
            old = self.leaders[name]
            self._start_leader(name, old.incarnation + 1, 1, old.control.formation)
        else:
            self._candidate(name, self.candidates[name].incarnation + 1)

    def _leaves(self, name: str) -> None:
        del self.vehicles[name]

    # --- coordinators -------------------------------------------------------------------------

    def _clock(self, t_s: str) -> None:
        tick = round(float(t_s) / TICK_S)
        if tick < self.tick:
            raise ScenarioError(f"it is {self.t_s:g} s already")
        self.tick = tick

    def _sends(self, name: str) -> Lines:
        yield from self._coordinator(name).wake(self._mail, self.t_s)

    def _coordinator(self, name: str) -> Leader | Candidate:
        return self.leaders[name] if name in self.leaders else self.candidates[name]

    def _plans(self, name: str, text: str) -> Lines:
        if name in self.leaders:
            yield from self.leaders[name].plan(text, self.t_s)
        else:
            yield from self.candidates[name].plan(self._mail, self.t_s)

    def _fails(self, name: str) -> Lines:
        yield from self.leaders[name].fail(self.t_s)

    def _census(self, name: str, roster: str) -> Lines:
        if name in self.leaders:
            yield from self.leaders[name].census(formation_of(self.vehicles, roster), self.t_s)
        else:
            on_road = [self.vehicles[each] for each in roster.split()]
            yield from self.candidates[name].census(on_road, self._mail, self.t_s)

    def _sees(self, name: str, whom: str, what: str) -> Lines:
        token = {"coordinator": whom, "incarnation": str(self.candidates[whom].incarnation)}
        kind = PeerUp if what == "appear" else PeerDown
        event = kind(COORDINATOR_ALIVE, token)
        yield from self.candidates[name].handle(event, self._mail, self.t_s)

    def _router(self, name: str, what: str) -> Lines:
        event = LinkUp() if what == "finds" else LinkDown()
        yield from self.candidates[name].handle(event, self._mail, self.t_s)

    def _collects(self, name: str) -> Lines:
        coordinator = self._coordinator(name)
        for control in coordinator.controls:
            list(self._hear_all(name, control))
        list(self._sends(name))
        for control in coordinator.controls:
            for process in self._members(control):
                self._deliver("PREPARE", control, process)
                if len(control.formation.numbers) > 1:
                    # The first tick asks the controller to remember, the second one confirms it.
                    list(self._ticks(process.name))
                    list(self._ticks(process.name))
            list(self._hear_all(name, control))
            promises = sorted(control.promises)
            yield f"{' '.join(promises) or 'none'} promise {_ballot(control)}"

    def _brings(self, name: str, text: str) -> Lines:
        coordinator = self._coordinator(name)
        planned = list(self._plans(name, text))
        if f"{name} cannot plan" in planned:
            yield from planned
            return
        if name in self.candidates:
            yield from (line for line in planned if not line.startswith("PLAN"))
        list(self._sends(name))
        for control in coordinator.controls:
            members = self._members(control)
            for process in members:
                self._deliver("PLAN", control, process)
            for process in members:
                for other in members:
                    if other is not process and other.shown is not None:
                        process.hear(other.shown)
            list(self._hear_all(name, control))
            yield f"{' '.join(sorted(control.accepted)) or 'none'} accept {_ballot(control)}"

    def _hear_all(self, name: str, control: FormationLeader) -> Lines:
        for process in self._members(control):
            yield from self._hear(name, process.shown)

    def _members(self, control: FormationLeader) -> list[Process]:
        return [self._in_charge_of(each) for each in control.formation.roster]

    def _deliver(self, kind: str, control: FormationLeader, process: Process) -> None:
        message = self._mail.get((kind, _ballot(control), process.vehicle.name))
        if message is not None:
            process.get(message, self.tick)

    def _in_charge_of(self, vehicle: str) -> Process:
        in_charge = self.vehicles[vehicle].road.controller.record.incarnation
        for process in self.processes.values():
            if process.vehicle.name == vehicle and process.incarnation == in_charge:
                return process
        raise ScenarioError(f"no process is in charge of {vehicle}")

    # --- mail and states ----------------------------------------------------------------------

    def _gets(self, name: str, kind: str, ballot: str) -> Lines:
        process = self.processes[name]
        message = self._mail.get((kind, ballot, process.vehicle.name))
        if message is None:
            yield "it was never sent"
            return
        before, promised = process.shown, _promised(process)
        process.get(message, self.tick)
        if isinstance(message, Plan):
            accepted = process.shown is not before
            yield f"{name} accepts" if accepted else f"{name} ignores it"
        else:
            yield f"{name} promises" if _promised(process) != promised else f"{name} ignores it"

    def _hears(self, name: str, whom: str) -> Lines:
        what: VehicleState | Heartbeat | None
        if whom in self._noted:
            what = self._noted[whom]
        elif whom in self.processes:
            what = self.processes[whom].shown
        else:
            what = self.candidates[whom].heartbeat
        yield from self._hear(name, what)

    def _hear(self, name: str, what: VehicleState | Heartbeat | None) -> Lines:
        if what is None:
            yield "there is nothing to hear"
        elif name in self.candidates:
            yield from self.candidates[name].hear(what, self._mail, self.t_s)
        elif isinstance(what, Heartbeat):
            raise ScenarioError(f"{name} does not listen to heartbeats")
        elif name in self.leaders:
            yield from self.leaders[name].hear(what, self._mail, self.t_s)
        else:
            process = self.processes[name]
            before = process.execution is not None and process.execution.go
            process.hear(what)
            if not before and process.execution is not None and process.execution.go:
                yield f"{name}'s gate is open"

    def _note(self, name: str, label: str) -> None:
        if name in self.candidates:
            what: VehicleState | Heartbeat | None = self.candidates[name].heartbeat
        else:
            what = self.processes[name].shown
        if what is None:
            raise ScenarioError(f"{name} has shown nothing yet")
        self._noted[label] = what

    # --- ticks --------------------------------------------------------------------------------

    def _ticks(self, name: str) -> Lines:
        process = self.processes[name]
        self.tick = max(self.tick, process.vehicle.road.controller.command_tick + 1)
        yield from self._senses(name)
        if isinstance(process, Agent) and process.command is not None:
            yield from self._commands(name)

    def _senses(self, name: str) -> Lines:
        process = self.processes[name]
        self.tick = max(self.tick, process.tick + 1)
        before = _Snapshot.of(process.execution)
        process.sense(self.tick)
        execution = process.execution
        if isinstance(process, Agent) and process.command is None:
            yield f"{name} is silent"
        elif process.in_charge and execution is not None:
            yield from self._decided(name, before, execution)

    @staticmethod
    def _decided(name: str, before: _Snapshot, execution: PlanExecution) -> Lines:
        at = before.hold_cell if before.execution is execution else execution.hold_cell
        moves = execution.hold_cell != at
        arrived = before.execution is execution and before.moving
        arrived = arrived and (moves or not execution.moving)
        if arrived:
            yield f"{name} holds {shown(at)}, completed {execution.completed}"
        if execution.go and not before.go:
            yield f"{name}'s gate is open"
        if moves:
            yield f"{name} moves {shown(at)} > {shown(execution.hold_cell)}"
        elif not arrived:
            yield f"{name} goes on" if execution.moving else f"{name} holds {shown(at)}"

    def _commands(self, name: str) -> Lines:
        process = self.processes[name]
        if not isinstance(process, Agent) or process.command is None:
            raise ScenarioError(f"{name} has commanded nothing")
        controller = process.vehicle.road.controller
        before = controller.record.incarnation
        if not controller.accept_command(process.command):
            yield f"{name} is refused"
        elif controller.record.incarnation != before:
            yield f"{name} takes charge"
            for other in self.processes.values():
                if isinstance(other, CaretakerProcess) and other.vehicle is process.vehicle:
                    other.give_way()

    def _arrives(self, name: str) -> Lines:
        vehicle = self.processes[name].vehicle
        vehicle.at = vehicle.road.controller.hold_cell
        yield from self._ticks(name)

    def _body_arrives(self, name: str) -> None:
        self.vehicles[name].at = self.vehicles[name].road.controller.hold_cell

    def _body_falls_back(self, name: str, cell: str) -> None:
        self.vehicles[name].at = cell_of(cell)

    # --- inspection ---------------------------------------------------------------------------

    def _show(self, name: str) -> Lines:
        if name in self.leaders:
            yield self.leaders[name].about()
        elif name in self.candidates:
            yield self.candidates[name].rank()
            yield from self.candidates[name].about()
        else:
            state = self.processes[name].shown
            yield state_text(name, state) if state is not None else f"{name} has shown nothing"


@frozen
class _Snapshot:
    """State of a vehicle before a tick."""

    execution: PlanExecution | None
    hold_cell: Cell
    moving: bool
    go: bool

    @classmethod
    def of(cls, execution: PlanExecution | None) -> _Snapshot:
        if execution is None:
            return cls(None, (0, 0), moving=False, go=False)
        return cls(execution, execution.hold_cell, execution.moving, execution.go)


def _ballot(control: FormationLeader) -> str:
    return written(control.ballot) if control.ballot else "nothing"


def _promised(process: Process) -> object:
    return process.execution.promised if process.execution is not None else None
