"""A vehicle's own motion controller: it outlives the vehicle's agent process.

What it drives by is a ladder, `Rung`, and on its own it only ever goes down:

    play        the trajectory of the newest command, as far as it goes
    hold        to rest in the cell that the last command named, and stay there at v_F
    give way    the same, with comfortable braking behind whoever is ahead
    emergency   brakes as hard as the vehicle can, for as long as `EmergencyBrake` says so

Play is what a vehicle does whose agent is well, or died, or whose commands were lost a moment ago.
A trajectory that ran out or that an emergency interrupted is not taken up again: only a command
that comes now leads back up. The emergency brake acts on every rung, on local sensing alone.

It also keeps what must survive the agent, or must not be believed of one that has been replaced:
who is in charge of the vehicle, which formations it has joined, which plan the process in charge
has accepted, and in the rolling operation what any process has promised and which cells the vehicle
owns. Nobody but the process in charge changes where the vehicle holds or what it plays.
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
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.braking import EmergencyBrake
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
from laneweave.protocol.wire.messages import Ballot, Command, Deed, Neighbour
from laneweave.sim_bridge.bodies.overlaps_and_gaps import NOBODY_AROUND, Around
from laneweave.sim_bridge.bodies.plant import Plant

MAX_COLUMN = 2**31 - 1
"""Columns are recorded with 32 bits; no vehicle gets this far. Formations have lesser numbers."""


RELEASE_M = 1.0
"""An emergency is over when this much would be to spare beyond the way of a tick, which every tick
of braking gains. Were it nothing, the brake would be released at each favourable error of
measurement, and these would add up."""


class Rung(IntEnum):
    """What a vehicle drives by; see the module."""

    PLAY = 0
    HOLD = 1
    GIVE_WAY = 2
    EMERGENCY = 3


@define
class MotionController:
    """What the controller of one vehicle has been told last."""

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
    """Highest ballot that any process in charge has promised (rolling operation): a promise binds
    those who come after, so what is shown with it stays true."""
    estate: tuple[Cell, ...] = ()
    """Cells that the vehicle owns, ascending (rolling operation)."""
    deed: Deed | None = None
    """Newest plan by which cells change hands."""
    _granted: frozenset[Cell] = frozenset()
    """Cells that the roadside has given and that no plan has mentioned yet."""
    motion_origin: Cell = field(init=False)
    motion_end_tick: int = 0
    motion_ticks: int = 0
    """How many ticks the move under way was to take; 0: it settles, or holds."""
    command_tick: int = -1
    """Tick of the newest command; -1: none yet."""
    rung: Rung = Rung.HOLD
    """What it drove by in the last tick."""
    rung_ticks: dict[Rung, int] = field(init=False)
    """Ticks on each rung."""
    around: Around = NOBODY_AROUND
    """Whom its sensors see."""
    _measured: State | None = None
    _jerks: array[float] = field(init=False)
    """Along and across, one pair for each tick."""
    _jerks_tick: int = 0
    """Tick that the first of the jerks is for."""
    lattice: Lattice = field(init=False)
    tick_s: float = field(init=False)
    _brake: EmergencyBrake = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Begin with nothing to play, in the formation of the cell."""
        self.lattice = self._scenario.lattice
        self.tick_s = self._scenario.runtime.tick_s
        # Its formation's other blocks are not known before that is closed.
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
        """State of the body as its sensors measure it; the true one before they have."""
        return self.plant.state if self._measured is None else self._measured

    def perceive(self, measured: State, around: Around) -> None:
        """Take what its sensors measure now."""
        self._measured, self.around = measured, around

    def take(self, command: Command) -> bool:
        """Take a command of the process in charge, or of one that takes charge with it.

        A command is refused when its incarnation is less than the attendant's, when one of this
        tick or of a later one has been taken, or when it names a cell that the vehicle does not own
        (where vehicles own cells). A greater incarnation takes charge; it must name the
        cell in which the vehicle holds already: it could not speak for the vehicle before, so it
        cannot have got leave to move. Refused as well, it may try again with the next tick.

        A command without jerks that names the cell in which the vehicle holds leaves the motion
        under way as it is.

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
            self.hand_over(command.incarnation)
        self.command_tick = command.tick
        self.note(command)
        leaves = command.hold_cell != self.hold_cell
        if self.rolling and leaves and command.hold_cell not in self.estate:
            return False
        if len(jerks) > 0 or leaves:
            self._jerks, self._jerks_tick = jerks, command.tick
            self.hold_cell = command.hold_cell
            self.motion_origin = command.motion_origin
            self.motion_end_tick = command.motion_end_tick
            self.motion_ticks = command.motion_ticks
        return True

    def hand_over(self, incarnation: int) -> None:
        """Put a process in charge that does not drive: what is under way goes on as it is.

        Raises:
            ValueError: the incarnation is not greater than the attendant's.
        """
        if incarnation <= self.attendant:
            raise ValueError(f"incarnation {incarnation} is not above {self.attendant}")
        self.attendant = incarnation
        self.accepted = None

    def note(self, command: Command) -> bool:
        """Note what the process in charge asks for, whatever the tick of its command.

        Returns:
            Whether anything was new.
        """
        if command.incarnation != self.attendant:
            return False
        asked = command.joined, command.accepted, command.promised, command.deed
        if asked == (self.joined, self.accepted, self.promised, self.deed):
            return False  # in nearly every tick
        if not _in_range(command.joined):
            return False
        before = self.joined, self.accepted, self.promised, self.deed
        self.join(command.joined)
        if command.deed is not None and command.deed.open:
            self.take_possession(command.deed.ballot)
        if command.promised is not None:
            self.promise(command.promised)
        if command.deed is not None and not command.deed.open:
            self.draw_up(command.deed)
        if command.accepted is not None:
            self.accept(command.accepted)
        return (self.joined, self.accepted, self.promised, self.deed) != before

    def accept(self, ballot: Ballot) -> None:
        """Note a plan that the process in charge has accepted; an older one changes nothing.

        Nor does one whose deed has not been drawn up, where vehicles own cells.
        """
        if self.rolling and (self.deed is None or self.deed.ballot != ballot):
            return
        self.accepted = ballot if self.accepted is None else max(self.accepted, ballot)

    def promise(self, ballot: Ballot) -> None:
        """Note a promise; an older one changes nothing."""
        self.promised = ballot if self.promised is None else max(self.promised, ballot)

    def draw_up(self, deed: Deed) -> None:
        """Note the deed of an accepted plan, unless more has been promised since.

        The plan may have been made before the roadside gave a cell, which is kept all the same.
        """
        newer = self.deed is None or deed.ballot > self.deed.ballot
        if newer and self.promised is not None and deed.ballot >= self.promised:
            self._granted -= set(deed.before)
            self.deed = _with_cells(deed, self._granted)
            self.estate = self.deed.before

    def take_possession(self, ballot: Ballot) -> None:
        """Note that the start gate of the newest deed's plan is open."""
        if self.deed is not None and self.deed.ballot == ballot and not self.deed.open:
            self.estate, self.deed = self.deed.after, Deed(ballot, open=True)

    def own(self, cell: Cell) -> None:
        """Own a cell that nobody has entered in: the roadside says so."""
        self._granted |= {cell}
        self.estate = tuple(sorted({*self.estate, cell}))
        if self.deed is not None and not self.deed.open:
            self.deed = _with_cells(self.deed, {cell})

    def join(self, formations: Iterable[int]) -> None:
        """Remember formations as joined, for the process in charge."""
        self.joined = tuple(sorted({*self.joined, *formations}))

    def moving(self, tick: int) -> bool:
        """Tell whether the motion under way has not ended at `tick`.

        A body that is late still moves, though the time of its motion is over.
        """
        return tick < self.motion_end_tick or not at_rest_in_cell(
            self.measured, self.lattice, self.hold_cell, tick * self.tick_s
        )

    def step(self, tick: int) -> None:
        """Drive from `tick` to the next one."""
        measured, plant = self.measured, self.plant
        near: Sequence[Neighbour] = self.around.ahead
        if near:
            near = self._in_the_way(near, measured[3])
        rung, jerk = self._way(tick, near)
        # Who has nobody before it has nothing to brake for.
        if near and self._must_brake(measured, jerk, near):
            rung = Rung.EMERGENCY
            # The body is not where the trajectory would have it any more.
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
        # Finite numbers of 32 bits have a finite sum: one that is not tells of one that is not.
        if not math.isfinite(sum(jerks)):
            raise BadInputError("Command.jerks", "NaN or infinity", "finite numbers")
        return jerks

    def _way(self, tick: int, near: Iterable[Neighbour]) -> tuple[Rung, Jerk]:
        """Return what to drive by, and the jerk, if there is no emergency."""
        index = 2 * (tick - self._jerks_tick)
        if 0 <= index < len(self._jerks):
            return Rung.PLAY, (self._jerks[index], self._jerks[index + 1])
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
        least_m = self._scenario.tracking.min_gap_m
        careful = keep_gap(state, jerk, ahead, limits, least_m, self.tick_s)
        return (Rung.HOLD if careful == jerk else Rung.GIVE_WAY), careful

    def _must_brake(self, measured: State, jerk: Jerk, near: Iterable[Neighbour]) -> bool:
        """Tell whether there is an emergency, or one that goes on."""
        limits, tick_s = self._scenario.vehicle, self.tick_s
        accel = self.plant.setpoint[0]
        # What the body will make of the jerk: whoever commands it cannot wish it braked.
        speed = measured[1] + limits.actuator_lag_s * measured[2]
        allowed = (limited_accel(speed, accel, jerk[0], limits, tick_s) - accel) / tick_s
        spare_m = self._brake.spare_m(measured, accel, (allowed, 0.0), near)
        if self.rung is Rung.EMERGENCY:
            return spare_m < RELEASE_M + measured[1] * tick_s
        return spare_m < 0.0

    def _in_the_way(self, others: Iterable[Neighbour], y_m: float) -> list[Neighbour]:
        """Return who is on a lane that the body touches or that it steers for."""
        first, last = self.lattice.lanes_touched(y_m, self._scenario.vehicle.width_m)
        goal = self.hold_cell[1]
        return [other for other in others if first <= other.lane <= last or other.lane == goal]


def _with_cells(deed: Deed, cells: Iterable[Cell]) -> Deed:
    """Return a deed with cells that it leaves with the vehicle."""
    return evolve(
        deed,
        before=tuple(sorted({*deed.before, *cells})),
        after=tuple(sorted({*deed.after, *cells})),
    )


def _in_range(formations: Iterable[int]) -> bool:
    return max(map(abs, formations), default=0) <= MAX_COLUMN
