"""The checker: properties that every run must satisfy, regardless of faults.

The checker observes the bodies on the road and every sent message. It does not know the state
machines of the processes, and shares no code with them.

| kind | violation |
|---|---|
| `overlap` | two bodies (rectangles) overlap |
| `cell` | two vehicles occupy one cell: a hold cell, or any cell in the bounding box of a motion |
| `motion` | a body begins a motion that is not the next move in the published plan of its agent |
| `order` | a motion begins before an earlier interfering move of the plan has ended |
| `early` | a motion begins before its time on the clock of its vehicle |
| `interleaved` | two plans that share a vehicle have motions at the same time |
| `owner` | a cell has two owners (rolling operation, see `cell_ownership`) |
| `trespass` | a body is in a cell that its vehicle does not own (rolling operation) |
| `gate` | a motion begins before any vehicle of the plan has taken possession (rolling operation) |
| `refused` | a motion controller refuses a command that no correct agent sends |
| `closed` | a body is in a lane that has ended |
| `monotone` | a process revokes a promise, an acceptance, progress, a join, or a takeover |
| `leader` | a coordinator without a connection leads, or there is not one leader at the end |
| `busy` | a process starts computations without a pause |
| `crash` | a process fails |
| `stuck` | a vehicle is not in its preferred lane long after all faults have ended |

`claims` checks what messages claim.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator

from attrs import define

from laneweave.launch.fault_search.checks.cell_ownership import CellOwnership
from laneweave.launch.fault_search.checks.claims import Claims, required_before, short
from laneweave.launch.fault_search.checks.geometry import Body, Geometry, overlap_between
from laneweave.launch.fault_search.checks.violations import Violation
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import (
    Ballot,
    Name,
    Plan,
    Prepare,
    Sense,
    VehicleRecord,
    VehicleState,
)

MAX_VIOLATIONS = 20
"""Maximum number of violations recorded per run."""
CLOCK_TOLERANCE_S = 0.01
MAX_COMPUTATIONS = 15
"""Maximum number of computations that a process starts in a second."""


@define
class _PlanMotions:
    """Motions under one plan."""

    roster: frozenset[str]
    first_s: float
    """Time of the first motion."""
    active: int = 0
    """Number of motions in progress."""


class Checker:
    """Checker of one run; collects the violations."""

    def __init__(
        self,
        geometry: Geometry,
        on_event: Callable[[float, str], None] | None = None,
        *,
        rolling: bool = False,
    ) -> None:
        """Start with an empty road.

        Args:
            geometry: sizes of cells and bodies.
            on_event: callback for events on the road: time, text.
            rolling: whether vehicles own cells.
        """
        self._ownership = CellOwnership(self._report) if rolling else None
        self.violations: list[Violation] = []
        self.motions = 0
        self.plans: dict[Ballot, Plan] = {}
        """All plans sent so far."""
        self.claims = Claims(self._report, self.plans)
        self._geometry = geometry
        self._on_event = on_event
        self._bodies: dict[str, Body] = {}
        self._moving: dict[str, tuple[float, Cell, Ballot | None]] = {}
        """End time, target cell and ballot of the motion of each moving body."""
        self._checked_s = 0.0
        self._states: dict[str, dict[int, VehicleState]] = {}
        """Newest published state of each vehicle by process incarnation."""
        self._begun: dict[tuple[str, int, Cell], Ballot | None] = {}
        """Ballot of each published move: (vehicle, incarnation, target cell)."""
        self._done: dict[tuple[Ballot, str], int] = {}
        """Number of motions begun by each vehicle under each plan."""
        self._motions_of: dict[Ballot, _PlanMotions] = {}
        self._charge: dict[str, tuple[int, frozenset[int]]] = {}
        """Process in charge and reported joined formations of each motion controller."""
        self._computations: dict[str, list[float]] = {}
        """Start times of the newest computations of each process."""

    # --- the road -----------------------------------------------------------------------------

    def begin_road(self, t_s: float) -> None:
        """Record that another road begins, without vehicles."""
        self._log(t_s, "another road begins")
        self.claims.begin_road()
        for state in (self._bodies, self._moving, self._states, self._begun, self._done):
            state.clear()
        self._motions_of.clear()
        self._charge.clear()
        if self._ownership is not None:
            self._ownership = CellOwnership(self._report)

    def enter(self, t_s: float, vehicle: str, cell: Cell, block: int) -> None:
        """Record that a vehicle has entered the road or the lattice in a cell of a block.

        If it was on the lattice before, it belongs to another formation now.
        """
        self._log(t_s, f"{vehicle} enters in {cell}")
        self._states.pop(vehicle, None)
        if vehicle in self._charge:
            self._charge[vehicle] = self._charge[vehicle][0], frozenset()
        self.advance(t_s)
        self._bodies[vehicle] = Body.standing(self._geometry, cell, t_s)
        self._check_cells(t_s, vehicle)
        if self._ownership is None:
            self.claims.enter(t_s, vehicle, block)

    def store(self, t_s: float, vehicle: str, stored: VehicleRecord) -> None:
        """Record what a motion controller has stored."""
        self.claims.store(vehicle, stored)
        if self._ownership is not None:
            self._ownership.update(t_s, vehicle, stored.owned, stored.transfer)

    def leave(self, t_s: float, vehicle: str) -> None:
        """Record that a vehicle has left the road or the lattice."""
        self._log(t_s, f"{vehicle} leaves the road")
        self.advance(t_s)
        self._end_motion(vehicle)
        del self._bodies[vehicle]
        self.claims.leave(vehicle)
        if self._ownership is not None:
            self._ownership.leave(vehicle)

    def give_up_move(self, t_s: float, vehicle: str, cell: Cell) -> None:
        """Record that a vehicle holds the cell again in which its last move began."""
        self._log(t_s, f"{vehicle} holds {cell} again")
        self.advance(t_s)
        self._end_motion(vehicle)
        self._bodies[vehicle] = Body.standing(self._geometry, cell, t_s)
        self._check_cells(t_s, vehicle)

    def begin(
        self,
        t_s: float,
        vehicle: str,
        incarnation: int,
        move: tuple[Cell, Cell],
        lasts_s: float,
        clock_s: float = math.inf,
    ) -> None:
        """Record that process `incarnation` begins a motion from `move[0]` to `move[1]`.

        Args:
            t_s: virtual time.
            vehicle: name of the vehicle.
            incarnation: process that has sent the command.
            move: origin and target.
            lasts_s: duration of the motion.
            clock_s: latest road time that the vehicle's clock has shown.
        """
        self._log(t_s, f"{vehicle} moves from {move[0]} to {move[1]} in {lasts_s:.2f} s")
        self.advance(t_s)
        self.motions += 1
        body = self._bodies[vehicle]
        if vehicle in self._moving:
            self._report(
                "motion", t_s, [vehicle], f"changed its target to {move[1]} before arrival"
            )
            self._end_motion(vehicle)
        body.go(move[1], t_s, lasts_s)
        self._check_cells(t_s, vehicle)
        ballot = self._begun.get((vehicle, incarnation, move[1]))
        self._moving[vehicle] = body.done_s, move[1], ballot
        if ballot is None or ballot not in self.plans:
            self._report(
                "motion", t_s, [vehicle], f"moves from {move[0]} to {move[1]} without a plan"
            )
            return
        self._check_order(t_s, vehicle, ballot, move, clock_s)
        if self._ownership is None:
            self._check_serial(t_s, vehicle, ballot)
        else:
            self._ownership.move(t_s, vehicle, ballot)
            self._check_members(t_s, vehicle, ballot)

    def undrivable(self, t_s: float, vehicle: str, move: tuple[Cell, Cell]) -> None:
        """Report a move that the type of a vehicle does not drive."""
        text = f"its type does not drive from {move[0]} to {move[1]}"
        self._report("motion", t_s, [vehicle], text)

    def refused(self, t_s: float, vehicle: str, problem: str) -> None:
        """Report that a motion controller has refused a command (`command_checks.Problem`)."""
        self._report("refused", t_s, [vehicle], f"its command was refused: {problem}")

    def advance(self, t_s: float) -> None:
        """Check for overlaps since the last call, and close completed motions."""
        from_s = self._checked_s
        self._checked_s = t_s
        movers = [name for name, body in self._bodies.items() if body.end_s > from_s]
        if not movers or t_s <= from_s:
            return
        for vehicle in movers:
            body = self._bodies[vehicle]
            for other, other_body in self._bodies.items():
                if other == vehicle or (other < vehicle and other in movers):
                    continue
                at_s = overlap_between(body, other_body, from_s, t_s)
                if at_s is not None:
                    self._report("overlap", at_s, [vehicle, other], "their bodies overlap")
        for vehicle in [name for name, (end_s, _, _) in self._moving.items() if end_s <= t_s]:
            self._end_motion(vehicle)

    def stuck(self, t_s: float, vehicle: str, text: str) -> None:
        """Record that a vehicle has not arrived long after all faults have ended."""
        self._report("stuck", t_s, [vehicle], text)

    def beyond_end(self, t_s: float, vehicle: str, text: str) -> None:
        """Record that a body is in a lane that has ended."""
        self._report("closed", t_s, [vehicle], text)

    def crashed(self, t_s: float, process: str, error: str) -> None:
        """Record that a computation of a process has failed, which the process itself retries."""
        self._report("crash", t_s, [process], error)

    def _end_motion(self, vehicle: str) -> None:
        if vehicle in self._moving:
            _, cell, ballot = self._moving.pop(vehicle)
            self._bodies[vehicle].rest(cell)
            if self._ownership is not None:
                self._ownership.occupy(self._checked_s, vehicle, self._bodies[vehicle].cells)
            if ballot in self._motions_of:
                self._motions_of[ballot].active -= 1

    def _check_cells(self, t_s: float, vehicle: str) -> None:
        own = self._bodies[vehicle].cells
        if self._ownership is not None:
            self._ownership.occupy(t_s, vehicle, own)
        for other, body in self._bodies.items():
            if other != vehicle and not own.isdisjoint(body.cells):
                shared = sorted(own & body.cells)
                self._report("cell", t_s, [vehicle, other], f"both occupy {shared}")

    def _check_order(
        self, t_s: float, vehicle: str, ballot: Ballot, move: tuple[Cell, Cell], clock_s: float
    ) -> None:
        index, plan = self._done.get((ballot, vehicle), 0), self.plans[ballot]
        self._done[ballot, vehicle] = index + 1
        moves = plan.moves.get(Name(vehicle), ())
        if index >= len(moves) or moves[index][1:] != move:
            text = f"{move[0]} to {move[1]} is not move {index} of its plan {short(ballot)}"
            self._report("motion", t_s, [vehicle], text)
            return
        for other, moves_before in required_before(plan, vehicle, index):
            if other in self._bodies and self._finished(t_s, other, ballot) < moves_before:
                text = f"move {index} begins before move {moves_before - 1} of {other} has ended"
                self._report("order", t_s, [vehicle, other], text)
        due_s = plan.t0_s + moves[index][0] * plan.slot_s
        if clock_s < due_s - CLOCK_TOLERANCE_S:
            text = f"move {index} is due at {due_s:.1f} s, its clock showed {clock_s:.1f} s"
            self._report("early", t_s, [vehicle], text)

    def _finished(self, t_s: float, vehicle: str, ballot: Ballot) -> int:
        """Return how many motions a body has completed under a ballot."""
        end_s, _, under = self._moving.get(vehicle, (t_s, None, None))
        return self._done.get((ballot, vehicle), 0) - (under == ballot and end_s > t_s)

    def _check_serial(self, t_s: float, vehicle: str, ballot: Ballot) -> None:
        motions = self._motions_of.get(ballot)
        if motions is None:
            roster = frozenset(self.plans[ballot].roster)
            motions = self._motions_of[ballot] = _PlanMotions(roster, t_s)
        for other_ballot, other in self._motions_of.items():
            if other is motions or other.roster.isdisjoint(motions.roster):
                continue
            if other.active or other.first_s > motions.first_s:
                text = f"a motion of {short(ballot)} among those of {short(other_ballot)}"
                self._report("interleaved", t_s, [vehicle], text)
        motions.active += 1

    def _check_members(self, t_s: float, vehicle: str, ballot: Ballot) -> None:
        """Check that no vehicle of the roster executes an earlier plan (rolling operation)."""
        for other in self.plans[ballot].roster:
            _, _, earlier = self._moving.get(other, (0.0, (0, 0), ballot))
            if earlier is not None and earlier < ballot:
                text = f"a motion of {short(ballot)} during one of {other} of {short(earlier)}"
                self._report("interleaved", t_s, [vehicle, other], text)

    # --- the network --------------------------------------------------------------------------

    def sent(self, t_s: float, message: object) -> None:
        """Check a message when it is sent."""
        match message:
            case VehicleState():
                self._on_state(t_s, message)
            case Prepare():
                self.claims.on_prepare(t_s, message)
            case Plan():
                self._on_plan(t_s, message)
            case Sense():
                self._on_sense(t_s, message)

    def _on_plan(self, t_s: float, plan: Plan) -> None:
        known = self.plans.setdefault(plan.ballot, plan)
        if known is plan:
            self.claims.on_plan(t_s, plan)
        elif known != plan:
            self._report("two-plans", t_s, plan.roster, f"under ballot {short(plan.ballot)}")

    def _on_sense(self, t_s: float, sense: Sense) -> None:
        in_charge, joined = self._charge.get(sense.vehicle, (0, frozenset()))
        if sense.record.incarnation < in_charge:
            text = f"{sense.record.incarnation} is in charge after {in_charge}"
            self._report("monotone", t_s, [sense.vehicle], text)
        if not joined.issubset(sense.record.joined):
            text = f"its controller reports joined {sense.record.joined} after {sorted(joined)}"
            self._report("monotone", t_s, [sense.vehicle], text)
        if sense.record.incarnation != in_charge or len(joined) != len(sense.record.joined):
            self._charge[sense.vehicle] = sense.record.incarnation, frozenset(sense.record.joined)

    def _on_state(self, t_s: float, state: VehicleState) -> None:
        self._check_claims(t_s, state)
        if self.claims.is_earlier(state.vehicle, state.record.incarnation):
            return
        states = self._states.setdefault(state.vehicle, {})
        before = states.get(state.record.incarnation)
        states[state.record.incarnation] = state
        if before is None:
            # A new process inherits the joined formations of earlier processes.
            earlier = [one for number, one in states.items() if number < state.record.incarnation]
            joined = {number for one in earlier for number in one.record.joined}
        else:
            joined = set(before.record.joined)
        texts = []
        if not joined.issubset(state.record.joined):
            texts.append(f"it reports joined {state.record.joined} after {sorted(joined)}")
        if before is not None:
            texts += _revoked(before, state)
            if state.moving and before.hold_cell != state.hold_cell:
                key = (state.vehicle, state.record.incarnation, state.hold_cell)
                self._begun[key] = state.record.promised if state.accepted else None
        for text in texts:
            self._report("monotone", t_s, [state.vehicle], text)

    def _check_claims(self, t_s: float, state: VehicleState) -> None:
        name = state.vehicle
        self.claims.record(state)
        if name not in self._bodies:
            return
        end_s, cell, _ = self._moving.get(name, (t_s, None, None))
        if end_s > t_s:
            cell = None
        elif cell is None:
            (cell,) = self._bodies[name].cells
        finished = (
            0 if state.record.promised is None else self._finished(t_s, name, state.record.promised)
        )
        self.claims.on_state(t_s, state, finished, cell)

    def computes(self, t_s: float, process: str) -> None:
        """Record that a process starts a computation."""
        times = self._computations.setdefault(process, [])
        times.append(t_s)
        del times[:-MAX_COMPUTATIONS]
        if len(times) == MAX_COMPUTATIONS and times[0] > t_s - 1.0:
            text = f"{MAX_COMPUTATIONS} computations in {t_s - times[0]:.2f} s"
            self._report("busy", t_s, [process], text)

    def leads(self, t_s: float, process: str, text: str) -> None:
        """Record that a coordinator leads, or does not, against the rules."""
        self._report("leader", t_s, [process], text)

    def _log(self, t_s: float, event: str) -> None:
        if self._on_event is not None:
            self._on_event(t_s, f"*** {event}")

    def _report(self, kind: str, t_s: float, vehicles: Iterable[str], text: str) -> None:
        if len(self.violations) < MAX_VIOLATIONS:
            self.violations.append(Violation(kind, t_s, tuple(vehicles), text))


def _revoked(before: VehicleState, state: VehicleState) -> Iterator[str]:
    """Yield a description of each part of its previous state that a process has revoked."""
    if before.record.promised is None:
        return
    if state.record.promised is None or state.record.promised < before.record.promised:
        yield f"it promises {short(state.record.promised)} after {short(before.record.promised)}"
    elif state.record.promised == before.record.promised:
        if before.accepted and not state.accepted:
            yield f"it no longer accepts {short(state.record.promised)}"
        if state.completed < before.completed:
            yield f"it has completed {state.completed} moves after {before.completed}"
        if before.go and not state.go:
            yield f"its gate for {short(state.record.promised)} closed again"
