"""The checker: what must be true of every run, whatever happens to the network.

It sees the bodies on the road and what every process says when it says it. It knows nothing of the
machines inside the processes and shares no code with them.

| kind | what must not happen |
|---|---|
| `overlap` | two bodies, as rectangles, share a place at any time |
| `cell` | two vehicles occupy one cell: both ends of a motion and its corners, or the cell held |
| `motion` | a body begins a motion that is not its next move of the plan that its agent shows |
| `interleaved` | of two plans with a common vehicle, both have motions before one has ended |
| `owner` | a cell has two owners (rolling operation; `estates` tells who owns what) |
| `trespass` | a body is in a cell that its vehicle does not own (likewise) |
| `gate` | a body begins a motion of a plan by which nobody has taken possession (likewise) |
| `monotone` | somebody takes back what it has said: promise, acceptance, progress, joined, charge |
| `two-plans` | two different plans are sent under one ballot |
| `stuck` | a vehicle is not on its lane long after everything was whole again |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from attrs import define, frozen

from laneweave.launch.fault_search.bodies import Body, Geometry, overlap_between
from laneweave.launch.fault_search.cell_ownership import Estates
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Deed, Name, Plan, Sense, VehicleState

MOST_VIOLATIONS = 20
"""After so many a run has been told enough about."""


@frozen
class Violation:
    """Something that must not happen happened."""

    kind: str
    t_s: float
    """Virtual time."""
    vehicles: tuple[str, ...]
    text: str

    def __str__(self) -> str:
        """Return one readable line."""
        return f"{self.t_s:8.3f} s  {self.kind}: {', '.join(self.vehicles)}: {self.text}"


@define
class _Shown:
    """What one process has shown of one vehicle, at its most."""

    promised: Ballot | None = None
    accepted: bool = False
    completed: int = 0
    go: bool = False
    joined: frozenset[int] = frozenset()
    hold_cell: Cell | None = None


@define
class _Run:
    """The motions of one plan."""

    roster: frozenset[str]
    first_s: float
    under_way: int = 0


class Checker:
    """Watches one run; `violations` says what it saw."""

    def __init__(
        self,
        geometry: Geometry,
        note: Callable[[float, str], None] | None = None,
        *,
        rolling: bool = False,
    ) -> None:
        """Watch an empty road.

        Args:
            geometry: sizes of cells and bodies.
            note: is told of what happens on the road.
            rolling: whether vehicles own cells.
        """
        self._estates = Estates(self._tell) if rolling else None
        self.violations: list[Violation] = []
        self.motions = 0
        self.plans: dict[Ballot, Plan] = {}
        """Every plan that was sent."""
        self._geometry = geometry
        self._note = note
        self._bodies: dict[str, Body] = {}
        self._moving: dict[str, tuple[float, Cell, Ballot | None]] = {}
        """For each body in motion when it is over, where, and of which plan it is."""
        self._checked_s = 0.0
        self._shown: dict[str, dict[int, _Shown]] = {}
        """For each vehicle what each of its processes has shown."""
        self._begun: dict[tuple[str, int, Cell], Ballot | None] = {}
        """Ballots under which (vehicle, process) has shown that it moves to a cell."""
        self._done: dict[tuple[Ballot, str], int] = {}
        """How many motions of a plan each vehicle has begun."""
        self._runs: dict[Ballot, _Run] = {}
        self._charge: dict[str, tuple[int, frozenset[int]]] = {}
        """Attendant and joined formations that each motion controller has shown."""
        self._listeners: dict[type, Callable[[float, Any], None]] = {
            VehicleState: self._on_state,
            Plan: self._on_plan,
            Sense: self._on_sense,
        }

    # --- the road -----------------------------------------------------------------------------

    def enter(self, t_s: float, vehicle: str, cell: Cell) -> None:
        """A vehicle entered the road."""
        self._tell_of(t_s, f"{vehicle} enters in {cell}")
        self.advance(t_s)
        self._bodies[vehicle] = Body.standing(self._geometry, cell, t_s)
        self._check_cells(t_s, vehicle)

    def own(self, t_s: float, vehicle: str, estate: tuple[Cell, ...], deed: Deed | None) -> None:
        """A motion controller shows what its vehicle owns."""
        if self._estates is not None:
            self._estates.show(t_s, vehicle, estate, deed)

    def leave(self, t_s: float, vehicle: str) -> None:
        """A vehicle left the road."""
        self._tell_of(t_s, f"{vehicle} leaves the road")
        self.advance(t_s)
        self._end_motion(vehicle)
        del self._bodies[vehicle]
        if self._estates is not None:
            self._estates.leave(vehicle)

    def begin(
        self, t_s: float, vehicle: str, incarnation: int, way: tuple[Cell, Cell], lasts_s: float
    ) -> None:
        """A body began to move.

        Args:
            t_s: virtual time.
            vehicle: which.
            incarnation: of the process that commanded it.
            way: the cell in which the vehicle held, and that in which it will.
            lasts_s: how long it takes.
        """
        self._tell_of(t_s, f"{vehicle} moves from {way[0]} to {way[1]} in {lasts_s:.2f} s")
        self.advance(t_s)
        self.motions += 1
        body = self._bodies[vehicle]
        if vehicle in self._moving:
            self._tell("motion", t_s, [vehicle], f"turned off to {way[1]} before it had arrived")
            self._end_motion(vehicle)
        body.go(way[1], t_s, lasts_s)
        self._check_cells(t_s, vehicle)
        ballot = self._begun.get((vehicle, incarnation, way[1]))
        self._moving[vehicle] = body.done_s, way[1], ballot
        if ballot is None or ballot not in self.plans:
            self._tell("motion", t_s, [vehicle], f"moves from {way[0]} to {way[1]} without a plan")
            return
        self._check_order(t_s, vehicle, ballot, way)
        if self._estates is None:
            self._check_serial(t_s, vehicle, ballot)
        else:
            self._estates.move(t_s, vehicle, ballot)
            self._check_members(t_s, vehicle, ballot)

    def advance(self, t_s: float) -> None:
        """Look at all that moved since the last time: no two bodies overlapped."""
        from_s = self._checked_s
        self._checked_s = t_s
        movers = [name for name, body in self._bodies.items() if body.end_s > from_s]
        if not movers or t_s <= from_s:
            return
        for vehicle in movers:
            body = self._bodies[vehicle]
            for other, its in self._bodies.items():
                if other == vehicle or (other < vehicle and other in movers):
                    continue
                at_s = overlap_between(body, its, from_s, t_s)
                if at_s is not None:
                    self._tell("overlap", at_s, [vehicle, other], "their bodies overlap")
        for vehicle in [name for name, (end_s, _, _) in self._moving.items() if end_s <= t_s]:
            self._end_motion(vehicle)

    def stuck(self, t_s: float, vehicle: str, text: str) -> None:
        """A vehicle has not arrived, though nothing was in its way for long."""
        self._tell("stuck", t_s, [vehicle], text)

    def _end_motion(self, vehicle: str) -> None:
        if vehicle in self._moving:
            _, cell, ballot = self._moving.pop(vehicle)
            self._bodies[vehicle].rest(cell)
            if self._estates is not None:
                self._estates.occupy(self._checked_s, vehicle, self._bodies[vehicle].cells)
            if ballot in self._runs:
                self._runs[ballot].under_way -= 1

    def _check_cells(self, t_s: float, vehicle: str) -> None:
        mine = self._bodies[vehicle].cells
        if self._estates is not None:
            self._estates.occupy(t_s, vehicle, mine)
        for other, body in self._bodies.items():
            if other != vehicle and not mine.isdisjoint(body.cells):
                shared = sorted(mine & body.cells)
                self._tell("cell", t_s, [vehicle, other], f"both occupy {shared}")

    def _check_order(
        self, t_s: float, vehicle: str, ballot: Ballot, way: tuple[Cell, Cell]
    ) -> None:
        index = self._done.get((ballot, vehicle), 0)
        self._done[ballot, vehicle] = index + 1
        moves = self.plans[ballot].moves.get(Name(vehicle), ())
        if index >= len(moves) or moves[index][1:] != way:
            text = f"{way[0]} to {way[1]} is not move {index} of its plan {_short(ballot)}"
            self._tell("motion", t_s, [vehicle], text)

    def _check_serial(self, t_s: float, vehicle: str, ballot: Ballot) -> None:
        run = self._runs.get(ballot)
        if run is None:
            run = self._runs[ballot] = _Run(frozenset(self.plans[ballot].roster), t_s)
        for other, its in self._runs.items():
            if its is run or its.roster.isdisjoint(run.roster):
                continue
            if its.under_way or its.first_s > run.first_s:
                text = f"a motion of {_short(ballot)} amid those of {_short(other)}"
                self._tell("interleaved", t_s, [vehicle], text)
        run.under_way += 1

    def _check_members(self, t_s: float, vehicle: str, ballot: Ballot) -> None:
        """Rosters differ from plan to plan: look at those whom both plans concern."""
        for other in self.plans[ballot].roster:
            _, _, its = self._moving.get(other, (0.0, (0, 0), ballot))
            if its is not None and its < ballot:
                text = f"a motion of {_short(ballot)}, and {other} is in one of {_short(its)}"
                self._tell("interleaved", t_s, [vehicle, other], text)

    # --- the network --------------------------------------------------------------------------

    def sent(self, t_s: float, message: object) -> None:
        """A process says something."""
        listener = self._listeners.get(type(message))
        if listener is not None:
            listener(t_s, message)

    def _on_plan(self, t_s: float, plan: Plan) -> None:
        known = self.plans.setdefault(plan.ballot, plan)
        if known is not plan and known != plan:
            self._tell("two-plans", t_s, plan.roster, f"under ballot {_short(plan.ballot)}")

    def _on_sense(self, t_s: float, sense: Sense) -> None:
        attendant, joined = self._charge.get(sense.vehicle, (0, frozenset()))
        if sense.attendant < attendant:
            text = f"{sense.attendant} is in charge after {attendant}"
            self._tell("monotone", t_s, [sense.vehicle], text)
        if not joined.issubset(sense.joined):
            text = f"its controller has joined {sense.joined} after {sorted(joined)}"
            self._tell("monotone", t_s, [sense.vehicle], text)
        if sense.attendant != attendant or len(joined) != len(sense.joined):
            self._charge[sense.vehicle] = sense.attendant, frozenset(sense.joined)

    def _on_state(self, t_s: float, state: VehicleState) -> None:
        processes = self._shown.setdefault(state.vehicle, {})
        shown = processes.get(state.incarnation)
        if shown is None:
            shown = processes[state.incarnation] = _Shown()
            # What earlier processes had joined is joined for this one.
            earlier = [
                its.joined for number, its in processes.items() if number < state.incarnation
            ]
            shown.joined = frozenset().union(*earlier)
        for text in _taken_back(shown, state):
            self._tell("monotone", t_s, [state.vehicle], text)
        if state.moving and shown.hold_cell not in (None, state.hold_cell):
            key = (state.vehicle, state.incarnation, state.hold_cell)
            self._begun[key] = state.promised if state.accepted else None
        if state.promised != shown.promised:
            shown.completed, shown.go = 0, False
        shown.promised, shown.accepted = state.promised, state.accepted
        shown.completed, shown.go = state.completed, state.go
        shown.hold_cell = state.hold_cell
        if len(shown.joined) != len(state.joined):
            shown.joined = frozenset(state.joined)

    def _tell_of(self, t_s: float, event: str) -> None:
        if self._note is not None:
            self._note(t_s, f"*** {event}")

    def _tell(self, kind: str, t_s: float, vehicles: Iterable[str], text: str) -> None:
        if len(self.violations) < MOST_VIOLATIONS:
            self.violations.append(Violation(kind, t_s, tuple(vehicles), text))


def _taken_back(shown: _Shown, state: VehicleState) -> list[str]:
    """Return what a process says now that contradicts what it has said before."""
    texts = []
    if not shown.joined.issubset(state.joined):
        texts.append(f"it has joined {state.joined} after {sorted(shown.joined)}")
    if shown.promised is None:
        return texts
    if state.promised is None or state.promised < shown.promised:
        return [*texts, f"it promises {_short(state.promised)} after {_short(shown.promised)}"]
    if state.promised > shown.promised:
        return texts
    if shown.accepted and not state.accepted:
        texts.append(f"it has not accepted {_short(state.promised)} any more")
    if state.completed < shown.completed:
        texts.append(f"it has completed {state.completed} moves after {shown.completed}")
    if shown.go and not state.go:
        texts.append(f"its gate for {_short(state.promised)} closes again")
    return texts


def _short(ballot: Ballot | None) -> str:
    return "nothing" if ballot is None else ".".join(str(part) for part in ballot)
