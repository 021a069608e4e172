"""A vehicle's motion controller, which outlives the vehicle's agent process.

It drives on one of these levels (`FallbackLevel`):

    execute     executes the trajectory of the newest command
    hold        steers into the cell of the newest command, and stays in it at v_F
    give way    as hold, but brakes comfortably behind a vehicle ahead
    emergency   brakes as hard as possible while `EmergencyBrake` requires it

Without an agent or new commands, the controller executes its trajectory to the end. A trajectory
that has ended or was interrupted by an emergency is not resumed: only a new command leads back to
`execute`. The emergency brake acts on every level and uses only local sensing.

**Lanes that end.** The stop line before a dead end counts as a vehicle that stands there, on every
level. A vehicle whose cell has passed the line leaves the lattice: it gives up its cells, drives up
to the line and waits. When the roadside has kept cells free for it, it re-enters: it drives into
the neighbouring lane and has cells again. All of this needs neither agent nor messages.

The controller also stores the vehicle's record (`record_store`), which must survive the agent. Only
the process in charge can change the hold cell and the trajectory.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from enum import Enum, IntEnum

from attrs import define, field

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, Lattice, footprint
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.emergency_brake import EmergencyBrake
from laneweave.protocol.vehicle.lane_ends import LATE_S
from laneweave.protocol.vehicle.motion import (
    ARRIVED_ACROSS_M,
    DISPLACED_ALONG_M,
    NEARLY_SETTLED_MPS,
    Jerk,
    State,
    at_rest_in_cell,
    cell_state,
    commanded_state,
    displaced,
    has_settled,
    hold_law,
    keep_gap,
    limited_accel,
    stop_law,
)
from laneweave.protocol.vehicle.territory import territory_of
from laneweave.protocol.wire.messages import Command, CurrentMotion, Neighbour, VehicleRecord
from laneweave.sim_bridge.bodies.cell_guard import CellGuard
from laneweave.sim_bridge.bodies.command_checks import (
    NEIGHBOURING,
    LaneGaps,
    Occupancy,
    Problem,
    Refusal,
    checked_jerks,
)
from laneweave.sim_bridge.bodies.overlaps_and_gaps import NO_NEIGHBOURS, Neighbours
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.bodies.record_store import RecordStore
from laneweave.sim_bridge.bodies.stop_lines import STANDING_MPS, StopLinesAhead

SLOWED_MPS = 2.0
"""Loss of speed from which a body does not enter another lane."""
RELEASE_M = 1.0
"""Spare distance, beyond the distance driven in a tick, at which an emergency ends. Without it,
favourable measurement errors would release the brake repeatedly, and lost distance add up."""


class OffLatticePhase(Enum):
    """What a vehicle without a cell does."""

    WAITING = "waiting"
    """It drives up to the stop line of its lane, and waits there."""
    RE_ENTERING = "re-entering"
    """It drives into the neighbouring lane, towards the cell in which it will enter."""


class FallbackLevel(IntEnum):
    """Fallback level; see the module docstring."""

    EXECUTE = 0
    HOLD = 1
    GIVE_WAY = 2
    EMERGENCY = 3


@define
class MotionController:
    """The motion controller of one vehicle."""

    plant: Plant
    _scenario: Scenario
    hold_cell: Cell
    _moves: frozenset[Cell] = NEIGHBOURING
    """Moves (columns, lanes) that the type of the vehicle drives."""
    occupancy: Occupancy | None = None
    """Cells of other vehicles; None: not known."""
    refusal: Refusal | None = None
    """The newest refusal that is not reported yet."""
    store: RecordStore = field(init=False)
    motion: CurrentMotion = field(init=False)
    command_tick: int = -1
    """Tick of the newest command; -1: none."""
    level: FallbackLevel = FallbackLevel.HOLD
    """Level in the last tick."""
    level_ticks: dict[FallbackLevel, int] = field(init=False)
    """Number of ticks spent on each level."""
    neighbours: Neighbours = NO_NEIGHBOURS
    """Measured neighbours."""
    off_lattice: OffLatticePhase | None = None
    """None: the vehicle has cells."""
    broken_mps2: float | None = None
    """Deceleration with which a broken-down vehicle stops and stands; None: it drives."""
    stays: bool = False
    """Whether it waits where it stands, not at a stop line."""
    _measured: State | None = None
    _jerks: array[float] = field(init=False)
    """Pairs (along, across) for successive ticks [m/s3]."""
    _jerks_tick: int = 0
    """Tick of the first pair."""
    lattice: Lattice = field(init=False)
    tick_s: float = field(init=False)
    _brake: EmergencyBrake = field(init=False)
    _lane_gaps: LaneGaps = field(init=False)
    stop_lines: StopLinesAhead = field(init=False)
    _guard: CellGuard = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Begin without a trajectory, in the block of the cell."""
        self.lattice = self._scenario.lattice
        self.tick_s = self._scenario.runtime.tick_s
        # The other blocks of the formation are not known until it is closed.
        record = VehicleRecord(joined=(self.lattice.block_of(self.hold_cell[0]),))
        self.store = RecordStore(record, territory_of(self._scenario), self.lattice.lanes)
        self.motion = CurrentMotion(self.hold_cell)
        self.level_ticks = dict.fromkeys(FallbackLevel, 0)
        self._jerks = array("f")
        self._brake = EmergencyBrake(self._limits, self._scenario.braking, self.tick_s)
        self._lane_gaps = LaneGaps(self._scenario)
        self.stop_lines = StopLinesAhead(self._scenario, self._limits)
        self._guard = CellGuard(self._scenario, self._limits)

    @property
    def record(self) -> VehicleRecord:
        """What the controller stores for the process in charge."""
        return self.store.record

    @property
    def _limits(self) -> Vehicle:
        """Size and limits of the vehicle."""
        return self.plant.limits

    @property
    def measured(self) -> State:
        """Measured state of the body; exact before the first measurement."""
        return self.plant.state if self._measured is None else self._measured

    def perceive(self, measured: State, neighbours: Neighbours) -> None:
        """Set the measurements of this tick."""
        self._measured, self.neighbours = measured, neighbours

    @property
    def occupied(self) -> frozenset[Cell]:
        """Cells of the vehicle: its cell, or the footprint of the move in progress."""
        if self.off_lattice is OffLatticePhase.WAITING:
            return frozenset()
        return self._guard.region(self.hold_cell)

    def end_move(self, t_s: float) -> None:
        """End the move in progress if the body rests in its cell at road time `t_s`.

        Called before each SENSE, so before any process can report the end.
        """
        self._guard.update(self.measured, self.hold_cell, t_s)

    # --- lanes that end -----------------------------------------------------------------------

    def has_lost_cell(self, t_s: float) -> bool:
        """Return whether the hold cell has passed the stop line of the lane in which the body is.

        A body that is partly in the lane of its hold cell continues its move. One that has driven
        out of another lane may come to a line, too, if it could not settle before. A body that
        drives partly in another lane keeps its cell if others would be led into it.
        """
        if self.off_lattice is OffLatticePhase.WAITING or not self.stop_lines.lane_ends:
            return False
        leaves = self.off_lattice is OffLatticePhase.RE_ENTERING and self.stop_lines.passed
        stays_free = self.store.territory.given_up_cells_stay_free
        first, last = self.lattice.lanes_touched(self.measured[3], self._limits.width_m)
        if self.measured[1] > STANDING_MPS and (leaves or (not stays_free and first != last)):
            return False  # one that leaves its lane stands if the other one is closed meanwhile
        # Behind an exit the lane may belong to a ramp, to whose end the body does not come.
        cell = self.hold_cell if leaves else (self.hold_cell[0], self._body_lane)
        body_m = self.stop_lines.section_m(cell[1], self.measured[0])
        if not stays_free and self.off_lattice is None and first == last == self.hold_cell[1]:
            t_s += self._scenario.timing.cycles_s[0] - LATE_S  # no move can lead it out any more
        return self.stop_lines.lane_ends.has_passed(cell, t_s, body_m=body_m)

    @property
    def keeps_lane(self) -> bool:
        """Whether the body is in its lane, and no plan in force leads it out of its cell."""
        if self.off_lattice is None and self.hold_cell not in self.store.certain_cells:
            return False
        return abs(self.measured[3] - self.lattice.cell_y_m(self.hold_cell[1])) <= ARRIVED_ACROSS_M

    def has_missed_exit(self, t_s: float) -> bool:
        """Return whether a move into or out of the lane of an exit did not begin in time.

        The body is still in the lane in which the move began, and can no longer leave it.
        """
        return self.off_lattice is None and self._misses_exit(self.hold_cell, t_s)

    def _misses_exit(self, goal: Cell, t_s: float) -> bool:
        """Return whether it is too late to begin to leave the lane of the body for a cell."""
        ends, lane = self.stop_lines.lane_ends, self._body_lane_for(goal[1])
        return lane != goal[1] and ends.too_late((goal[0], lane), goal, t_s)

    def return_to_origin(self) -> bool:
        """Hold the cell in which the move began; return False if the vehicle may not.

        It may until a later plan takes the cell, which no vehicle that moves takes part in; in a
        formation, until the move is complete. Commands that repeat the move are not accepted.
        """
        origin = self.motion.origin
        touched = origin[1] == self._body_lane_for(origin[1])
        if not touched or not self.store.territory.may_hold(self.record, origin):
            return False
        self.stop_lines.taken_back = self.hold_cell
        self._guard.moving_from, self.hold_cell = self.hold_cell, origin
        self._stop_motion()
        return True

    @property
    def _body_lane(self) -> int:
        """Lane of the hold cell if the body touches it; otherwise the lane of the body's centre."""
        return self._body_lane_for(self.hold_cell[1])

    def _body_lane_for(self, goal: int) -> int:
        """Return a lane if the body touches it; otherwise the lane of the body's centre."""
        y_m = self.measured[3]
        first, last = self.lattice.lanes_touched(y_m, self._limits.width_m)
        return goal if first <= goal <= last else int(y_m // self.lattice.lane_width_m)

    def leave_lattice(self) -> None:
        """Give up all cells; no process can move the vehicle, which stays in its lane."""
        self.off_lattice, self._guard.moving_from = OffLatticePhase.WAITING, None
        self.hold_cell = (self.hold_cell[0], self._body_lane)
        self.store.give_up_cells()
        self._stop_motion()

    def re_enter(self, cell: Cell, passable: Iterable[int], *, keeps_distance: bool) -> None:
        """Start from standstill towards a cell that is kept free; see `StopLinesAhead.start`."""
        self.off_lattice, self.hold_cell = OffLatticePhase.RE_ENTERING, cell
        self.broken_mps2, self.stays = None, False
        s_m = self.measured[0]
        self.stop_lines.start(cell[1], passable, s_m, keeps_distance=keeps_distance)
        self._stop_motion()

    def enter_lattice(self, cells: Iterable[Cell]) -> None:
        """Take cells, among them the hold cell, in which the vehicle is."""
        self.off_lattice = None
        self.store.enter_block(self.lattice.block_of(self.hold_cell[0]), cells)

    def _stop_motion(self) -> None:
        self._jerks = self._jerks[:0]
        self.motion = CurrentMotion(self.hold_cell)

    def accept_command(self, command: Command) -> bool:
        """Accept a command from the process in charge, or from a newer one, which takes charge.

        A command is rejected if its incarnation is older than that of the process in charge, or if
        its tick is not later than that of the last command. One for another cell is rejected if no
        correct agent sends it (`command_checks.Problem`, `refusal`), or if it changes lanes in an
        emergency, beside another body, before one that could not brake for it, or too late for an
        exit. A newer incarnation takes charge. Its first command must keep the hold cell: no plan
        can allow a process to move the vehicle before it is in charge. A rejected process may try
        again at the next tick. Commands without jerks and with the current hold cell do not change
        the motion.

        Returns:
            Whether the command was accepted.

        Raises:
            BadInputError: the jerks are not pairs of finite numbers, a cell is not in a lane, or a
                number is out of range.
        """
        incarnation, in_charge = command.record.incarnation, self.record.incarnation
        if incarnation < in_charge or command.tick <= self.command_tick:
            return False
        try:
            jerks = checked_jerks(command, self.lattice)
        except BadInputError:
            self.refusal = Refusal(Problem.VALUES)
            raise
        leaves = command.hold_cell != self.hold_cell
        if self.off_lattice is not None and (leaves or len(jerks) > 0):
            return False
        if incarnation > in_charge:
            if leaves:
                return False
            self.store.put_in_charge(incarnation)
            self.stop_lines.taken_back = None
        self.command_tick = command.tick
        self.store_requests(command)
        t_s = command.tick * self.tick_s
        known = leaves or command.motion.origin in (self.hold_cell, self.motion.origin)
        if self.off_lattice is None and not known:
            self.refusal = Refusal(Problem.MOVE)
            return False
        if leaves:
            self.end_move(t_s)
            self.refusal = self._refusal_of_move(command)
            if self.refusal is not None:
                return False
        lane = command.hold_cell[1]
        if lane != self.hold_cell[1] and (
            self.level is FallbackLevel.EMERGENCY
            or not self._lane_gaps.allow(self.hold_cell[1], lane, self.neighbours, self.measured[1])
            or self._misses_exit(command.hold_cell, t_s)
            or not self.stop_lines.allow(command, t_s)
        ):
            return False
        if len(jerks) > 0 or leaves:
            if leaves:
                self._guard.moving_from = self.hold_cell
            self._jerks, self._jerks_tick = jerks, command.tick
            self.hold_cell = command.hold_cell
            self.motion = command.motion
        return True

    def _refusal_of_move(self, command: Command) -> Refusal | None:
        """Return why no correct agent sends a command for another cell; None: one may send it."""
        origin, target = self.hold_cell, command.hold_cell
        if target == self.stop_lines.taken_back:
            return None
        if self._guard.moving_from is not None or command.motion.origin != origin:
            return Refusal(Problem.MOVE)
        if (target[0] - origin[0], target[1] - origin[1]) not in self._moves:
            return Refusal(Problem.MOVE)
        if not self.store.territory.may_hold(self.record, target):
            return Refusal(Problem.NOT_OWNED)
        if self.occupancy is not None:
            occupant = self.occupancy.occupant(footprint(origin, target), self)
            if occupant is not None:
                return Refusal(Problem.OCCUPIED, occupant=occupant)
        return None

    def store_requests(self, command: Command) -> bool:
        """Store the record of a command for any tick; return whether anything has changed.

        Commands from processes other than the one in charge are ignored.
        """
        return self.off_lattice is None and self.store.store(command.record)

    def moving(self, tick: int) -> bool:
        """Return whether a motion is still in progress at `tick`.

        A late body continues to move after the planned end of its motion.
        """
        return tick < self.motion.end_tick or not at_rest_in_cell(
            self.measured, self.lattice, self.hold_cell, tick * self.tick_s
        )

    def has_settled(self, t_s: float) -> bool:
        """Return whether the body has settled in its cell at road time `t_s`."""
        return has_settled(self.measured, self.lattice, self.hold_cell, t_s)

    def displaced(self, tick: int) -> bool:
        """Return whether the body is too far from its cell to hold it at `tick`."""
        t_s, room_ahead_m = tick * self.tick_s, self._scenario.types.room_ahead_m
        return displaced(self.measured, self.lattice, self.hold_cell, t_s, room_ahead_m)

    def step(self, tick: int) -> None:
        """Advance from `tick` to the next one."""
        measured, plant, seen, t_s = self.measured, self.plant, self.stop_lines, tick * self.tick_s
        near: Sequence[Neighbour] = self.neighbours.ahead
        kept_out = bool(seen.lane_ends) and self.off_lattice is None
        if kept_out:
            kept_out = seen.keep_out(self.hold_cell, self._body_lane, t_s, near, measured[1])
        if near:
            near = self._relevant(near, measured[3], enters=not kept_out)
        stays = kept_out or self._must_stay_in_lane(tick)
        if seen.lane_ends and self.broken_mps2 is None:
            near = [*near, *seen.lines(measured, self.hold_cell, t_s, enters=not stays)]
        level, jerk = self._next(tick, near, stays=stays)
        if near and self._must_brake(measured, jerk, near):
            level = FallbackLevel.EMERGENCY
            # The body leaves its trajectory.
            self._jerks = self._jerks[:0]
            plant.brake(jerk[1])
        else:
            plant.step(*jerk, parks=self.stays or self.broken_mps2 is not None)
        self.level = level
        self.level_ticks[level] += 1
        self._measured = None

    def _next(
        self, tick: int, near: Sequence[Neighbour], *, stays: bool
    ) -> tuple[FallbackLevel, Jerk]:
        """Return the level and jerk for a tick without an emergency.

        `near`: neighbours and stop lines ahead; `stays`: `_must_stay_in_lane` in this tick.
        """
        t_s, guard = tick * self.tick_s, self._guard
        commanded = commanded_state(
            self.measured, self.plant.setpoint, self._limits, self.lattice.speed_mps
        )
        cells = guard.cells(self.measured, self.hold_cell)
        index = 2 * (tick - self._jerks_tick)
        if 0 <= index < len(self._jerks) and not stays:
            jerk = self._jerks[index], self._jerks[index + 1]
            excess_m = guard.excess_m(commanded, jerk, cells, t_s)
            if excess_m <= 0.0:
                return FallbackLevel.EXECUTE, jerk
            self.refusal = Refusal(Problem.LEAVES_CELLS, excess_m)
            self._jerks = self._jerks[:0]
        level, jerk = self._hold(tick, near, commanded, stays=stays)
        if self.off_lattice is None:
            jerk = guard.keep_in_cells(commanded, jerk, cells, t_s)
        return level, jerk

    def _hold(
        self, tick: int, near: Iterable[Neighbour], state: State, *, stays: bool
    ) -> tuple[FallbackLevel, Jerk]:
        """Return level and jerk for driving from a commanded state into the cell; see `_next`."""
        limits, body = self._limits, self.measured
        goal = cell_state(self.lattice, self.hold_cell, tick * self.tick_s)
        if self.off_lattice is OffLatticePhase.WAITING:
            goal = (state[0], *goal[1:])  # at v_F in its lane, up to the line
            stands = self.stays and body[1] < STANDING_MPS
            brake_mps2 = -limits.min_accel_mps2 if stands else self.broken_mps2
            if brake_mps2 is not None:
                return FallbackLevel.HOLD, stop_law(state, goal, brake_mps2, limits, self.tick_s)
        elif stays:
            goal = (*goal[:3], self.lattice.cell_y_m(self._body_lane), 0.0, 0.0)
        jerk = hold_law(state, goal, limits, self.tick_s)
        lag_s, goal_lane = limits.actuator_lag_s, self.hold_cell[1]
        ahead = [
            (
                other.gap_m + lag_s * (other.speed_mps - body[1]),
                other.speed_mps + lag_s * other.accel_mps2,
            )
            for other in near
            if self.stop_lines.brakes_early(other.lane, goal_lane)
        ]
        min_gap_m = self._scenario.tracking.min_gap_m
        careful = keep_gap(state, jerk, ahead, limits, min_gap_m, self.tick_s)
        return (FallbackLevel.HOLD if careful == jerk else FallbackLevel.GIVE_WAY), careful

    def _must_stay_in_lane(self, tick: int) -> bool:
        """Return whether the body must not enter the lane of its hold cell.

        Vehicles in that lane expect it between the cells of its move, and as fast as they are. A
        body that has had to brake stays in its lane until it has caught up. One that is partly in
        the other lane already is seen there, and goes on.
        """
        if self._body_lane == self.hold_cell[1] or self.off_lattice is not None:
            return False
        if self._lane_gaps.blocked(self.hold_cell[1], self.neighbours, self.measured[1]):
            return True  # a body has come too near meanwhile
        s_m, speed_mps = self.measured[:2]
        columns = self.motion.origin[0], self.hold_cell[0]
        t_s = tick * self.tick_s
        if self.has_missed_exit(t_s):
            return True
        rear_m = self.lattice.cell_s_m(min(columns), t_s) - DISPLACED_ALONG_M
        front_m = self.lattice.cell_s_m(max(columns), t_s)
        # One that still falls back to its cell is slower.
        slower_mps = SLOWED_MPS if s_m <= front_m + DISPLACED_ALONG_M else NEARLY_SETTLED_MPS
        # Only moves along the road change the speed.
        slowed = columns[0] == columns[1] and speed_mps < self.lattice.speed_mps - slower_mps
        front_m += max(DISPLACED_ALONG_M, self._scenario.types.room_ahead_m)
        return slowed or not rear_m <= s_m <= front_m

    def _must_brake(self, measured: State, jerk: Jerk, near: Iterable[Neighbour]) -> bool:
        """Return whether an emergency begins or continues."""
        limits, tick_s = self._limits, self.tick_s
        accel = self.plant.setpoint[0]
        # The jerk that the body will execute within its limits.
        speed = measured[1] + limits.actuator_lag_s * measured[2]
        allowed = (limited_accel(speed, accel, jerk[0], limits, tick_s) - accel) / tick_s
        spare_m = self._brake.spare_m(measured, accel, (allowed, 0.0), near)
        if self.level is FallbackLevel.EMERGENCY:
            return spare_m < RELEASE_M + measured[1] * tick_s
        return spare_m < 0.0

    def _relevant(
        self, others: Iterable[Neighbour], y_m: float, *, enters: bool
    ) -> list[Neighbour]:
        """Return the neighbours in lanes that the body touches or enters."""
        first, last = self.lattice.lanes_touched(y_m, self._limits.width_m)
        goal = self.hold_cell[1] if enters else first
        return [other for other in others if first <= other.lane <= last or other.lane == goal]
