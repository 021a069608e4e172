"""A vehicle's own motion controller: it outlives the vehicle's agent process.

It plays the trajectory of the newest command. When that runs out - the agent died, fell silent, or
its commands were lost - it brings the vehicle to rest in the cell that the last command named and
holds there: the vehicle goes on driving at v_F in a cell that is its own.
"""

from __future__ import annotations

import numpy as np
from attrs import define, field
from numpy.typing import NDArray

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.messages import Command
from laneweave.protocol.motion import Jerk, cell_state, hold_law
from laneweave.protocol.scenario import Vehicle
from laneweave.sim_bridge.plant import Plant

MAX_COLUMN = 2**31 - 1
"""Columns are recorded with 32 bits; no vehicle gets this far."""


@define
class MotionController:
    """What the controller of one vehicle has been told last."""

    plant: Plant
    limits: Vehicle
    lattice: Lattice
    tick_s: float
    hold_cell: Cell
    motion_origin: Cell = field(init=False)
    motion_end_tick: int = 0
    command_tick: int = -1
    """Tick of the newest command; -1: none yet."""
    played_from_hold: int = 0
    """Ticks that were driven by the hold law, for want of a command."""
    _jerks: NDArray[np.float32] = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Begin with nothing to play."""
        self.motion_origin = self.hold_cell
        self._jerks = np.zeros((0, 2), dtype=np.float32)

    def take(self, command: Command) -> bool:
        """Take a command unless a newer one has been taken; false when it was ignored.

        Raises:
            BadInputError: the jerks are not pairs of finite numbers, or a cell is on no lane.
        """
        if command.tick <= self.command_tick:
            return False
        for cell in (command.hold_cell, command.motion_origin):
            if not (0 <= cell[1] < self.lattice.lanes and abs(cell[0]) <= MAX_COLUMN):
                raise BadInputError("Command", cell, f"cells on {self.lattice.lanes} lanes")
        if len(command.jerks) % 8:
            raise BadInputError("Command.jerks", f"{len(command.jerks)} bytes", "float32 pairs")
        jerks = np.frombuffer(command.jerks, dtype="<f4").reshape(-1, 2)
        if not np.isfinite(jerks).all():
            raise BadInputError("Command.jerks", "NaN or infinity", "finite numbers")
        self._jerks = jerks
        self.command_tick = command.tick
        self.hold_cell = command.hold_cell
        self.motion_origin = command.motion_origin
        self.motion_end_tick = command.motion_end_tick
        return True

    def step(self, tick: int) -> None:
        """Drive from `tick` to the next one."""
        self.plant.step(*self._jerk(tick))

    def _jerk(self, tick: int) -> Jerk:
        index = tick - self.command_tick
        if self.command_tick >= 0 and index < len(self._jerks):
            j_s, j_y = self._jerks[index].tolist()
            return j_s, j_y
        self.played_from_hold += 1
        reference = cell_state(self.lattice, self.hold_cell, tick * self.tick_s)
        return hold_law(self.plant.state, reference, self.limits, self.tick_s)
