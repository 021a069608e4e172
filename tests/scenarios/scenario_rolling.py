"""Scenarios of the rolling operation: vehicles own cells, and short ballots transfer them.

| command | what it does |
|---|---|
| `vehicle A at 3,0 wants 1, owns 4,0 2,0` | it owns these cells beside its own |
| `vehicle A at 3,0 from 2,0 wants 1, owns 2,0` | it is still on its way into its cell |
| `stream L1 term 1` | a leader that has just taken over |
| `L1 transfers A>3,1 with B` | a new ballot: A moves to 3,1; the roster is A and B |
| `L1 transfers A>3,1 claiming 3,1` | the same of a faulty leader that claims that A owns 3,1 |
| `L1 collects promises` | in short: all get the PREPARE, and are heard |
| `L1 brings its plan to A B` | in short: they get the PLAN |
| `A B hear each other` | in short |
| `A gets PREPARE 1/L1/1/1 late` | its COMMAND, with which that is to be noted, is under way |
| `COMMAND of A arrives` | the one that was under way |
| `L1 forgets A` | the census shows that A has left |

After each command no cell has two owners, and every vehicle owns the cells that it occupies.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from attrs import define, field

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.launch.fault_search.checks.cell_ownership import CellOwnership
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Command, Heartbeat, Name, VehicleState
from scenarios.scenario_leaders import RESEND_S, Mail, post
from scenarios.scenario_road import ROLLING, SLOT_S, Agent, Vehicle
from scenarios.scenario_runner import Runner
from scenarios.scenario_text import CollisionError, ScenarioError, cell_of, written
from support.states import changed

Lines = Iterator[str]


@define(eq=False)
class StreamLeader:
    """A leader with one ballot under way; the scenario plans for it."""

    name: str
    term: int
    states: dict[Name, VehicleState] = field(factory=dict)
    transfer: CellTransfer | None = None
    claims: tuple[Cell, ...] = ()
    """Cells that it wrongly takes as owned by the mover."""
    ballots: int = 0
    gone: frozenset[Name] = frozenset()
    """Vehicles that have left the road."""

    def begin(self, mover: Name, target: Cell, others: tuple[Name, ...], now_s: float) -> None:
        """Begin a ballot over a mover and others."""
        self.ballots += 1
        roster = tuple(sorted({mover, *others}))
        self.transfer = CellTransfer(
            ballot=Ballot(self.term, Name(self.name), 1, self.ballots),
            roster=roster,
            moves={mover: (self.states[mover].hold_cell, target)},
            t0_s=0.0,
            slot_s=SLOT_S,
            resend_s=RESEND_S,
            due_s=now_s,
            gone=self.gone,
        )

    def send(self, mail: Mail, now_s: float) -> Lines:
        if self.transfer is not None:
            for vehicle, message in self.transfer.outgoing(now_s):
                yield post(mail, message, vehicle)

    def hear(self, state: VehicleState, now_s: float) -> Lines:
        transfer = self.transfer
        if self.claims and transfer is not None and state.vehicle in transfer.moves:
            state = changed(state, owned=tuple(sorted({*state.record.owned, *self.claims})))
        self.states[state.vehicle] = state
        if transfer is None:
            return
        before = transfer.phase
        transfer.on_state(state, self.states, now_s)
        if transfer.phase is not before:
            yield self.about()

    def about(self) -> str:
        transfer = self.transfer
        if transfer is None:
            return f"{self.name} has no ballot"
        why = f": {transfer.reason}" if transfer.phase is BallotPhase.ABORTED else ""
        return f"{self.name} {transfer.phase.value} {written(transfer.ballot)}{why}"


class RollingRunner(Runner):
    """The world of a scenario of the rolling operation."""

    def __init__(self, *rules: object) -> None:
        """Begin with an empty road; other rules plant a bug."""
        super().__init__(*rules)  # type: ignore[arg-type]
        self.streams: dict[str, StreamLeader] = {}
        self._late: dict[str, Command] = {}
        self._wrong: list[str] = []
        self._estates = CellOwnership(self._report)
        mine: tuple[tuple[str, Callable[..., Lines | None]], ...] = (
            (r"vehicle (\w+) at (\S+)(?: from (\S+))? wants (\d+)(?:, owns (.+))?", self._enter),
            (r"stream (\w+) term (\d+)", self._stream),
            (r"(\w+) transfers (\w+)>(\S+)(?: with ([\w ]+))?(?: claiming (.+))?", self._transfer),
            (r"(\w+) brings its plan to (.+)", self._issues),
            (r"([\w ]+) hear each other", self._hear_each_other),
            (r"(\w+) gets (PREPARE|PLAN) (\S+) late", self._gets_late),
            (r"COMMAND of (\w+) arrives", self._late_command),
            (r"(\w+) forgets (\w+)", self._forgets),
        )
        self._grammar = (*mine, *self._grammar)

    def _report(self, kind: str, t_s: float, vehicles: list[str], text: str) -> None:
        del t_s
        self._wrong.append(f"{kind}: {' '.join(vehicles)}: {text}")

    def _check_cells(self, command: str) -> None:
        super()._check_cells(command)
        for name, vehicle in self.vehicles.items():
            controller = vehicle.road.controller
            body = frozenset(vehicle.occupied)
            self._estates.update(
                0.0, name, controller.record.owned, controller.record.transfer, body
            )
        if self._wrong:
            wrong, self._wrong = self._wrong, []
            raise CollisionError(f"{command}: {wrong[0]}")

    # --- the road -----------------------------------------------------------------------------

    def _enter(
        self, name: str, cell: str, origin: str | None, lane: str, owned: str | None
    ) -> None:
        vehicle = Vehicle.entering(name, cell_of(cell), int(lane), self.t_s, ROLLING)
        for each in (owned or "").split():
            vehicle.road.controller.store.assign_cell(cell_of(each))
        if origin is not None:
            vehicle.at = cell_of(origin)
        self.vehicles[name] = vehicle
        self._put_in_charge(name, vehicle)

    def _leaves(self, name: str) -> None:
        super()._leaves(name)
        self._estates.leave(name)

    def _gets_late(self, name: str, kind: str, ballot: str) -> None:
        agent = self._agent_named(name)
        agent.get(self._mail[kind, ballot, agent.vehicle.name], self.tick, noted=False)
        if agent.command is not None:
            self._late[name] = agent.command

    def _late_command(self, name: str) -> Lines:
        controller = self._agent_named(name).vehicle.road.controller
        command = self._late.pop(name)
        noted = controller.store_requests(command)
        controller.accept_command(command)
        yield "something is noted" if noted else "nothing is noted"

    def _agent_named(self, name: str) -> Agent:
        process = self.processes[name]
        if not isinstance(process, Agent):
            raise ScenarioError(f"{name} is no agent")
        return process

    # --- leaders ------------------------------------------------------------------------------

    def _stream(self, name: str, term: str) -> None:
        self.streams[name] = StreamLeader(name, int(term))

    def _forgets(self, name: str, vehicle: str) -> None:
        leader = self.streams[name]
        del leader.states[Name(vehicle)]
        leader.gone |= {Name(vehicle)}

    def _transfer(
        self, name: str, mover: str, target: str, others: str | None, claimed: str | None
    ) -> None:
        leader = self.streams[name]
        for each in (mover, *(others or "").split()):
            list(leader.hear(self._shown_by(each), self.t_s))
        leader.claims = tuple(map(cell_of, (claimed or "").split()))
        names = tuple(map(Name, (others or "").split()))
        leader.begin(Name(mover), cell_of(target), names, self.t_s)

    def _sends(self, name: str) -> Lines:
        if name in self.streams:
            yield from self.streams[name].send(self._mail, self.t_s)
        else:
            yield from super()._sends(name)

    def _collects(self, name: str) -> Lines:
        leader, transfer = self.streams[name], self._transfer_of(name)
        list(leader.send(self._mail, self.t_s))
        lines: list[str] = []
        for vehicle in transfer.roster:
            self._deliver_to(vehicle, "PREPARE", transfer)
            lines += leader.hear(self._shown_by(vehicle), self.t_s)
        yield f"{' '.join(sorted(transfer.promises)) or 'none'} promise {written(transfer.ballot)}"
        yield from lines

    def _issues(self, name: str, vehicles: str) -> Lines:
        leader, transfer = self.streams[name], self._transfer_of(name)
        list(leader.send(self._mail, self.t_s))
        for vehicle in vehicles.split():
            self._deliver_to(vehicle, "PLAN", transfer)
            state = self._shown_by(vehicle)
            accepts = state.accepted and state.record.promised == transfer.ballot
            yield f"{vehicle} accepts" if accepts else f"{vehicle} does not accept"

    def _deliver_to(self, vehicle: str, kind: str, transfer: CellTransfer) -> None:
        message = self._mail.get((kind, written(transfer.ballot), vehicle))
        if message is not None:
            self._in_charge_of(vehicle).get(message, self.tick)

    def _hear_each_other(self, names: str) -> Lines:
        for name in names.split():
            for other in names.split():
                if other != name:
                    yield from self._hear(name, self._shown_by(other))

    def _hear(self, name: str, what: VehicleState | Heartbeat | None) -> Lines:
        if name in self.streams and isinstance(what, VehicleState):
            yield from self.streams[name].hear(what, self.t_s)
        else:
            yield from super()._hear(name, what)

    def _show(self, name: str) -> Lines:
        yield from [self.streams[name].about()] if name in self.streams else super()._show(name)

    def _transfer_of(self, name: str) -> CellTransfer:
        transfer = self.streams[name].transfer
        if transfer is None:
            raise ScenarioError(f"{name} has no ballot")
        return transfer

    def _shown_by(self, name: str) -> VehicleState:
        """Return what a process shows, or the process in charge of a vehicle of this name."""
        process = self._in_charge_of(name) if name in self.vehicles else self.processes[name]
        if process.shown is None:
            raise ScenarioError(f"{name} has shown nothing")
        return process.shown


def is_rolling(stem: str) -> bool:
    """Tell whether a scenario of this name is one of the rolling operation."""
    return re.match("rolling_", stem) is not None
