"""The table `formation` of a scenario file, and the names of solvers and conflicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import attrs
from attrs import field, frozen
from attrs.validators import optional

from laneweave.protocol.errors import unknown_name
from laneweave.protocol.field_validators import key_part, one_of, within, within_or_none
from laneweave.protocol.names import NAME_PATTERN
from laneweave.protocol.road_layout import LONGEST_ROAD_M
from laneweave.protocol.scenario.operations import (
    DEFAULT_OPERATION,
    OPERATIONS,
    ROLLING_SOLVER,
    OperationTraits,
)
from laneweave.protocol.wire.events import STREAM_PLANNED

BASE_CONFLICTS = ("node", "edge", "special-1")
DEFAULT_CONFLICTS: Mapping[int, tuple[str, ...]] = MappingProxyType(
    {1: BASE_CONFLICTS, 2: ("geometric",)}
)
"""Conflict kinds that planners avoid by default, by mode; formations also avoid `closing`."""
MAX_TARGETS = 400
"""Maximum number of cells that a plan request offers as targets."""
CONFLICT_KINDS = (
    "node",
    "edge",
    "special-1",
    "special-2",
    "special-3",
    "special-4",
    "geometric",
    "closing",
)
SNAPSHOT_S = 0.5
"""Time into a slot at which all its moves have begun and been reported.

The rolling operation plans the next slot one tick later, from the states up to this time, all of
which have arrived by then. So plans do not depend on message delays."""
READY_LATE_S = 1.2
"""Time into a slot until which a vehicle may become ready for the move that it makes in it."""
SLACK_S = 0.2
"""Part of T_F without motion if `formation.move_s` is not set."""
PAPERS_FORMATIONS: Mapping[str, object] = MappingProxyType(
    {
        "entry": "interlaced",
        "close": "columns",
        "cycle_s": 4.0,
        "targets": "parallel",
        "solver": "tappa",
    }
)
"""Values of the table `formation` that the former `operation = "paper"` selects."""
SOLVERS: Final = ("tappa", "branching")
"""Built-in solvers. `tappa`: the paper's algorithm. `branching`: branch and bound, for large
formations. Coordinators may have others (`laneweave.coordinator.planning.plug_ins`)."""


def solver_of_event(kind: str, data: Mapping[str, Any]) -> str | None:
    """Return the solver that an event reports, if any."""
    if kind == STREAM_PLANNED:
        return ROLLING_SOLVER
    solver = data.get("solver")
    return solver if isinstance(solver, str) and NAME_PATTERN.fullmatch(solver) else None


def _conflict_kinds(_: object, attribute: attrs.Attribute[Any], value: Sequence[str]) -> None:
    for kind in value:
        if kind not in CONFLICT_KINDS:
            allowed = "any of " + ", ".join(CONFLICT_KINDS)
            raise unknown_name(attribute.name, kind, CONFLICT_KINDS, allowed)


@frozen
class DrivingStructure:
    """A geometric structure in which formations drive before they sort (paper, Section 2.2)."""

    from_m: float = field(validator=within(0.0, LONGEST_ROAD_M))
    """Formations change to this structure once their rear has passed this position."""
    structure: str = field(validator=one_of("parallel", "interlaced"))
    lanes: tuple[int, ...] = ()
    """Lanes that the structure uses; empty: all lanes."""


@frozen
class FormationSettings:
    """Formation control parameters d_F, T_F and v_F, and settings of the planner."""

    operation: str = field(default=DEFAULT_OPERATION, validator=one_of(*OPERATIONS))
    """`formations`: closed formations, each sorted by one plan, as in the paper. `rolling`: no
    formations; the whole stream is replanned in each slot."""
    entry: str = field(default="free", validator=one_of("free", "interlaced"))
    """Cells that vehicles may enter in formations: all, or those of the interlaced structure."""
    close: str = field(default="vehicles", validator=one_of("vehicles", "columns"))
    """When a formation closes. `vehicles`: at `max_vehicles` vehicles or `max_columns` columns.
    `columns`: each has `block_columns` columns, as in the paper."""
    gap_m: float = field(default=15.0, validator=within(1.0, 200.0))
    """Column pitch d_F."""
    cycle_s: float | None = field(default=None, validator=within_or_none(0.5, 60.0))
    """T_F, the time slot of a step. None: in formations the longest from 4 to 7 s for which the
    road suffices, in the rolling operation a value by volume, and by the length of lanes that
    begin and end on the road, within limits (`Timing.cycles_s`)."""
    move_s: float | None = field(default=None, validator=within_or_none(0.5, 60.0))
    """Duration of a move within its slot; the rest is slack for lost messages. None: 0.2 s less
    than T_F."""
    speed_mps: float = field(default=15.0, validator=within(1.0, 60.0))
    """v_F, the speed of the lattice."""
    settle_s: float = field(default=10.0, validator=within(1.0, 60.0))
    """Time from when a vehicle enters until it has settled in its cell."""
    sort_in_s2: bool = False
    """Rolling operation: settled vehicles also change lanes in S2."""
    reward_drift: bool = False
    """Rolling operation: reward forward moves that cost no other vehicle anything."""
    change_columns: bool = True
    """Rolling operation: vehicles also move between columns. False: only between lanes."""
    block_columns: int = field(default=4, validator=within(1, 24))
    """Number of columns of a formation if `close` is `columns`."""
    max_columns: int = field(default=7, validator=within(1, 24))
    """Maximum length of a formation if `close` is `vehicles`."""
    max_vehicles: int = field(default=6, validator=within(1, 36))
    """Maximum size of a formation (paper: six)."""
    max_joined: int = field(default=1, validator=within(1, 4))
    """Maximum number of neighbouring formations in one ballot."""
    join: str = field(default="needed", validator=one_of("needed", "room"))
    """Condition for joining neighbouring formations. `needed`: one alone has too little room to
    sort. `room`: also if the vehicles of both fit into one formation."""
    structures: tuple[DrivingStructure, ...] = ()
    """Structures that formations take on in turn before they sort in S3; empty: vehicles stay in
    the cells in which they entered."""
    targets: str = field(default="lane", validator=one_of("lane", "parallel"))
    """Where vehicles with one goal lane sort into. `lane`: any cells of the lane. `parallel`:
    neighbouring cells of it, as in the paper."""
    mode: int = field(default=1, validator=one_of(1, 2))
    """Relative motion mode."""
    conflicts: tuple[str, ...] = field(default=(), validator=_conflict_kinds)
    """Conflict kinds that the planner avoids; empty: those of the mode, and `closing`."""
    weight_straight: int = field(default=1, validator=one_of(0, 1))
    """l_s of the formation relative distance."""
    weight_oblique: int | None = field(default=None, validator=one_of(None, 0, 1, 2))
    """l_o of the formation relative distance; None: the number of steps of an oblique edge."""
    solver: str | None = field(default=None, validator=optional(key_part))
    """Solver of formations, and of service requests that do not name one: built in, or a plug-in
    that the coordinators have installed. None: the planner chooses (`planning.solve`)."""
    planning_deadline_s: float | None = field(default=None, validator=within_or_none(0.01, 3600.0))
    """Maximum planning time; None: the time until the first move could begin, 1 to 15 s. On most
    machines `max_nodes` is reached first."""
    max_nodes: int = field(default=20_000, validator=within(1, 100_000_000))
    """Maximum number of search nodes per plan, independent of the machine's speed."""

    @property
    def traits(self) -> OperationTraits:
        """In what the selected operation differs from others."""
        return OPERATIONS[self.operation]

    def _has(self, field: str, value: object) -> bool:
        """Return whether a field has a value, and the operation uses the field."""
        return f"formation.{field}" not in self.traits.unused and getattr(self, field) == value

    @property
    def interlaced(self) -> bool:
        """Whether vehicles may enter only the cells of the interlaced structure."""
        return self._has("entry", "interlaced")

    @property
    def closes_by_vehicles(self) -> bool:
        """Whether the length of formations depends on the traffic."""
        return self._has("close", "vehicles")

    @property
    def moves_in_s2(self) -> bool:
        """Whether settled vehicles also change lanes in S2."""
        return self._has("sort_in_s2", True)

    @property
    def planner(self) -> str | None:
        """Name of the planner of the operation; None: the planner chooses a solver."""
        return self.traits.planner or self.solver

    @property
    def block_width(self) -> int:
        """Number of columns of a block; a formation owns one or more blocks."""
        return 1 if self.closes_by_vehicles else self.block_columns

    @property
    def max_length(self) -> int:
        """Maximum number of columns of a formation; without formations, 1."""
        if not self.traits.has_formations:
            return 1
        return self.max_columns if self.closes_by_vehicles else self.block_columns

    @property
    def longest_m(self) -> float:
        """Distance between the first and the last vehicle of the longest formation."""
        return (self.max_length - 1) * self.gap_m

    @property
    def slack_s(self) -> float:
        """Part of T_F without motion."""
        if self.cycle_s is None or self.move_s is None:
            return SLACK_S
        return self.cycle_s - self.move_s

    @property
    def entry_spacing_s(self) -> float:
        """Time between successive cells of a lane that vehicles may enter."""
        return (2.0 if self.interlaced else 1.0) * self.gap_m / self.speed_mps

    @property
    def bound_veh_per_lane_h(self) -> float:
        """Maximum flow [vehicles/(lane h)]: one vehicle for each cell that vehicles may enter.

        V_u = 3600 v_F / (2 d_F) with interlaced entry (paper, Section 5.2.3), twice that with free
        entry.
        """
        return 3600.0 / self.entry_spacing_s

    @property
    def entry_spread_s(self) -> float:
        """Maximum time between a vehicle and its cell as they pass the start of the road."""
        return self.traits.entry_spread * self.entry_spacing_s

    @property
    def oblique_steps(self) -> int:
        """Number of steps of an oblique edge: the largest l_o that is still a lower bound."""
        return 2 if self.mode == 1 else 1

    @property
    def conflict_kinds(self) -> tuple[str, ...]:
        """Conflict kinds that the planner avoids, defaults included."""
        if self.conflicts:
            return self.conflicts
        return (*DEFAULT_CONFLICTS[self.mode], "closing")

    @property
    def executable(self) -> bool:
        """Whether moves of one step have disjoint footprints, so that no timetable is needed."""
        kinds = set(self.conflict_kinds)
        return "geometric" in kinds or (self.mode == 1 and set(BASE_CONFLICTS) <= kinds)


def formation_columns(vehicles: int, lanes: int) -> int:
    """Return the minimum number of columns of a formation.

    With several lanes, at least as many cells as there are lanes stay free.

    Args:
        vehicles: number of vehicles.
        lanes: number of lanes; where some end, those that remain.
    """
    return math.ceil((vehicles + lanes) / lanes) if lanes > 1 else vehicles
