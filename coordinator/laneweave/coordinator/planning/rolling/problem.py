"""What a stream planner is asked, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping

from attrs import Attribute, field, frozen

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Cell, Mode

Way = tuple[Cell, ...]
"""Cells at the beginning of each slot, the current one first, until the road ends."""


def _one_per_cell(_road: object, _field: Attribute[ConflictModel], model: ConflictModel) -> None:
    if not {"node", "geometric"} & set(model.kinds):
        raise ValueError(f"conflict kinds {model.kinds} let vehicles share a cell")


@frozen
class StreamRoad:
    """The road as the lattice sees it, and how the search is bounded."""

    lanes: int
    pitch_m: float
    """d_F."""
    advance_m: float
    """Way of the lattice in a slot: v_F T_F."""
    sorting_m: tuple[float, float]
    """Moves happen while the whole body is between these positions: S3."""
    length_m: float
    """End of the road."""
    body_m: float
    """Length of a body; the front bumper is what a cell's position says."""
    mode: Mode = 1
    model: ConflictModel = field(
        default=ConflictModel(("node", "edge", "special-1", "closing")), validator=_one_per_cell
    )
    rounds: int = 2000
    """Most rounds of improvement for one slot."""
    most_ways: int = 50_000
    """So many ways are looked for in one slot at most, for about 5 us each."""


@frozen
class StreamCosts:
    """What ways cost; whoever ends off its lane costs more than any way."""

    move: float = 0.3
    off_lane: float = 0.1
    """For each slot that begins off the lane."""
    backward: float = 2.0
    """More for a move that loses a column."""
    forward: float = 0.0
    """More for a move that gains one; negative: drift ahead of v_F is rewarded."""
    missing: float = 60.0
    """Ending off the lane; up to twice as much near the end of the road."""


@frozen
class StreamVehicle:
    """A vehicle on the road, at the beginning of a slot."""

    vehicle: str
    cell: Cell
    lane: int
    """The lane that it needs."""
    held: bool = False
    """It stays where it is, whatever is planned."""


@frozen
class StreamPlan:
    """Ways of all vehicles from one slot on."""

    slot: int
    ways: Mapping[str, Way]
    missed: tuple[str, ...]
    """Vehicles whose ways do not end on their lanes."""
    rounds: int = 0
    """How many rounds of improvement it took."""
    solve_ms: float = field(default=0.0, eq=False)
    """Wall-clock time that it took."""
