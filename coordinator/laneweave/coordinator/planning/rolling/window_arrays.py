"""Classes of the arrays of a window; see `arrays`.

Indices: slot s from the current one, column c from the window's lowest, lane, and displacement d
as numbered by `displacements`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]


class Table(NamedTuple):
    """The moves of all vehicles, and the penalties of conflicting moves."""

    load: Singles
    """Sum of the penalties of all vehicles whose moves conflict with this move, plus a multiple of
    `FIXED` if it is forbidden; (slots, displacements, lanes, columns)."""
    vehicle: NDArray[np.int32]
    """Vehicle in each cell at the beginning of each slot, -1: none; (slots, lanes, columns)."""
    move: NDArray[np.int8]
    """Displacement of that vehicle in the slot; same shape."""
    offsets: Ints
    """Relative column and lane, displacement and penalty factor of each conflicting move;
    (conflicts, 4)."""
    first: Ints
    """Index in `offsets` of the first conflict of each displacement; (displacements + 1)."""
    steps: Ints
    """Column and lane of each displacement; (displacements, 2)."""
    moving_columns: Ints
    """First and last column in which moves may start in each slot; (slots, 2)."""
    forbidden: Singles
    """`UNREACHED` for each move that the types of a group may not make, otherwise 0;
    (groups - 1, slots, displacements, lanes, columns). Group 0 may make all moves."""
    zone: NDArray[np.int16]
    """Zone in which each cell is at the beginning of each slot; (slots + 1, lanes, columns). A zone
    is a section, with what is beyond its end, or a part of one that some groups should leave; -1:
    no section, if there are no such parts."""
    left: Bools
    """Whether each cell is beyond the end of its section; same shape."""
    first_left: Ints
    """First column of each lane beyond the end of a section; (slots + 1, lanes)."""
    road_end: Ints
    """First column from which all cells are beyond the ends of their sections; (slots + 1)."""
    mixed: Bools
    """Whether the cells of each lane are in different zones; (lanes)."""


class Paths(NamedTuple):
    """The vehicles, sorted by column, and their paths; the first index is the vehicle."""

    column: Ints
    """Column at the beginning of each slot; (vehicles, slots + 1)."""
    lane: Ints
    move: NDArray[np.int8]
    """Displacements; (vehicles, slots)."""
    slots: Ints
    """Number of slots in the path up to the end of its last section."""
    target: Bools
    """Whether each zone is in a target, and False for no section; (vehicles, zones)."""
    zone_cost: Singles
    """Cost of each slot that begins in a zone; same shape."""
    group: Ints
    """Index of the group of types to which the vehicle belongs."""
    held: Bools
    waits: Ints
    """Number of slots in which the vehicle stays first."""
    drives: Bools
    """Whether the vehicle can drive each displacement; (vehicles, displacements)."""
    missing_cost: Floats
    """Cost of ending elsewhere than at a target."""
    min_cost: Floats
    """Lower bound on the cost of paths that end at a target."""
    can_arrive: Bools
    """Whether there are enough slots to reach a target, ignoring other vehicles."""
    urgent_cost: Floats
    """Cost from which ejection chains make room for a vehicle that can arrive."""
    penalty: Ints
    """Cost to other vehicles of a conflict with this one."""
    cost: Floats
    placed: Bools
    """Whether the path is in the table."""


class Costs(NamedTuple):
    """`StreamCosts` for the compiled code."""

    of_move: Singles
    """Cost of each displacement."""
    restricted: np.float32


class Saved(NamedTuple):
    """Paths as they were before a change that may be undone."""

    vehicle: Ints
    slots: Ints
    cost: Floats
    move: NDArray[np.int8]
    column: Ints
    lane: Ints


class Scratch(NamedTuple):
    """Working memory of the search, allocated once."""

    saved: Saved
    marked: Bools
    """Whether each vehicle's path is saved."""
    value: Singles
    """Minimum cost of reaching a cell; (slots + 1, lanes, columns around the start, and one unused
    column on either side)."""
    delay: Singles
    """Extra cost of a move in each slot."""
    row: Singles
    """Minimum costs of a lane in a slot, including those of cells outside target sections."""
    searches: Ints
    """(1,) number of path searches."""
    queue: Ints
    hit: Ints
    chosen: Ints
    off_lane: Ints
    costly: Ints
    """These work lists have room for all vehicles."""


class Window(NamedTuple):
    """All arrays for planning one slot."""

    low: int
    """Lattice column of the window's lowest column."""
    table: Table
    paths: Paths
    costs: Costs
    scratch: Scratch
