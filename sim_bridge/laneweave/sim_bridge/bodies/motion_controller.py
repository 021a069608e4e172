"""A vehicle's motion controller, which outlives the vehicle's agent process.

It drives on one of the rungs of a fallback ladder, `Rung`, and on its own only moves down:

    play        executes the trajectory of the newest command until it ends
    hold        comes to rest in the cell that the last command named, and stays there at v_F
    give way    does the same, with comfortable braking behind a vehicle ahead
    emergency   brakes as hard as the vehicle can, as long as `EmergencyBrake` requires

A vehicle whose agent has just died, or whose commands have just been lost, still plays. A
trajectory that has ended or that an emergency interrupted is not resumed: only a new command leads
back up. The emergency brake acts on every rung and uses local sensing only.

The controller also stores what must survive the agent, and what a replaced agent must not change:
the process in charge of the vehicle, the formations that it has joined, the plan that the process
in charge has accepted, and in the rolling operation the highest promise and the cells that the
vehicle owns. Only the process in charge changes where the vehicle holds or what it plays.
"""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Iterable, Sequence
from enum import IntEnum

from attrs import define, evolve, field

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import EmergencyBrake
from laneweave.protocol.vehicle.motion import (
    Jerk,
    State,
    at_rest_in_cell,
    cell_state,
    commanded_state,
    hold_law,
    keep_gap,
    limited_accel,
)
from laneweave.protocol.wire.messages import Ballot, Command, Neighbour, PendingTransfer
from laneweave.sim_bridge.bodies.overlaps_and_gaps import NO_NEIGHBOURS, Neighbours
from laneweave.sim_bridge.bodies.plant import Plant

MAX_COLUMN = 2**31 - 1
"""Columns are recorded with 32 bits; no vehicle gets this far. Formation numbers are smaller."""
RELEASE_M = 1.0
"""An emergency ends when the spare distance exceeds that of one tick, which every tick of braking
gains, by this margin. Without a margin each favourable measurement error would release the brake,
and these errors would add up."""


class Rung(IntEnum):
    """What a vehicle executes; see the module."""

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
    attendant: int = 0
    """Incarnation of the process in charge; 0: none yet."""
    joined: tuple[int, ...] = field(init=False)
    """Formations whose blocks the vehicle's plans may use, ascending; it only ever grows."""
    accepted: Ballot | None = None
    """Newest plan that the process in charge has accepted."""
    promised: Ballot | None = None
    """Highest ballot that any process in charge has promised (rolling operation): a promise also
    binds later processes."""
    owned: tuple[Cell, ...] = ()
    """Cells that the vehicle owns, ascending (rolling operation)."""
    transfer: PendingTransfer | None = None
    """Newest transfer of cells, pending or completed."""
    _granted: frozenset[Cell] = frozenset()
    """Cells from the roadside that no plan contains yet."""
    motion_origin: Cell = field(init=False)
    motion_end_tick: int = 0
    motion_ticks: int = 0
    """Planned duration of the current move; 0: it settles, or holds."""
    command_tick: int = -1
    """Tick of the newest command; -1: none yet."""
    rung: Rung = Rung.HOLD
    """Rung of the last tick."""
    rung_ticks: dict[Rung, int] = field(init=False)
    """Ticks on each rung."""
    around: Neighbours = NO_NEIGHBOURS
    """Its measured neighbours."""
    _measured: State | None = None
    _jerks: array[float] = field(init=False)
    """Pairs (along, across), one for each tick."""
    _jerks_tick: int = 0
    """Tick of the first pair."""
    lattice: Lattice = field(init=False)
    tick_s: float = field(init=False)
    _brake: EmergencyBrake = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Begin without a trajectory, in the formation of the cell."""
        self.lattice = self._scenario.lattice
        self.tick_s = self._scenario.runtime.tick_s
        # The other blocks of its formation are known when that is closed.
        self.joined = (self.lattice.block_of(self.hold_cell[0]),)
        self.motion_origin = self.hold_cell
        self.rung_ticks = dict.fromkeys(Rung, 0)
        self._jerks = array("f")
        self._brake = EmergencyBrake(self._scenario)

    @property
    def rolling(self) -> bool:
        """Whether vehicles own cells, not formations blocks."""
        return self._scenario.formation.rolling

    @property
    def measured(self) -> State:
        """Measured state of the body; the exact one before the first measurement."""
        return self.plant.state if self._measured is None else self._measured

    def perceive(self, measured: State, around: Neighbours) -> None:
        """Set the measurements of this tick."""
        self._measured, self.around = measured, around

    def accept_command(self, command: Command) -> bool:
        """Take a command of the process in charge, or of one that takes charge with it.

        A command is refused when its incarnation is lower than that of the process in charge, when
        one of this tick or a later one has been taken, or when it names a cell that the vehicle
        does not own (where vehicles own cells). A higher incarnation takes charge. It must name the
        cell in which the vehicle already holds: before, it could not act for the vehicle, so no
        plan can allow it to move. A refused process may try again at the next tick.

        A command without jerks that names the cell in which the vehicle holds does not change the
        current motion.

        Returns:
            Whether it was taken.

        Raises:
            BadInputError: the jerks are not pairs of finite numbers, a cell is on no lane, or a
                number is out of range.
        """
        if command.incarnation < self.attendant or command.tick <= self.command_tick:
            return False
        jerks = self._checked_jerks(command)
        if command.incarnation > self.attendant and command.hold_cell != self.hold_cell:
            return False
        if command.incarnation > self.attendant:
            self.put_in_charge(command.incarnation)
        self.command_tick = command.tick
        self.store_requests(command)
        leaves = command.hold_cell != self.hold_cell
        if self.rolling and leaves and command.hold_cell not in self.owned:
            return False
        if len(jerks) > 0 or leaves:
            self._jerks, self._jerks_tick = jerks, command.tick
            self.hold_cell = command.hold_cell
            self.motion_origin = command.motion_origin
            self.motion_end_tick = command.motion_end_tick
            self.motion_ticks = command.motion_ticks
        return True

    def put_in_charge(self, incarnation: int) -> None:
        """Put another process in charge; the current motion continues.

        Raises:
            ValueError: the incarnation is not higher than that of the process in charge.
        """
        if incarnation <= self.attendant:
            raise ValueError(f"incarnation {incarnation} is not above {self.attendant}")
        self.attendant = incarnation
        self.accepted = None

    def store_requests(self, command: Command) -> bool:
        """Note what the process in charge requests, whatever the tick of its command.

        Returns:
            Whether anything has changed.
        """
        if command.incarnation != self.attendant:
            return False
        asked = command.joined, command.accepted, command.promised, command.transfer
        if asked == (self.joined, self.accepted, self.promised, self.transfer):
            return False  # the usual case
        if not _in_range(command.joined):
            return False
        before = self.joined, self.accepted, self.promised, self.transfer
        self.join(command.joined)
        if command.transfer is not None and command.transfer.open:
            self.complete_transfer(command.transfer.ballot)
        if command.promised is not None:
            self.store_promise(command.promised)
        if command.transfer is not None and not command.transfer.open:
            self.begin_transfer(command.transfer)
        if command.accepted is not None:
            self.store_acceptance(command.accepted)
        return (self.joined, self.accepted, self.promised, self.transfer) != before

    def store_acceptance(self, ballot: Ballot) -> None:
        """Note a plan that the process in charge has accepted, unless it is older.

        Where vehicles own cells, its transfer must be pending.
        """
        if self.rolling and (self.transfer is None or self.transfer.ballot != ballot):
            return
        self.accepted = ballot if self.accepted is None else max(self.accepted, ballot)

    def store_promise(self, ballot: Ballot) -> None:
        """Note a promise, unless it is older."""
        self.promised = ballot if self.promised is None else max(self.promised, ballot)

    def begin_transfer(self, transfer: PendingTransfer) -> None:
        """Note the pending transfer of an accepted plan, unless a higher ballot is promised.

        Cells that the roadside has assigned since the plan was made stay with the vehicle.
        """
        newer = self.transfer is None or transfer.ballot > self.transfer.ballot
        if newer and self.promised is not None and transfer.ballot >= self.promised:
            self._granted -= set(transfer.before)
            self.transfer = _with_cells(transfer, self._granted)
            self.owned = self.transfer.before

    def complete_transfer(self, ballot: Ballot) -> None:
        """Complete the pending transfer: the start gate of its plan is open."""
        if self.transfer is not None and self.transfer.ballot == ballot and not self.transfer.open:
            self.owned, self.transfer = self.transfer.after, PendingTransfer(ballot, open=True)

    def assign_cell(self, cell: Cell) -> None:
        """Add an empty cell that the roadside has assigned to the vehicle."""
        self._granted |= {cell}
        self.owned = tuple(sorted({*self.owned, cell}))
        if self.transfer is not None and not self.transfer.open:
            self.transfer = _with_cells(self.transfer, {cell})

    def join(self, formations: Iterable[int]) -> None:
        """Note formations as joined."""
        self.joined = tuple(sorted({*self.joined, *formations}))

    def moving(self, tick: int) -> bool:
        """Return whether the current motion has not ended at `tick`.

        A late body is still moving although the time of its motion is over.
        """
        return tick < self.motion_end_tick or not at_rest_in_cell(
            self.measured, self.lattice, self.hold_cell, tick * self.tick_s
        )

    def step(self, tick: int) -> None:
        """Drive from `tick` to the next one."""
        measured, plant = self.measured, self.plant
        near: Sequence[Neighbour] = self.around.ahead
        if near:
            near = self._relevant(near, measured[3])
        rung, jerk = self._next(tick, near)
        if near and self._must_brake(measured, jerk, near):
            rung = Rung.EMERGENCY
            # The body leaves its trajectory.
            self._jerks = self._jerks[:0]
            plant.brake(jerk[1])
        else:
            plant.step(*jerk)
        self.rung = rung
        self.rung_ticks[rung] += 1
        self._measured = None

    def _checked_jerks(self, command: Command) -> array[float]:
        for cell in (command.hold_cell, command.motion_origin):
            if not (0 <= cell[1] < self.lattice.lanes and abs(cell[0]) <= MAX_COLUMN):
                raise BadInputError("Command", cell, f"cells on {self.lattice.lanes} lanes")
        if not _in_range(command.joined):
            raise BadInputError("Command.joined", command.joined, f"at most {MAX_COLUMN}")
        if len(command.jerks) % 8:
            raise BadInputError("Command.jerks", f"{len(command.jerks)} bytes", "float32 pairs")
        jerks = array("f", command.jerks)
        if sys.byteorder == "big":
            jerks.byteswap()
        # Finite 32-bit numbers have a finite sum.
        if not math.isfinite(sum(jerks)):
            raise BadInputError("Command.jerks", "NaN or infinity", "finite numbers")
        return jerks

    def _next(self, tick: int, near: Iterable[Neighbour]) -> tuple[Rung, Jerk]:
        """Return rung and jerk of a tick without an emergency."""
        index = 2 * (tick - self._jerks_tick)
        if 0 <= index < len(self._jerks):
            return Rung.EXECUTE, (self._jerks[index], self._jerks[index + 1])
        limits, speed_mps = self._scenario.vehicle, self.lattice.speed_mps
        body = self.measured
        state = commanded_state(body, self.plant.setpoint, limits, speed_mps)
        goal = cell_state(self.lattice, self.hold_cell, tick * self.tick_s)
        jerk = hold_law(state, goal, limits, self.tick_s)
        lag_s = limits.actuator_lag_s
        ahead = [
            (
                other.gap_m + lag_s * (other.speed_mps - body[1]),
                other.speed_mps + lag_s * other.accel_mps2,
            )
            for other in near
        ]
        min_gap_m = self._scenario.tracking.min_gap_m
        careful = keep_gap(state, jerk, ahead, limits, min_gap_m, self.tick_s)
        return (Rung.HOLD if careful == jerk else Rung.GIVE_WAY), careful

    def _must_brake(self, measured: State, jerk: Jerk, near: Iterable[Neighbour]) -> bool:
        """Return whether an emergency begins or continues."""
        limits, tick_s = self._scenario.vehicle, self.tick_s
        accel = self.plant.setpoint[0]
        # The jerk that the body will execute: a command cannot brake harder than its limits.
        speed = measured[1] + limits.actuator_lag_s * measured[2]
        allowed = (limited_accel(speed, accel, jerk[0], limits, tick_s) - accel) / tick_s
        spare_m = self._brake.spare_m(measured, accel, (allowed, 0.0), near)
        if self.rung is Rung.EMERGENCY:
            return spare_m < RELEASE_M + measured[1] * tick_s
        return spare_m < 0.0

    def _relevant(self, others: Iterable[Neighbour], y_m: float) -> list[Neighbour]:
        """Return the neighbours on lanes that the body touches or moves to."""
        first, last = self.lattice.lanes_touched(y_m, self._scenario.vehicle.width_m)
        goal = self.hold_cell[1]
        return [other for other in others if first <= other.lane <= last or other.lane == goal]


def _with_cells(transfer: PendingTransfer, cells: Iterable[Cell]) -> PendingTransfer:
    """Return a transfer with additional cells that stay with the vehicle."""
    return evolve(
        transfer,
        before=tuple(sorted({*transfer.before, *cells})),
        after=tuple(sorted({*transfer.after, *cells})),
    )


def _in_range(formations: Iterable[int]) -> bool:
    return max(map(abs, formations), default=0) <= MAX_COLUMN
