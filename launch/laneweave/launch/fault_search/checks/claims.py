"""Checks of what processes claim in messages, when they send them; part of the checker.

A collision needs a wrong claim and a vehicle that acts on it at the wrong time. The claims
themselves must be true at any time, so they show a violated rule much sooner.

| kind | violation |
|---|---|
| `false` | a state claims what its motion controller or body does not confirm |
| `gate` | a start gate is reported open before all members have reported that they are ready |
| `basis` | a plan starts from cells or names processes that no promise has reported |
| `roster` | a plan lacks a vehicle that entered in its blocks |
| `two-plans` | two different rosters or plans are sent under one ballot |
| `adoption` | a leader adopts a plan that a member does not execute |
| `busy` | a leader does not pause after failed planning |
| `harmful` | a vehicle accepts or begins a plan that it must refuse |
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from attrs import define, field

from laneweave.launch.fault_search.checks.violations import Report, once
from laneweave.launch.fault_search.events.forgeries import Harm
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import (
    Ballot,
    Name,
    Plan,
    Prepare,
    VehicleRecord,
    VehicleState,
)

PAUSE_S = 0.9
"""Minimum time between two attempts to plan under one ballot."""
LOWEST = Ballot(-1, Name(""), 0, 0)
States = Mapping[Name, VehicleState]


@define
class Claims:
    """Checker of claims in a run."""

    report: Report = field(converter=once)
    plans: dict[Ballot, Plan]
    """All plans sent so far; shared with the checker."""
    harmful: dict[Ballot, Harm] = field(factory=dict)
    """Plans that were changed on their way."""
    _stored: dict[str, VehicleRecord] = field(factory=dict)
    """Newest content of each motion controller."""
    _in_charge: set[tuple[str, int]] = field(factory=set)
    """(vehicle, incarnation) of each process that has been in charge."""
    _acceptances: set[tuple[str, int, Ballot]] = field(factory=set)
    """(vehicle, incarnation, ballot) of each stored acceptance."""
    _holdings: set[tuple[str, Ballot | None, tuple[Cell, ...]]] = field(factory=set)
    """(vehicle, promise, owned cells) stored at the same time."""
    _promises: set[tuple[str, int, Ballot, Cell, tuple[int, ...]]] = field(factory=set)
    """(vehicle, incarnation, ballot, hold cell, joined blocks) of each promise."""
    _accepted: dict[Ballot, set[str]] = field(factory=dict)
    """Vehicles that have reported that they have accepted each ballot."""
    _planned_s: dict[Ballot, float] = field(factory=dict)
    """Time at which planning last began under each ballot."""
    _ready: dict[Ballot, set[str]] = field(factory=dict)
    """Vehicles that have reported under each ballot that they are ready."""
    _rosters: dict[Ballot, Prepare] = field(factory=dict)
    _blocks: dict[str, int] = field(factory=dict)
    """Block in which each vehicle on the road entered."""
    _earlier: set[tuple[str, int]] = field(factory=set)
    """(vehicle, incarnation) of each process that has acted on an earlier road."""

    # --- the road -----------------------------------------------------------------------------

    def begin_road(self) -> None:
        """Begin another road: processes that have acted on this one do not belong to it."""
        self._earlier |= self._in_charge
        self._stored.clear()
        self._blocks.clear()

    def is_earlier(self, vehicle: str, incarnation: int) -> bool:
        """Return whether a process has acted on an earlier road."""
        return (vehicle, incarnation) in self._earlier

    def enter(self, t_s: float, vehicle: str, block: int) -> None:
        """Record that a vehicle has entered in a block, which no plan may contain."""
        self._blocks[vehicle] = block
        for ballot, plan in self.plans.items():
            harmful = ballot in self.harmful
            if block in plan.blocks and not harmful and self._is_current(plan):
                self._tell("roster", t_s, vehicle, f"enters in a block of {short(ballot)}")

    def leave(self, vehicle: str) -> None:
        """Record that a vehicle has left the road."""
        self._blocks.pop(vehicle, None)

    def store(self, vehicle: str, stored: VehicleRecord) -> None:
        """Record what a motion controller has stored."""
        if self._stored.get(vehicle) == stored:
            return
        self._stored[vehicle] = stored
        self._in_charge.add((vehicle, stored.incarnation))
        self._holdings.add((vehicle, stored.promised, stored.owned))
        if stored.accepted is not None:
            self._acceptances.add((vehicle, stored.incarnation, stored.accepted))

    # --- messages -----------------------------------------------------------------------------

    def record(self, state: VehicleState) -> None:
        """Record what leaders and other vehicles may conclude from a state."""
        name, ballot = state.vehicle, state.record.promised
        if ballot is None:
            return
        about = name, state.record.incarnation, ballot, state.hold_cell
        self._promises.add((*about, () if state.record.owned else state.record.joined))
        if state.accepted:
            self._accepted.setdefault(ballot, set()).add(name)
            if state.ready:
                self._ready.setdefault(ballot, set()).add(name)

    def on_state(
        self, t_s: float, state: VehicleState, finished: int, cell_at_rest: Cell | None
    ) -> None:
        """Check the recorded state of a vehicle on the road.

        Args:
            t_s: virtual time.
            state: the state, as sent.
            finished: number of motions that the body has completed under the promised ballot.
            cell_at_rest: cell in which the body rests; None while it moves.
        """
        name, ballot = state.vehicle, state.record.promised
        stored = self._stored.get(name)
        if stored is None or self.is_earlier(name, state.record.incarnation):
            return
        if (name, state.record.incarnation) not in self._in_charge:
            self._false(t_s, state, "its process has never been in charge")
        if not set(state.record.joined) <= set(stored.joined):
            self._false(t_s, state, f"joined {state.record.joined}, but stored are {stored.joined}")
        if stored.owned and state.attended and state.record.incarnation == stored.incarnation:
            binding = stored.promised or LOWEST
            if (ballot or LOWEST) < binding:
                self._false(t_s, state, f"promises {short(ballot)} below {short(binding)}")
        if state.record.owned and (name, ballot, state.record.owned) not in self._holdings:
            self._false(t_s, state, f"owns {list(state.record.owned)} with {short(ballot)}")
        if state.record.incarnation == stored.incarnation and not state.moving:
            if cell_at_rest is None:
                self._false(t_s, state, "holds, but its body moves")
            elif cell_at_rest != state.hold_cell:
                self._false(t_s, state, f"holds {state.hold_cell}, but rests in {cell_at_rest}")
        if state.accepted and ballot is not None:
            self._on_acceptance(t_s, state, ballot, finished)

    def _on_acceptance(
        self, t_s: float, state: VehicleState, ballot: Ballot, finished: int
    ) -> None:
        name, plan, harm = state.vehicle, self.plans.get(ballot), self.harmful.get(ballot)
        if (name, state.record.incarnation, ballot) not in self._acceptances:
            self._false(t_s, state, f"accepted {short(ballot)}, which is not stored")
        if state.completed > finished:
            self._false(t_s, state, f"completed {state.completed} moves, its body {finished}")
        if plan is not None and not state.attended and plan.moves.get(name):
            self._false(t_s, state, f"accepts moves in {short(ballot)} without an agent")
        if harm is not None and (name in harm.refusing or state.go):
            self._tell("harmful", t_s, name, f"executes {short(ballot)}: {harm.text}")
        if state.go and plan is not None:
            missing = set(plan.roster) - self._ready.get(ballot, set()) - {name}
            if missing:
                text = f"{short(ballot)} opens before {' '.join(sorted(missing))}"
                self._tell("gate", t_s, name, text)

    def on_adoption(
        self, t_s: float, ballot: Ballot, roster: Iterable[Name], known: States
    ) -> None:
        """Check that all members have accepted the ballot, also as far as its new leader knows.

        Args:
            t_s: virtual time.
            ballot: adopted ballot.
            roster: members of the formation.
            known: newest state of each member that the leader has received.
        """
        for name in roster:
            state = known.get(name)
            if (
                name not in self._accepted.get(ballot, ())
                or state is None
                or (state.record.promised, state.accepted, state.overdue) != (ballot, True, False)
            ):
                self._tell("adoption", t_s, name, f"does not execute {short(ballot)}")

    def on_planning(
        self, t_s: float, leader_s: float, ballot: Ballot, promises: States, known: States
    ) -> None:
        """Check that a leader pauses after failed planning, and counts no promise that has ended.

        Args:
            t_s: virtual time.
            leader_s: the leader's clock, which may jump.
            ballot: ballot for which the leader plans.
            promises: promises that the leader counts.
            known: newest state of each member that the leader has received.
        """
        if leader_s < self._planned_s.get(ballot, -math.inf) + PAUSE_S:
            self._tell("busy", t_s, min(promises), f"planned again at once under {short(ballot)}")
        self._planned_s[ballot] = leader_s
        for name, promise in promises.items():
            if name in known and known[name].record.incarnation != promise.record.incarnation:
                self._tell("basis", t_s, name, "the process that promised has ended")

    def on_prepare(self, t_s: float, prepare: Prepare) -> None:
        """Check that a ballot has one roster."""
        known = self._rosters.setdefault(prepare.ballot, prepare)
        if known is not prepare and known != prepare:
            names = sorted({*known.roster, *prepare.roster})
            self._tell("two-plans", t_s, names[0], f"two rosters under {short(prepare.ballot)}")

    def on_plan(self, t_s: float, plan: Plan) -> None:
        """Check the first message with a plan."""
        if plan.ballot in self.harmful or not self._is_current(plan):
            return
        for name in plan.roster:
            about = name, plan.incarnations[name], plan.ballot, plan.start_cells[name]
            if (*about, () if plan.before else plan.blocks) not in self._promises:
                text = f"{short(plan.ballot)} starts in {plan.start_cells[name]} without a promise"
                self._tell("basis", t_s, name, text)
        left_out = {name for name, block in self._blocks.items() if block in plan.blocks}
        for missing in sorted(left_out - set(plan.roster)):
            self._tell("roster", t_s, missing, f"not in {short(plan.ballot)} of its block")

    # --- violations ---------------------------------------------------------------------------

    def _is_current(self, plan: Plan) -> bool:
        """Return whether a plan was made for this road."""
        return not all(self.is_earlier(*process) for process in plan.incarnations.items())

    def _false(self, t_s: float, state: VehicleState, text: str) -> None:
        self._tell("false", t_s, state.vehicle, f"it reports that it {text}")

    def _tell(self, kind: str, t_s: float, vehicle: str, text: str) -> None:
        self.report(kind, t_s, [vehicle], text)


def short(ballot: Ballot | None) -> str:
    """Return a ballot as text."""
    return "nothing" if ballot is None else ".".join(str(part) for part in ballot)


def swept_cells(origin: Cell, target: Cell) -> frozenset[Cell]:
    """Return the cells in the bounding box of a move."""
    columns, lanes = zip(origin, target, strict=True)
    return frozenset(
        (column, lane)
        for column in range(min(columns), max(columns) + 1)
        for lane in range(min(lanes), max(lanes) + 1)
    )


def required_before(plan: Plan, vehicle: str, index: int) -> Iterable[tuple[Name, int]]:
    """Yield (vehicle, number of its moves) that must be complete before a move may begin."""
    step, origin, target = plan.moves[Name(vehicle)][index]
    own = swept_cells(origin, target)
    for other, moves in plan.moves.items():
        meeting = [
            number + 1
            for number, (at, begin, end) in enumerate(moves)
            if at < step and not own.isdisjoint(swept_cells(begin, end))
        ]
        if other != vehicle and meeting:
            yield other, max(meeting)
