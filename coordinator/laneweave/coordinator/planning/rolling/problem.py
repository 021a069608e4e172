"""The rolling planning problem and its plan."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property

import numpy as np
from attrs import Attribute, Factory, evolve, field, frozen
from numpy.typing import NDArray

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.protocol.lattice import WAIT, Cell, Mode
from laneweave.protocol.road_layout import LaneChange, LaneSection, open_sections
from laneweave.protocol.scenario.road_tables import LaneRule, Restriction, SolidLine
from laneweave.protocol.wire.messages import CAR

Numbers = float | NDArray[np.float64]
"""One number, or an array."""
ROUNDING_M = 1e-6
"""Tolerance for comparing positions."""

Section = tuple[float, float, int]
"""Begin and end of a lane section [m] for planning, and its index in `StreamRoad.sections`."""
CellPath = tuple[Cell, ...]
"""Cells at the beginning of each slot, from the current one to the end of the last section."""


@frozen
class MovingPart:
    """Part of a lane that all vehicles leave, and into which none may change; it may move."""

    lane: int
    from_m: float
    """Where it begins when slot 0 begins."""
    to_m: float
    advance_m: float
    """Distance that it travels in a slot."""


@frozen
class OpenRoad:
    """What of a road is open now."""

    sections: tuple[LaneSection, ...]
    """Where the lanes are open; a section keeps its number while parts of it are closed."""
    cleared: tuple[MovingPart, ...] = ()


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
    """Maximum number of rounds of improvement per annealing."""
    max_paths: int = 50_000
    """Maximum number of path searches (about 5 us each on the paper's road) per annealing."""
    anneals: int = 1
    """Maximum number of annealings per slot."""
    sections: tuple[LaneSection, ...] = Factory(
        lambda road: open_sections(road.lanes, road.length_m), takes_self=True
    )
    """Where the lanes are open; by default all of them from end to end."""
    early_m: float | None = None
    """Moves begin at any time of a slot, as soon as the body, without its first `early_m`, is where
    both lanes are open; None: at its beginning."""
    restrictions: tuple[Restriction, ...] = ()
    """Where vehicles of some types may not drive."""
    solid_lines: tuple[SolidLine, ...] = ()
    """Lines that vehicles may not cross."""
    cleared: tuple[MovingPart, ...] = ()
    """Parts of lanes that all vehicles leave."""
    closing: range = range(0)
    """Indices of the sections that end before a part that is closed for a time."""
    around_m: float | None = None
    """Position from which vehicles may move while parts of lanes are closed for a time; None: as
    always."""

    def rules_of(self, vehicle_type: str) -> list[LaneRule]:
        """Return the restrictions and solid lines that apply to a type of vehicle."""
        rules: list[LaneRule] = [*self.restrictions, *self.solid_lines]
        return [one for one in rules if one.applies_to(vehicle_type)]

    def forbidden_changes(
        self, vehicle_type: str, slot: Numbers
    ) -> Iterator[tuple[LaneChange, Numbers, Numbers]]:
        """Yield the lane changes that a type may not make, and from where to where [m].

        No part of the body may be there at any time of the move.

        Args:
            vehicle_type: the type.
            slot: index of the slot, or an array of them.
        """
        for one in self.rules_of(vehicle_type):
            for change in one.changes:
                yield change, one.from_m, one.to_m
        for part in self.cleared:
            from_m, to_m = self._extent_m(part, slot)
            for lane in (part.lane - 1, part.lane + 1):
                yield (lane, part.lane), from_m, to_m

    def places_to_leave(
        self, vehicle_type: str, slot: Numbers
    ) -> Iterator[tuple[int, Numbers, Numbers]]:
        """Yield the lanes that a type should not be in, and from where to where [m].

        Arguments as those of `forbidden_changes`.
        """
        for one in self.restrictions:
            if one.applies_to(vehicle_type):
                yield one.lane, one.from_m, one.to_m
        for part in self.cleared:
            yield part.lane, *self._extent_m(part, slot)

    def _extent_m(self, part: MovingPart, slot: Numbers) -> tuple[Numbers, Numbers]:
        """Return from where to where no part of a body may be at any time of a slot.

        A body that travels with the lattice touches the moving part if its rear is before the
        second position when the slot begins, and its front beyond the first when it ends.
        """
        moved_m = slot * part.advance_m
        return (
            part.from_m + moved_m + min(part.advance_m, self.advance_m),
            part.to_m + moved_m + max(part.advance_m - self.advance_m, 0.0),
        )

    def forbids(
        self, vehicle_type: str, change: LaneChange, slot: int, rear_m: float, front_m: float
    ) -> bool:
        """Return whether a type may not change lanes in a slot between two positions."""
        return any(
            own == change and rear_m < to_m - ROUNDING_M and front_m > from_m + ROUNDING_M
            for own, from_m, to_m in self.forbidden_changes(vehicle_type, slot)
        )

    def start_m(self, front_m: float, lanes: Iterable[int]) -> float:
        """Return where a move begins that is planned for a slot.

        Args:
            front_m: position of the front at the beginning of the slot.
            lanes: lanes of the move.
        """
        if self.early_m is None:
            return front_m
        opens_m = [
            begins_m
            for lane in lanes
            for _, to_m, number in self.lane_sections[lane]
            if front_m < self.line_m(number, to_m)
            and front_m < (begins_m := self.first_m(number)) <= front_m + self.advance_m
        ]
        return max(opens_m, default=front_m)

    def first_m(self, number: int) -> float:
        """Return the position of the front at which moves may begin in a section."""
        section = self.sections[number]
        begins_m = max(section.from_m, section.moves_from_m)
        return begins_m + self.body_m - (self.early_m or 0.0)

    def line_m(self, number: int, to_m: float) -> float:
        """Return where moves end before the end of a section, whose end for planning is `to_m`."""
        return max(to_m, self.sections[number].to_m) if self.sections[number].exit else to_m

    def as_open(self, now: OpenRoad | None) -> StreamRoad:
        """Return the road as it is open now; None: as always."""
        if now is None or (now.sections == self.sections and not now.cleared):
            return self
        sections = now.sections
        closing, sorting_m = range(len(self.sections), len(sections)), self.sorting_m
        if (closing or now.cleared) and self.around_m is not None:
            sorting_m = self.around_m, sorting_m[1]
        return evolve(
            self, sections=sections, sorting_m=sorting_m, closing=closing, cleared=now.cleared
        )

    def position_m(self, slot: int, column: int) -> float:
        """Return the position of a column at the beginning of a slot."""
        return column * self.pitch_m + slot * self.advance_m

    @cached_property
    def lane_sections(self) -> tuple[tuple[Section, ...], ...]:
        """The sections of each lane, in the direction of travel.

        Each begins where it opens, or where moves into it may begin: a body that changes lanes so
        early does not touch the lane before it opens.
        """
        by_lane = [
            sorted(
                (each.from_m, each.to_m, number)
                for number, each in enumerate(self.sections)
                if each.lane == lane
            )
            for lane in range(self.lanes)
        ]
        return tuple(tuple(self._passable(sections)) for sections in by_lane)

    def _passable(self, sections: list[Section]) -> Iterator[Section]:
        """Yield sections, shortened so that no vehicle can pass into the next one within a slot.

        At an exit vehicles leave the road, but paths would go on into the next section.
        """
        jump_m = self.advance_m + self.pitch_m
        next_m = [from_m - jump_m for from_m, _, _ in sections[1:]] + [math.inf]
        before_m = -math.inf
        for (from_m, to_m, number), latest_m in zip(sections, next_m, strict=True):
            yield min(from_m, max(self.first_m(number), before_m)), min(to_m, latest_m), number
            before_m = to_m

    @cached_property
    def first_end_m(self) -> float:
        """Position before which no section ends."""
        return min(to_m for sections in self.lane_sections for _, to_m, _ in sections)

    def section_at(self, slot: int, cell: Cell) -> Section | None:
        """Return the section in which a cell is when a slot begins, or beyond whose end.

        None: there is no such lane, or it has not begun there.
        """
        if not 0 <= cell[1] < self.lanes:
            return None
        position_m = self.position_m(slot, cell[0]) + ROUNDING_M
        begun = None
        for section in self.lane_sections[cell[1]]:
            if section[0] > position_m:
                break
            begun = section
        return begun

    def is_open(self, lane: int, rear_m: float, front_m: float) -> bool:
        """Return whether moves are possible in a lane everywhere between two positions."""
        return any(
            self.first_m(number) - self.body_m <= rear_m + ROUNDING_M
            and front_m <= self.line_m(number, to_m) + ROUNDING_M
            for _, to_m, number in self.lane_sections[lane]
        )

    def has_left(self, slot: int, cell: Cell) -> bool:
        """Return whether a cell is beyond the end of its section when a slot begins."""
        section = self.section_at(slot, cell)
        return section is not None and self.position_m(slot, cell[0]) > section[1] + ROUNDING_M

    def last_section(self, slot: int, path: CellPath) -> int:
        """Return the index of the section at whose end a path from a slot on ends; -1: none."""
        section = self.section_at(slot + len(path) - 1, path[-1])
        return -1 if section is None else section[2]


@frozen
class StreamCosts:
    """Costs of paths; a path that does not end at a target costs more than any other."""

    move: float = 0.3
    off_lane: float = 0.1
    """Cost of each slot at whose beginning the vehicle is outside its target sections."""
    backward: float = 2.0
    """Extra cost of a move that loses a column: the vehicle arrives later."""
    forward: float = 2.0
    """Extra cost of a move that gains a column: the vehicle arrives earlier, but needs more energy
    than for a move that loses one (decision 76). A negative cost rewards gaining columns."""
    missing: float = 60.0
    """Cost of ending elsewhere than at a target; up to twice as much near the end."""
    closing: float = 10.0
    """Extra cost of each slot in a lane that ends before a part that is closed for a time."""
    cleared: float = 120.0
    """Cost of each slot in a part of a lane that is cleared; then that of `restricted`, too."""
    restricted: float = 20.0
    """Cost of each slot in which the vehicle drives where it may not; less on long roads, since the
    costs of a path must remain below those of forbidden moves."""


def _as_set(targets: int | Iterable[int]) -> frozenset[int]:
    return frozenset((targets,) if isinstance(targets, int) else targets)


@frozen
class StreamVehicle:
    """A vehicle on the road, at the beginning of a slot."""

    vehicle: str
    cell: Cell
    targets: frozenset[int] = field(converter=_as_set)
    """Sections by whose ends the vehicle may leave the road; on a straight road, target lanes."""
    held: bool = False
    """Whether the vehicle must stay in its cell, in all slots of the plan."""
    moves: frozenset[Cell] | None = None
    """Moves (columns, lanes) that the vehicle can drive; None: all of the mode."""
    waits: int = 0
    """Number of slots for which it stays in its cell first, since it settles there."""
    vehicle_type: str = CAR

    def drives(self, columns: int, lanes: int) -> bool:
        """Return whether the vehicle can drive a move."""
        move = columns, lanes
        return self.moves is None or move == WAIT or move in self.moves


@frozen
class StreamPlan:
    """Paths of all vehicles from one slot on."""

    slot: int
    paths: Mapping[str, CellPath]
    missed: tuple[str, ...]
    """Vehicles whose paths do not end at their targets."""
    rounds: int = 0
    """Number of rounds of improvement."""
    solve_ms: float = field(default=0.0, eq=False)
    """Wall-clock time of planning."""
