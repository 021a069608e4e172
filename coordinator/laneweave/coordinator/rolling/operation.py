"""The rolling operation under a leader: all vehicles on the road are replanned in every slot.

Shortly after a slot begins, every vehicle's hold cell at the end of the slot is known. From these
cells the rolling planner plans complete paths for all vehicles. While the moves of this slot are in
progress, ballots that include only the vehicles concerned put the moves of the next slot into force
(`transfer`). No vehicle stops for a new plan: a vehicle that misses one holds, and the next plan
starts from its cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.operation import LogEntry, Outcome, ToVehicle
from laneweave.coordinator.planning.conflict_kinds import Move
from laneweave.coordinator.planning.rolling.problem import StreamPlan
from laneweave.coordinator.rolling.checked_planner import Planner
from laneweave.coordinator.rolling.known_road import KnownRoad
from laneweave.coordinator.rolling.observed import ObservedRoad
from laneweave.coordinator.rolling.ownership import ReplacedBallots, partners
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES, CellTransfer
from laneweave.protocol.lattice import footprint
from laneweave.protocol.road_layout import NO_PARTS, TemporaryParts
from laneweave.protocol.runtime.node import Clock, Compute, Computed
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import SNAPSHOT_S
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.wire.events import (
    PLAN_IN_FORCE,
    PLANNING_FAILED,
    PLANNING_LATE,
    STREAM_PLANNED,
    TRANSFER_ABORTED,
)
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Name,
    Plan,
    Prepare,
    VehicleState,
)

LISTEN_S = 0.5
"""Time for which a new leader only listens (node clock), so that it does not outbid a leader whose
heartbeats it has missed."""
MAX_DELAY_S = 1.0
"""Time into its slot after which a plan that is not in force is dropped."""
HEAR_S = 1.0
"""Longest time for which the snapshot waits for a state, from this slot, of each vehicle that moves
in it: a plan from the former cell would be void for that vehicle."""
AGAIN_S = 1.4
"""Time before a slot until which it is planned again if other parts of lanes are closed."""


class RollingOperation:
    """All vehicles under one leader; see `Operation`."""

    def __init__(
        self,
        scenario: Scenario,
        new_ballot: Callable[[Ballot | None], Ballot],
        new_job: Callable[[], int],
        planner: Planner,
        rules: RuleBook = TRANSFER_RULES,
    ) -> None:
        """Begin without vehicles.

        Args:
            scenario: road, lattice, timing.
            new_ballot: returns a new ballot, above the given one, if any.
            new_job: returns the id of a new computation.
            planner: plans all vehicles.
            rules: rules of cell transfers; tests replace some.
        """
        self._rules = rules
        self._scenario = scenario
        self._new_ballot = new_ballot
        self._new_job = new_job
        self._planner = planner
        self._slot_s = scenario.timing.cycles_s[0]
        self.observed = ObservedRoad()
        self.transfers: list[CellTransfer] = []
        """Ballots for the newest slot that has been planned."""
        self._in_progress: list[CellTransfer] = []
        """Ballots in force for the slot before."""
        self._replaced = ReplacedBallots()
        self._transfer_of: dict[Name, CellTransfer] = {}
        self._highest: Ballot | None = None
        self._since: tuple[float, float] | None = None
        """Road time and node clock at which this leader began to receive states."""
        self._ordered: tuple[int, int] | None = None
        """Id of the computation in progress, and index of the slot that it plans."""
        self._newest_slot = -1
        self._last_plan: StreamPlan | None = None
        self._temporary = NO_PARTS
        self._parts_changed = False
        """Whether these parts have changed since the last plan."""

    def forget(self) -> None:
        """Discard everything: the road is new."""
        self.take_over()
        self.observed.forget()
        self._replaced = ReplacedBallots()
        self._last_plan, self._newest_slot, self._highest = None, -1, None
        self._temporary, self._parts_changed = NO_PARTS, False

    def take_over(self) -> None:
        """Reset: listen for `LISTEN_S` before planning, and drop the ballots of the earlier term.

        What vehicles have reported about transfers stays true; their positions do not.
        """
        self.transfers.clear()
        self._in_progress.clear()
        self._transfer_of.clear()
        self.observed.take_over()
        self._ordered = self._since = None

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Ignore the clock message: only road time determines when plans are due."""

    def on_obstacles(self, temporary: TemporaryParts) -> None:
        """Handle the parts of lanes that are not open as always."""
        if temporary != self._temporary:
            self._temporary, self._parts_changed = temporary, True

    def on_state(self, state: VehicleState, now_s: float) -> list[LogEntry] | None:
        """Handle the state of a vehicle; return None if no unfinished ballot depends on it."""
        if not self.observed.on_state(state, now_s):
            return None
        if state.record.promised is not None:
            self._highest = max(self._highest or state.record.promised, state.record.promised)
        self._replaced.on_state(state)
        transfer = self._transfer_of.get(state.vehicle)
        if transfer is None or not transfer.unfinished:
            return None
        transfer.on_state(state, self.observed.states, now_s)
        planned = [transfer, *self._plan_those_that_waited(now_s)]
        aborted = [_aborted(each) for each in planned if each.phase is BallotPhase.ABORTED]
        if aborted:
            return aborted
        if transfer.phase is BallotPhase.IN_FORCE and self.in_force == 1:
            slot = math.floor(transfer.t0_s / self._slot_s + 1e-6)
            begun_s = (slot - 1) * self._slot_s
            return [LogEntry(PLAN_IN_FORCE, {"slot": slot, "closed_s": begun_s + SNAPSHOT_S})]
        return []

    def _plan_those_that_waited(self, now_s: float) -> list[CellTransfer]:
        """Plan the ballots that need no more promises of others; return them."""
        waited = [each for each in self.transfers if each.awaits_replaced and each.unfinished]
        for each in waited:
            each.plan_from_promises(self.observed.states, now_s)
        return waited

    def lead(self, census: Census, t_s: float, now_s: float, *, changed: bool) -> Iterator[Outcome]:
        """Request the plan for the next slot when it is due; send messages."""
        if changed:
            yield from self.on_census(census, now_s)
            yield from self.order(t_s, now_s)
        for vehicle, message in self.outgoing(now_s):
            yield ToVehicle(vehicle, message)

    def on_census(self, census: Census, now_s: float = 0.0) -> list[LogEntry]:
        """Update the vehicles on the road."""
        aborted = []
        for name in self.observed.on_census(census):
            transfer = self._transfer_of.pop(name, None)
            if transfer is not None and transfer.on_left(name):
                aborted.append(_aborted(transfer))
        gone = self.observed.gone
        for each in self.transfers:
            each.gone = gone
        waited = self._plan_those_that_waited(now_s)
        return aborted + [_aborted(each) for each in waited if each.phase is BallotPhase.ABORTED]

    def _abort(self, transfers: Iterable[CellTransfer], reason: str) -> Iterator[LogEntry]:
        """Abort those of the ballots that are not decided."""
        for transfer in transfers:
            if transfer.abort(reason):
                yield _aborted(transfer)

    def outgoing(self, now_s: float) -> Iterator[tuple[Name, Prepare | Plan]]:
        """Yield the messages to send or resend now, each with its receiver."""
        for transfer in self.transfers:
            yield from transfer.outgoing(now_s)

    def order(self, t_s: float, now_s: float) -> Iterator[Compute | LogEntry]:
        """Request the plan for the next slot when it is due; abort ballots that are late."""
        census = self.observed.census
        if census is None:
            return
        if self._since is None:
            self._since = t_s, now_s
        late = [each for each in self.transfers if t_s > each.t0_s + MAX_DELAY_S]
        yield from self._abort(late, "its slot has begun")
        if not census.on_road or self._ordered is not None:
            return
        slot = math.floor(t_s / self._slot_s + 1e-9)
        snapshot_s = slot * self._slot_s + SNAPSHOT_S + 1e-6
        if self._parts_changed and t_s < self._newest_slot * self._slot_s - AGAIN_S:
            self._newest_slot = slot
        if slot < self._newest_slot or t_s <= snapshot_s or now_s < self._since[1] + LISTEN_S:
            return
        if t_s <= snapshot_s + HEAR_S and self._is_mover_unheard(slot):
            return
        if max(self._since[0], t_s - 1.5 * self._scenario.runtime.tick_s) > snapshot_s:
            snapshot_s = t_s  # too late for that snapshot: use the newest states
        known = KnownRoad(
            self._scenario, self.observed.at(snapshot_s), snapshot_s, slot + 1, self._since[0]
        )
        self._parts_changed = False
        replaced = self._replaced.copy()
        for each in self._for_slot(slot + 1):
            replaced.replace(each.ballot, each.roster, self.observed.states)
        before = [*self._in_progress, *self._for_slot(slot)]
        open_road = known.open_road(self._temporary)
        vehicles, blocked = known.vehicles_and_blocked_cells(
            before, replaced, open_road, self._temporary.closed
        )
        self._newest_slot = slot + 1
        job = self._new_job()
        self._ordered = (job, slot + 1)
        plan = partial(
            self._planner,
            slot + 1,
            vehicles,
            self._last_plan,
            blocked,
            open_road,
        )
        yield Compute(job, partial(_without_deadline, plan))

    def _is_mover_unheard(self, slot: int) -> bool:
        """Return whether a vehicle that moves in a slot has not been heard since the slot began."""
        begun_s, states = slot * self._slot_s - 1e-6, self.observed.states
        movers = (name for each in self._for_slot(slot) for name in each.moves)
        return any(name in states and states[name].t_s < begun_s for name in movers)

    def finish(self, computed: Computed, t_s: float, now_s: float) -> Iterator[LogEntry]:
        """Begin ballots for the first moves of the plan requested last; ignore other results."""
        if self._ordered is None or computed.job != self._ordered[0]:
            return
        slot = self._ordered[1]
        self._ordered = None
        t0_s = slot * self._slot_s
        replaced, plan = self._for_slot(slot), computed.result
        # Moves of earlier ballots for this slot should not have begun.
        again = any(each.t0_s > t0_s - 1e-6 for each in self.transfers)
        late = t_s > (t0_s if again else t0_s + MAX_DELAY_S)
        if not again or (isinstance(plan, StreamPlan) and not late):
            reason = "the slot is planned again" if again else "the next slot is planned"
            yield from self._abort(self.transfers, reason)
        if not isinstance(plan, StreamPlan):
            yield LogEntry(PLANNING_FAILED, {"slot": slot, "error": computed.error})
            return
        known = set() if self._last_plan is None else {*self._last_plan.missed}
        self._last_plan = plan
        if late:
            yield LogEntry(PLANNING_LATE, {"slot": slot})
            return
        self._in_progress = [
            each
            for each in (*self._in_progress, *self._for_slot(slot - 1))
            if each.t0_s > t0_s - 1.5 * self._slot_s
        ]
        self._replaced.forget(self.observed.states)
        self.transfers = [*self._make_transfers(plan, t0_s, now_s, replaced)]
        self._transfer_of = {name: each for each in self.transfers for name in each.roster}
        out_of_reach = [name for name in plan.missed if name not in known]
        yield LogEntry(STREAM_PLANNED, self._log_data(plan) | {"out_of_reach": out_of_reach})

    def _for_slot(self, slot: int) -> list[CellTransfer]:
        """Return the newest ballots for a slot whose plans have been sent."""
        return [
            each
            for each in self.transfers
            if abs(each.t0_s - slot * self._slot_s) < 1e-6
            and each.phase in (BallotPhase.ISSUING, BallotPhase.IN_FORCE)
        ]

    def _log_data(self, plan: StreamPlan) -> dict[str, Any]:
        sizes = [len(transfer.roster) for transfer in self.transfers]
        return {
            "slot": plan.slot,
            "vehicles": len(plan.paths),
            "missed": len(plan.missed),
            "moves": sum(len(transfer.moves) for transfer in self.transfers),
            "ballots": len(sizes),
            "largest": max(sizes, default=0),
            "status": "feasible",
            "solve_ms": plan.solve_ms,
        }

    def _make_transfers(
        self, plan: StreamPlan, t0_s: float, now_s: float, replaced: Sequence[CellTransfer]
    ) -> Iterator[CellTransfer]:
        """Yield the ballots for the first moves of a plan.

        Args:
            plan: paths of all vehicles.
            t0_s: road time at which the slot begins.
            now_s: node clock.
            replaced: earlier ballots for this slot. Their vehicles drop their moves when they
                promise a newer one; a ballot with the same vehicles and moves is kept instead.
        """
        states, gone = self.observed.states, self.observed.gone
        for each in replaced:
            self._replaced.replace(each.ballot, each.roster, states)
        owner = {
            cell: name
            for name, state in states.items()
            for cell in self._replaced.cells_before(state, states, gone)
        }
        moves: dict[Name, Move] = {}
        rosters: dict[Name, set[Name]] = {}
        for vehicle, path in plan.paths.items():
            if len(path) < 2 or path[0] == path[1]:
                continue
            name = Name(vehicle)
            state = states.get(name)
            if state is None or state.hold_cell != path[0]:
                continue  # it has moved since
            cells = footprint(path[0], path[1])
            if all(cell in owner for cell in cells):
                moves[name] = (path[0], path[1])
                rosters[name] = self._with_partners({owner[cell] for cell in cells} | {name})
        same = {
            each.roster: each
            for each in replaced
            if each.phase is BallotPhase.IN_FORCE
            and each.moves == {name: moves[name] for name in each.roster if name in moves}
        }
        # Others promise one by one: one that is not ready must not keep the others waiting.
        kept = {name for roster in same for name in roster}
        asked = [{name} for name in sorted(self._replaced.to_ask(states) - kept)]
        earlier = [{*roster} & states.keys() for roster in same]
        for members in _clusters([*rosters.values(), *earlier, *asked]):
            roster = tuple(sorted(members))
            if roster in same:
                self._replaced.keep(same[roster].ballot)
                yield same[roster]
                continue
            yield CellTransfer(
                ballot=self._new_ballot(self._highest),
                roster=roster,
                moves={name: moves[name] for name in roster if name in moves},
                replaced=self._replaced,
                t0_s=t0_s,
                slot_s=self._slot_s,
                resend_s=self._scenario.network.resend_s,
                due_s=now_s,
                gone=gone,
                rules=self._rules,
            )

    def _with_partners(self, names: set[Name]) -> set[Name]:
        """Add the vehicles whose promises determine what the others own.

        Members of replaced ballots that have not promised newer ones are asked in any case.
        """
        roster, waiting, states = set(names), sorted(names), self.observed.states
        while waiting:
            state = states[waiting.pop()]
            if state.record.transfer is not None and state.record.transfer.ballot in self._replaced:
                continue
            new = partners(state, states) - roster
            roster |= new
            waiting += sorted(new)
        return roster

    @property
    def wakeups(self) -> list[float]:
        """Times at which messages are resent."""
        return [each.wakeup_s for each in self.transfers if each.wakeup_s is not None]

    @property
    def in_force(self) -> int:
        """Number of ballots for this slot that are in force."""
        return sum(transfer.phase is BallotPhase.IN_FORCE for transfer in self.transfers)


def _without_deadline(plan: Callable[[], StreamPlan], clock: Clock) -> StreamPlan:
    """Run a planner that needs no clock; unlike a closure, a pending job can be copied."""
    del clock
    return plan()


def _aborted(transfer: CellTransfer) -> LogEntry:
    data = {
        "roster": list(transfer.roster),
        "why": transfer.reason,
        "unanswered": list(transfer.unanswered),
    }
    return LogEntry(TRANSFER_ABORTED, data)


def _clusters(groups: Iterable[set[Name]]) -> list[set[Name]]:
    """Merge groups that share a vehicle."""
    clusters: list[set[Name]] = []
    for group in groups:
        joined = set(group)
        apart = []
        for cluster in clusters:
            if cluster & joined:
                joined |= cluster
            else:
                apart.append(cluster)
        clusters = [*apart, joined]
    return clusters
