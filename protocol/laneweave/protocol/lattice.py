"""The lattice: the relative coordinate system (RCS) of the paper, Section 2.2.

One endless lattice moves at the formation speed v_F along the road. A cell is (column, lane):
columns increase in the direction of travel, lanes to the left; both may be any integer. The cell
pitch is d_F along the road and the lane width across. Positions follow from the road clock:

    s(cell, t) = v_F t + column d_F         (front bumper, road start at s = 0)
    y(cell)    = (lane + 1/2) lane width    (body centre, right road edge at y = 0)

Column c passes the start of the road at t = -c d_F / v_F, so later vehicles have smaller columns.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from attrs import frozen

Cell = tuple[int, int]
"""(column, lane)."""

Mode = Literal[1, 2]
"""Relative motion mode: 1 allows moves to four neighbouring cells, 2 to eight."""

WAIT: Cell = (0, 0)
STRAIGHT: tuple[Cell, ...] = ((1, 0), (-1, 0), (0, 1), (0, -1))
OBLIQUE: tuple[Cell, ...] = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def displacements(mode: int) -> tuple[Cell, ...]:
    """Return the displacements that a vehicle may make in one step, in tie-breaking order.

    Waiting comes first, then straight moves, then oblique ones, so that planners break ties in
    favour of the simplest path.
    """
    return (WAIT, *STRAIGHT) if mode == 1 else (WAIT, *STRAIGHT, *OBLIQUE)


STRETCH_COLUMNS = 4
"""Columns per stretch; a vehicle receives motions in its own and both adjacent stretches."""

PlannedMove = tuple[int, Cell, Cell]
"""(step, from, to): move to a neighbouring cell in a step of a plan."""


def footprint(origin: Cell, target: Cell) -> frozenset[Cell]:
    """Return the cells that a move occupies: both ends, and the corners of an oblique move.

    A vehicle that holds (origin equal to target) occupies its cell.
    """
    (column, lane), (to_column, to_lane) = origin, target
    return frozenset({origin, target, (column, to_lane), (to_column, lane)})


def territory(start_cells: Iterable[Cell], moves: Iterable[PlannedMove]) -> frozenset[Cell]:
    """Return all cells that a plan may occupy: its start cells and the footprints of its moves."""
    cells = set(start_cells)
    for _, origin, target in moves:
        cells |= footprint(origin, target)
    return frozenset(cells)


def stretch_of(column: int) -> int:
    """Return the number of the stretch that contains a column."""
    return -column // STRETCH_COLUMNS


@frozen
class Lattice:
    """Geometry of the moving lattice and of its blocks of columns.

    Block number b has the columns -(b + 1) W + 1 .. -b W for block width W. Neither columns nor
    block numbers are ever reused. A formation owns one block or several consecutive ones; its
    number is that of its foremost block.
    """

    pitch_m: float
    """Column pitch d_F."""
    speed_mps: float
    """Lattice speed v_F."""
    lane_width_m: float
    lanes: int
    block_columns: int
    """Block width W in columns."""

    def cell_s_m(self, column: int, t_s: float) -> float:
        """Return the road position of a column at road time `t_s`."""
        return self.speed_mps * t_s + column * self.pitch_m

    def cell_y_m(self, lane: int) -> float:
        """Return the lateral position of a lane's centre line."""
        return (lane + 0.5) * self.lane_width_m

    def lanes_touched(self, y_m: float, width_m: float) -> tuple[int, int]:
        """Return the first and the last lane that a body of this width touches at `y_m`."""
        half_m, lane_m = 0.5 * width_m, self.lane_width_m
        return int((y_m - half_m) // lane_m), int((y_m + half_m) // lane_m)

    def passing_time_s(self, column: int, s_m: float = 0.0) -> float:
        """Return the road time at which a column passes position `s_m`."""
        return (s_m - column * self.pitch_m) / self.speed_mps

    def block_of(self, column: int) -> int:
        """Return the number of the block that contains a column."""
        return -column // self.block_columns

    def block_range(self, block: int) -> range:
        """Return the columns of a block in ascending order (rear first)."""
        return range(-(block + 1) * self.block_columns + 1, -block * self.block_columns + 1)

    def block_cells(self, block: int) -> frozenset[Cell]:
        """Return all cells of a block."""
        return frozenset(
            (column, lane) for column in self.block_range(block) for lane in range(self.lanes)
        )

    @staticmethod
    def interlaced(cell: Cell) -> bool:
        """Return whether a cell belongs to the interlaced structure (paper, Section 2.2)."""
        column, lane = cell
        return (column + lane) % 2 == 0
