"""The rolling planning problem and its plan."""

from __future__ import annotations

from collections.abc import Mapping

from attrs import Attribute, field, frozen

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.protocol.lattice import Cell, Mode

CellPath = tuple[Cell, ...]
"""Cells at the beginning of each slot, from the current slot to the end of the road."""


def _one_per_cell(_road: object, _field: Attribute[ConflictModel], model: ConflictModel) -> None:
    if model.vehicles_share_cells:
        raise ValueError(f"conflict kinds {model.kinds} let vehicles share a cell")


@frozen
class StreamRoad:
    """The road in terms of the lattice, and the limits of the search."""

    lanes: int
    pitch_m: float
    """Cell length d_F."""
    advance_m: float
    """Distance that the lattice travels in a slot: v_F T_F."""
    sorting_m: tuple[float, float]
    """Segment S3: moves happen while the whole body is between these positions."""
    length_m: float
    """End of the road."""
    body_m: float
    """Length of a body; the position of a cell is that of the front bumper."""
    mode: Mode = 1
    model: ConflictModel = field(
        default=ConflictModel(("node", "edge", "special-1", "closing")), validator=_one_per_cell
    )
    rounds: int = 2000
    """Maximum number of rounds of improvement per slot."""
    max_paths: int = 50_000
    """Maximum number of path searches (about 5 us each) per slot."""


@frozen
class StreamCosts:
    """Costs of paths; a path that ends off the target lane costs more than any other."""

    move: float = 0.3
    off_lane: float = 0.1
    """Cost of each slot that begins off the target lane."""
    backward: float = 2.0
    """Extra cost of a move that loses a column."""
    forward: float = 0.0
    """Extra cost of a move that gains a column; a negative cost rewards gaining columns."""
    missing: float = 60.0
    """Cost of ending off the target lane; up to twice as much near the end of the road."""


@frozen
class StreamVehicle:
    """A vehicle on the road, at the beginning of a slot."""

    vehicle: str
    cell: Cell
    lane: int
    """The target lane."""
    held: bool = False
    """Whether the vehicle must stay in its cell."""


@frozen
class StreamPlan:
    """Paths of all vehicles from one slot on."""

    slot: int
    paths: Mapping[str, CellPath]
    missed: tuple[str, ...]
    """Vehicles whose paths do not end in their target lanes."""
    rounds: int = 0
    """Number of rounds of improvement."""
    solve_ms: float = field(default=0.0, eq=False)
    """Wall-clock time of planning."""
