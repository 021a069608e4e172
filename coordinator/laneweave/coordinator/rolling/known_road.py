"""What a leader knows when it plans a slot, in the form that the planner takes.

For each vehicle: its cell at the end of the slot before, where it may go, and whether it can move
at all. For each cell: whether it belongs to a vehicle that can give it away. What is uncertain is
blocked or held, so that ballots rarely fail; safety does not depend on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from attrs import evolve, frozen

from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.planning.rolling.problem import MovingPart, OpenRoad, StreamVehicle
from laneweave.coordinator.rolling.observed import Snapshot
from laneweave.coordinator.rolling.ownership import ReplacedBallots
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import (
    ANY_LANE,
    END_OF_ROAD,
    NO_PARTS,
    ClearedPart,
    LaneSection,
    TemporaryClosure,
    TemporaryParts,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import READY_LATE_S
from laneweave.protocol.vehicle.lane_ends import sections_to_lines
from laneweave.protocol.vehicle.motion import DISPLACED_ALONG_M
from laneweave.protocol.vehicle.sudden_stops import queue_pitch_m
from laneweave.protocol.wire.messages import CensusEntry, Name, VehicleState

LOOKAHEAD_M = 600.0
"""Distance before the first moves at which planning for a vehicle begins: the length of S3, so that
all vehicles that can interact there are included in time."""
MARGIN_COLUMNS = 10
"""Columns ahead of the foremost and behind the rearmost vehicle that plans may use."""

GENTLE_BRAKING_MPS2 = 2.0
"""Deceleration from which vehicles brake before a closed part of their lane."""


@frozen
class KnownRoad:
    """A snapshot, from which one slot is planned."""

    scenario: Scenario
    snapshot: Snapshot
    t_s: float
    """Road time of the snapshot."""
    slot: int
    """Index of the slot to plan."""
    since_s: float
    """Road time since which the leader receives states."""

    @property
    def _slot_s(self) -> float:
        return self.scenario.timing.cycles_s[0]

    def vehicles_and_blocked_cells(
        self,
        transfers: Sequence[CellTransfer],
        replaced: ReplacedBallots,
        open_road: OpenRoad,
        closed: Sequence[TemporaryClosure] = (),
    ) -> tuple[tuple[StreamVehicle, ...], frozenset[Cell]]:
        """Return the vehicles to plan for, and the cells that no plan may use.

        Args:
            transfers: ballots for the slot before.
            replaced: ballots that vehicles have dropped, or will drop for this plan.
            open_road: the road as plans may use it.
            closed: parts of lanes that are closed for a time.
        """
        snapshot, lattice = self.snapshot, self.scenario.lattice
        vehicles: dict[Cell, StreamVehicle] = {}
        owned, reserved = set[Cell](), set[Cell]()
        far_m = self.scenario.geometry.moves_from_m - LOOKAHEAD_M
        gated = self._gated(transfers)
        ending = self._ending(open_road.sections, closed)
        # Vehicles without a state come last: they may have moved, and others may hold their cells.
        for entry in sorted(
            snapshot.census.on_lattice, key=lambda entry: entry.vehicle not in snapshot.states
        ):
            state = snapshot.states.get(entry.vehicle)
            cell = entry.cell if state is None else state.hold_cell
            s_m = lattice.cell_s_m(cell[0], (self.slot - 1) * self._slot_s)
            if s_m < far_m:
                continue
            keeps_cells = state is not None and (
                _is_late(state, replaced) or self._brakes(cell, ending)
            )
            is_gated = entry.vehicle in gated
            vehicle = self._vehicle(entry, state, s_m, held=keeps_cells, gated=is_gated)
            vehicles.setdefault(cell, vehicle)
            if state is not None:
                its_cells = replaced.cells_before(state, snapshot.states, snapshot.gone)
                owned |= its_cells
                if keeps_cells:
                    reserved |= its_cells - {cell}
                reserved |= self._reserved(entry, state, keeps_all=keeps_cells or is_gated)
        columns = [column for column, _ in vehicles] or [0]
        window = range(min(columns) - MARGIN_COLUMNS, max(columns) + MARGIN_COLUMNS + 1)
        blocked = frozenset(
            (column, lane)
            for lane in range(self.scenario.road.lanes)
            for column in self._assigned_columns(lane, window)
            if (column, lane) not in owned or (column, lane) in reserved
        )
        return tuple(vehicles.values()), blocked

    def open_road(self, temporary: TemporaryParts = NO_PARTS) -> OpenRoad:
        """Return the road as plans may use it now."""
        return OpenRoad(
            tuple(self._open_sections(temporary.closed)),
            tuple(self._moving_part(one) for one in temporary.cleared),
        )

    def _moving_part(self, part: ClearedPart) -> MovingPart:
        """Return a part that is cleared as the planner takes it."""
        advance_m = part.speed_mps * self._slot_s
        return MovingPart(part.lane, *part.at(0.0), advance_m)

    def _open_sections(self, closed: Sequence[TemporaryClosure]) -> list[LaneSection]:
        """Return the sections as plans may use them now.

        They end before parts that are closed for a time, and before vehicles without cells or
        agents. Behind a closed part, a section begins so late that no vehicle can pass the part
        within a slot.
        """
        scenario, census = self.scenario, self.snapshot.census
        always = len(scenario.geometry.sections)
        sections = list(sections_to_lines(scenario, closed))
        jump_m = scenario.formation.speed_mps * self._slot_s + scenario.lattice.pitch_m
        for number, section in enumerate(sections[:always]):
            before = [each.to_m for each in sections[always:] if each.lane == section.lane]
            ends_m = [to_m for to_m in before if to_m < section.from_m]
            if ends_m:
                from_m = min(max(section.from_m, max(ends_m) + jump_m), section.to_m)
                sections[number] = evolve(section, from_m=from_m)
        bodies = (*census.off_lattice, *census.ends)
        for number, section in enumerate(sections):
            inside = [
                body.rear_m
                for body in bodies
                if body.lane == section.lane and section.from_m <= body.rear_m < section.to_m
            ]
            if inside:
                sections[number] = evolve(section, to_m=min(inside))
            if number >= always:
                queue_m = self._queue_begins_m(sections[number])
                sections[number] = evolve(sections[number], to_m=queue_m)
        return sections

    def _ending(
        self, sections: Sequence[LaneSection], closed: Sequence[TemporaryClosure]
    ) -> list[tuple[LaneSection, float]]:
        """Return the sections that end suddenly, up to the queue, and where the parts begin."""
        found = []
        for section in sections[len(self.scenario.geometry.sections) :]:
            ahead = (part.from_m for part in closed if part.lane == section.lane)
            found.append((section, min(each for each in ahead if each >= section.to_m)))
        return found

    def _brakes(self, cell: Cell, ending: Sequence[tuple[LaneSection, float]]) -> bool:
        """Return whether a vehicle brakes before a closed part when the slot begins.

        It can no longer leave its lane. Out of its cell it is not ready for a plan, and the gates
        of all who needed it would stay closed.
        """
        speed_mps = self.scenario.formation.speed_mps
        braking_m = speed_mps**2 / (2.0 * GENTLE_BRAKING_MPS2)
        s_m = self.scenario.lattice.cell_s_m(cell[0], self.t_s)
        begins_m = self.scenario.lattice.cell_s_m(cell[0], self.slot * self._slot_s)
        return any(
            cell[1] == section.lane
            and section.from_m <= s_m <= part_m
            and begins_m + min(braking_m, speed_mps * self._slot_s) > section.to_m
            for section, part_m in ending
        )

    def _queue_begins_m(self, section: LaneSection) -> float:
        """Return where moves out of a section end that is closed suddenly.

        Vehicles that can no longer leave it will queue. A vehicle that reached the queue while it
        changes lanes would stop in both lanes.
        """
        scenario, begins_m = self.scenario, section.to_m
        lattice, states = scenario.lattice, self.snapshot.states
        queue_m = queue_pitch_m(scenario)
        cells = (
            states[entry.vehicle].hold_cell if entry.vehicle in states else entry.cell
            for entry in self.snapshot.census.on_lattice
        )
        t_s, advance_m = self.slot * self._slot_s, lattice.speed_mps * self._slot_s
        inside = (lattice.cell_s_m(column, t_s) for column, lane in cells if lane == section.lane)
        for s_m in sorted(inside, reverse=True):
            if s_m > begins_m - advance_m and s_m - advance_m < section.to_m:
                begins_m -= queue_m
        return max(begins_m, section.from_m)

    def _vehicle(
        self,
        entry: CensusEntry,
        state: VehicleState | None,
        s_m: float,
        *,
        held: bool,
        gated: bool,
    ) -> StreamVehicle:
        """Return a vehicle as the planner takes it; one without a state is held where it entered.

        Args:
            entry: its entry in the census.
            state: its state, if any.
            s_m: position of its cell at the beginning of the slot.
            held: whether it stays in its cell, see `_is_late` and `_brakes`.
            gated: whether it takes no part in this slot, see `_gated`.
        """
        targets, own = self._targets(entry, s_m), entry.vehicle_type
        if state is None:
            return StreamVehicle(entry.vehicle, entry.cell, targets, True, vehicle_type=own)
        settles = entry.ready_s > (self.slot - 1) * self._slot_s
        # States from an earlier term of this leader do not report current positions.
        held = held or not state.attended or state.t_s < self.since_s - 1e-6
        held = held or (self._is_displaced(state) and not settles)
        ready_s = entry.ready_s - READY_LATE_S
        waits = max(int(gated), math.ceil(ready_s / self._slot_s - self.slot - 1e-9))
        moves = self.scenario.types.moves_of(own)
        return StreamVehicle(entry.vehicle, state.hold_cell, targets, held, moves, waits, own)

    def _reserved(self, entry: CensusEntry, state: VehicleState, *, keeps_all: bool) -> set[Cell]:
        """Return the cells that a vehicle owns and will not give away in this slot."""
        owned, (column, lane) = state.record.owned, state.hold_cell
        if keeps_all:
            return {*owned} - {state.hold_cell}
        if entry.ready_s > self.slot * self._slot_s:  # it may still be beside these cells
            return {cell for cell in owned if cell[1] == lane and cell[0] > column}
        return set()

    def _gated(self, transfers: Sequence[CellTransfer]) -> frozenset[Name]:
        """Return members of ballots in force whose gates wait for a settling vehicle.

        These are ballots for the slot before. If a member promised the next ballot, the gate would
        stay closed.
        """
        t0_s, states = (self.slot - 1) * self._slot_s, self.snapshot.states
        settling = {one.vehicle for one in self.snapshot.census.on_lattice if one.ready_s > t0_s}
        return frozenset(
            name
            for transfer in transfers
            if transfer.phase is BallotPhase.IN_FORCE
            and transfer.t0_s >= t0_s - 1e-6
            and not settling.isdisjoint(transfer.roster)
            and not any(states[one].go for one in transfer.roster if one in states)
            for name in transfer.roster
        )

    def _assigned_columns(self, lane: int, columns: range) -> range:
        """Return the columns whose cells may have been assigned to vehicles.

        On a ramp, plans count on cells behind it: they will be assigned before moves begin there.
        """
        lattice, entry_m = self.scenario.lattice, self.scenario.geometry.entry_m[lane]
        if entry_m <= 0.0:
            return columns
        first = math.ceil((entry_m - lattice.cell_s_m(0, self.t_s)) / lattice.pitch_m)
        return range(max(columns.start, first), columns.stop)

    def _targets(self, entry: CensusEntry, s_m: float) -> frozenset[int]:
        """Return the sections by whose ends a vehicle at a position may leave the road.

        A vehicle that has passed its exit drives to the end of the road.
        """
        geometry, own = self.scenario.geometry, entry.vehicle_type
        wanted = geometry.goal_sections(entry.preferred_lane, entry.destination, own)
        ahead = frozenset(number for number in wanted if geometry.sections[number].to_m > s_m)
        return ahead or geometry.goal_sections(ANY_LANE, END_OF_ROAD, own)

    def _is_displaced(self, state: VehicleState) -> bool:
        """Return whether a body is farther from its cell than any move of one cell takes it.

        Its plans would not come into force, since it is not ready for them.
        """
        lattice = self.scenario.lattice
        cell_s_m = lattice.cell_s_m(state.hold_cell[0], state.t_s)
        return abs(state.s_m - cell_s_m) > lattice.pitch_m + DISPLACED_ALONG_M


def _is_late(state: VehicleState, replaced: ReplacedBallots) -> bool:
    """Return whether a vehicle may still begin a move of the slot before: its gate is open.

    With a closed gate it never begins once the vehicle promises the newer ballot. The moves of
    replaced ballots are dropped: their members are asked for newer promises.
    """
    waits = state.go and not state.done and not state.moving
    return waits and (state.record.accepted is None or state.record.accepted not in replaced)
