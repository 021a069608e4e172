"""The rolling operation under a leader: all vehicles on the road are replanned in every slot.

Shortly after a slot begins, every vehicle's hold cell at the end of the slot is known. From these
cells the rolling planner plans complete paths for all vehicles. While the moves of this slot are in
progress, ballots that include only the vehicles concerned put the moves of the next slot into force
(`transfer`). No vehicle stops for a new plan: a vehicle that misses one holds, and the next plan
starts from its cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.operation import LogEntry, to_vehicle
from laneweave.coordinator.planning.conflict_kinds import Move
from laneweave.coordinator.planning.rolling.problem import StreamPlan, StreamVehicle
from laneweave.coordinator.rolling.checked_planner import Planner
from laneweave.coordinator.rolling.observed import ObservedRoad, Snapshot
from laneweave.coordinator.rolling.ownership import certain_cells, partners
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES, CellTransfer
from laneweave.protocol.lattice import Cell, footprint
from laneweave.protocol.road_layout import ANY_LANE, END_OF_ROAD
from laneweave.protocol.runtime.node import Compute, Computed, Effect
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import READY_LATE_S, SNAPSHOT_S
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.motion import DISPLACED_ALONG_M
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
    CensusEntry,
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
LOOKAHEAD_M = 600.0
"""Distance before the first moves at which planning for a vehicle begins: the length of S3, so that
all vehicles that can interact there are included in time."""
MARGIN_COLUMNS = 10
"""Columns ahead of the foremost and behind the rearmost vehicle that plans may use."""


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
        self._sections = scenario.geometry.sections
        self.observed = ObservedRoad()
        self.transfers: list[CellTransfer] = []
        self._transfer_of: dict[Name, CellTransfer] = {}
        self._highest: Ballot | None = None
        self._since: tuple[float, float] | None = None
        """Road time and node clock at which this leader began to receive states."""
        self._ordered: tuple[int, int] | None = None
        """Id of the computation in progress, and index of the slot that it plans."""
        self._newest_slot = -1
        self._last_plan: StreamPlan | None = None

    def forget(self) -> None:
        """Discard everything: the road is new."""
        self.take_over()
        self.observed.forget()
        self._last_plan, self._newest_slot = None, -1

    def take_over(self) -> None:
        """Reset: listen for `LISTEN_S` before planning, and drop the ballots of the earlier term.

        What vehicles have reported about transfers stays true; their positions do not.
        """
        self.transfers.clear()
        self._transfer_of.clear()
        self.observed.take_over()
        self._ordered = self._since = None

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Ignore the clock message: only road time determines when plans are due."""

    def on_state(self, state: VehicleState, now_s: float) -> list[LogEntry] | None:
        """Handle the state of a vehicle; return None if no unfinished ballot depends on it."""
        if not self.observed.on_state(state, now_s):
            return None
        if state.record.promised is not None:
            self._highest = max(self._highest or state.record.promised, state.record.promised)
        transfer = self._transfer_of.get(state.vehicle)
        if transfer is None or not transfer.unfinished:
            return None
        transfer.on_state(state, self.observed.states, now_s)
        if transfer.phase is BallotPhase.ABORTED:
            data = {"roster": list(transfer.roster), "why": transfer.reason}
            return [LogEntry(TRANSFER_ABORTED, data)]
        if transfer.phase is BallotPhase.IN_FORCE and self.in_force == 1:
            slot = math.floor(transfer.t0_s / self._slot_s + 1e-6)
            begun_s = (slot - 1) * self._slot_s
            return [LogEntry(PLAN_IN_FORCE, {"slot": slot, "closed_s": begun_s + SNAPSHOT_S})]
        return []

    def lead(
        self, census: Census, t_s: float, now_s: float, *, changed: bool
    ) -> Iterator[Effect | LogEntry]:
        """Request the plan for the next slot when it is due; send messages."""
        if changed:
            self.on_census(census)
            yield from self.order(t_s, now_s)
        for vehicle, message in self.outgoing(now_s):
            yield to_vehicle(vehicle, message)

    def on_census(self, census: Census) -> None:
        """Update the vehicles on the road."""
        for name in self.observed.on_census(census):
            transfer = self._transfer_of.pop(name, None)
            if transfer is not None:
                transfer.on_left(name)

    def outgoing(self, now_s: float) -> Iterator[tuple[Name, Prepare | Plan]]:
        """Yield the messages to send or resend now, each with its receiver."""
        for transfer in self.transfers:
            yield from transfer.outgoing(now_s)

    def order(self, t_s: float, now_s: float) -> Iterator[Compute]:
        """Request the plan for the next slot when it is due."""
        census = self.observed.census
        if census is None:
            return
        if self._since is None:
            self._since = t_s, now_s
        for transfer in self.transfers:
            if t_s > transfer.t0_s + MAX_DELAY_S:
                transfer.abort("its slot has begun")
        if not census.on_road or self._ordered is not None:
            return
        slot = math.floor(t_s / self._slot_s + 1e-9)
        snapshot_s = slot * self._slot_s + SNAPSHOT_S + 1e-6
        if slot < self._newest_slot or t_s <= snapshot_s or now_s < self._since[1] + LISTEN_S:
            return
        if max(self._since[0], t_s - 1.5 * self._scenario.runtime.tick_s) > snapshot_s:
            snapshot_s = t_s  # too late for that snapshot: use the newest states
        vehicles, blocked, ends_m = self._observed_at(snapshot_s, slot + 1)
        self._newest_slot = slot + 1
        job = self._new_job()
        self._ordered = (job, slot + 1)
        plan = partial(self._planner, slot + 1, vehicles, self._last_plan, blocked, ends_m)
        yield Compute(job, lambda _: plan())

    def _observed_at(
        self, snapshot_s: float, slot: int
    ) -> tuple[tuple[StreamVehicle, ...], frozenset[Cell], dict[int, float]]:
        """Return what the planner needs: vehicles, blocked cells, and earlier ends of sections."""
        vehicles: dict[Cell, StreamVehicle] = {}
        owned, reserved = set[Cell](), set[Cell]()
        # States from an earlier term of this leader do not report current positions.
        since_s = self._since[0] - 1e-6 if self._since is not None else 0.0
        far_m = self._scenario.geometry.moves_from_m - LOOKAHEAD_M
        snapshot = self.observed.at(snapshot_s)
        gated = self._gated(snapshot, slot - 1)
        # Vehicles without a state come last: they may have moved, and others may hold their cells.
        for entry in sorted(
            snapshot.census.on_lattice, key=lambda entry: entry.vehicle not in snapshot.states
        ):
            state = snapshot.states.get(entry.vehicle)
            column = entry.cell[0] if state is None else state.hold_cell[0]
            s_m = self._scenario.lattice.cell_s_m(column, (slot - 1) * self._slot_s)
            if s_m < far_m:
                continue
            targets = self._targets(entry, s_m)
            moves = self._scenario.types.moves_of(entry.vehicle_type)
            if state is None:
                unknown = StreamVehicle(
                    entry.vehicle, entry.cell, targets, True, vehicle_type=entry.vehicle_type
                )
                vehicles.setdefault(entry.cell, unknown)
                continue
            # With an open gate the move may begin at any time. With a closed gate it never begins
            # once the vehicle promises the newer ballot.
            late = state.go and not state.done and not state.moving
            owned |= certain_cells(state, snapshot.states, snapshot.gone)
            if late or entry.vehicle in gated:
                reserved |= {*state.record.owned} - {state.hold_cell}
            elif entry.ready_s > slot * self._slot_s:
                # It may still be beside these cells.
                column, lane = state.hold_cell
                reserved |= {
                    cell for cell in state.record.owned if cell[1] == lane and cell[0] > column
                }
            settles = entry.ready_s > (slot - 1) * self._slot_s
            held = late or not state.attended or state.t_s < since_s
            held = held or (self._is_displaced(state) and not settles)
            ready_s = entry.ready_s - READY_LATE_S
            waits = max(0, math.ceil(ready_s / self._slot_s - slot - 1e-9))
            if entry.vehicle in gated:
                waits = max(waits, 1)
            cell, own = state.hold_cell, entry.vehicle_type
            known = StreamVehicle(entry.vehicle, cell, targets, held, moves, waits, own)
            vehicles.setdefault(cell, known)
        columns = [column for column, _ in vehicles] or [0]
        window = range(min(columns) - MARGIN_COLUMNS, max(columns) + MARGIN_COLUMNS + 1)
        blocked = frozenset(
            (column, lane)
            for lane in range(self._scenario.road.lanes)
            for column in self._assigned_columns(lane, window, snapshot_s)
            if (column, lane) not in owned or (column, lane) in reserved
        )
        return tuple(vehicles.values()), blocked, self._ends_m(snapshot.census)

    def _gated(self, snapshot: Snapshot, slot: int) -> frozenset[Name]:
        """Return the members of ballots for a slot whose start gates wait for a settling vehicle.

        If one of them promised the next ballot, the gate would stay closed.
        """
        t0_s, states = slot * self._slot_s, snapshot.states
        settling = {one.vehicle for one in snapshot.census.on_lattice if one.ready_s > t0_s}
        return frozenset(
            name
            for transfer in self.transfers
            if transfer.phase is BallotPhase.IN_FORCE
            and transfer.t0_s >= t0_s - 1e-6
            and not settling.isdisjoint(transfer.roster)
            and not any(states[one].go for one in transfer.roster if one in states)
            for name in transfer.roster
        )

    def _assigned_columns(self, lane: int, columns: range, t_s: float) -> range:
        """Return the columns whose cells may have been assigned to vehicles at a road time.

        On a ramp, plans count on cells behind it: they will be assigned before moves begin there.
        """
        lattice, entry_m = self._scenario.lattice, self._scenario.geometry.entry_m[lane]
        if entry_m <= 0.0:
            return columns
        first = math.ceil((entry_m - lattice.cell_s_m(0, t_s)) / lattice.pitch_m)
        return range(max(columns.start, first), columns.stop)

    def _targets(self, entry: CensusEntry, s_m: float) -> frozenset[int]:
        """Return the sections by whose ends a vehicle at a position may leave the road.

        A vehicle that has passed its exit drives to the end of the road.
        """
        goals, own = self._scenario.geometry.goal_sections, entry.vehicle_type
        wanted = goals(entry.preferred_lane, entry.destination, own)
        ahead = frozenset(number for number in wanted if self._sections[number].to_m > s_m)
        return ahead or goals(ANY_LANE, END_OF_ROAD, own)

    def _is_displaced(self, state: VehicleState) -> bool:
        """Return whether a body is farther from its cell than any move of one cell takes it.

        Its plans would not come into force, since it is not ready for them.
        """
        lattice = self._scenario.lattice
        cell_s_m = lattice.cell_s_m(state.hold_cell[0], state.t_s)
        return abs(state.s_m - cell_s_m) > lattice.pitch_m + DISPLACED_ALONG_M

    def _ends_m(self, census: Census) -> dict[int, float]:
        """Return where sections end before vehicles without cells [m], by index."""
        ends_m: dict[int, float] = {}
        bodies = [entry.off_lattice for entry in census.on_road if entry.off_lattice is not None]
        for number, section in enumerate(self._sections):
            inside = [
                body.rear_m
                for body in bodies
                if body.lane == section.lane and section.from_m <= body.rear_m < section.to_m
            ]
            if inside:
                ends_m[number] = min(inside)
        return ends_m

    def finish(self, computed: Computed, t_s: float, now_s: float) -> Iterator[LogEntry]:
        """Begin ballots for the first moves of the plan requested last; ignore other results."""
        if self._ordered is None or computed.job != self._ordered[0]:
            return
        slot = self._ordered[1]
        self._ordered = None
        for transfer in self.transfers:
            transfer.abort("the next slot is planned")
        plan = computed.result
        if not isinstance(plan, StreamPlan):
            yield LogEntry(PLANNING_FAILED, {"slot": slot, "error": computed.error})
            return
        self._last_plan = plan
        t0_s = slot * self._slot_s
        if t_s > t0_s + MAX_DELAY_S:
            yield LogEntry(PLANNING_LATE, {"slot": slot})
            return
        self.transfers = list(self._make_transfers(plan, t0_s, now_s))
        self._transfer_of = {name: each for each in self.transfers for name in each.roster}
        yield LogEntry(STREAM_PLANNED, self._log_data(plan))

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
        self, plan: StreamPlan, t0_s: float, now_s: float
    ) -> Iterator[CellTransfer]:
        states, gone = self.observed.states, self.observed.gone
        owner = {
            cell: name
            for name, state in states.items()
            for cell in certain_cells(state, states, gone)
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
        for roster in _clusters(rosters.values()):
            yield CellTransfer(
                ballot=self._new_ballot(self._highest),
                roster=tuple(sorted(roster)),
                moves={name: moves[name] for name in sorted(roster) if name in moves},
                t0_s=t0_s,
                slot_s=self._slot_s,
                resend_s=self._scenario.network.resend_s,
                due_s=now_s,
                gone=gone,
                rules=self._rules,
            )

    def _with_partners(self, names: set[Name]) -> set[Name]:
        """Add the vehicles whose promises determine what the others own."""
        roster, waiting, states = set(names), sorted(names), self.observed.states
        while waiting:
            new = partners(states[waiting.pop()], states) - roster
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
