"""A plan request: vehicles, targets and rules, checked on construction.

The JSON form is fixed (`laneweave.plan.request/1`). Every error is a `BadInputError` that names the
field, the value and what is allowed. Unknown keys are errors, too: a misspelt preference must not
silently become "any target".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import attrs

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.formation_structures import (
    STRUCTURES,
    shortage,
    structure_targets,
)
from laneweave.coordinator.planning.geometry.conflict_table import conflict_table
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.problem import Problem
from laneweave.protocol.errors import BadInputError, one_line
from laneweave.protocol.field_validators import NAME_PATTERN, NAME_RULE
from laneweave.protocol.lattice import Cell, Mode, displacements
from laneweave.protocol.scenario.fields import CONFLICT_KINDS, DEFAULT_CONFLICTS
from laneweave.protocol.structuring import as_lists, structure

REQUEST_SCHEMA: Final = "laneweave.plan.request/1"
DEFAULT_DEADLINE_S: Final = 4.0

MAX_COLUMNS: Final = 1000
MAX_LANES: Final = 16
MAX_VEHICLES: Final = 200
MAX_TARGETS: Final = 400
MAX_ID_LENGTH: Final = 100
MAX_DEADLINE_S: Final = 3600.0

_NOT_BOTH: Final = "structure or targets, not both"


@attrs.frozen
class VehicleRequest:
    """One vehicle: its start cell, and the lane or the targets (indices) it may be assigned to.

    moves: moves (columns, lanes) that the vehicle can drive, besides waiting; None: all.
    """

    id: str
    cell: Cell
    lane: int | None = None
    eligible: tuple[int, ...] | None = None
    moves: tuple[Cell, ...] | None = None

    def choice(self, targets: Sequence[Cell]) -> frozenset[int]:
        """Return the indices of eligible targets: `eligible`, those in `lane`, or all."""
        if self.eligible is not None:
            return frozenset(self.eligible)
        lane = self.lane
        return frozenset(j for j, cell in enumerate(targets) if lane is None or cell[1] == lane)


@attrs.frozen
class PlanRequest:
    """Vehicles, targets and rules of one planning problem.

    targets: empty if a structure is given.
    structure: one of `STRUCTURES` (`formation_structures`); its cells are the targets.
    lanes: lanes of the structure; None: all.
    geometry: defines the conflict kind `geometric`; None: footprints.
    solver: name of a solver, built in or a plug-in where the request is answered; None: the
        default there.
    id: a service answers a repeated id with the same response; empty: no id.
    """

    grid: Grid
    mode: Mode
    conflicts: tuple[str, ...]
    vehicles: tuple[VehicleRequest, ...]
    targets: tuple[Cell, ...] = ()
    deadline_s: float = DEFAULT_DEADLINE_S
    geometry: BodyGeometry | None = None
    id: str = ""
    solver: str | None = None
    structure: str | None = None
    lanes: tuple[int, ...] | None = None

    def __attrs_post_init__(self) -> None:
        """Reject inconsistent requests.

        Raises:
            BadInputError: names the first field that is wrong.
        """
        _check_grid(self.grid)
        if self.mode not in (1, 2):
            raise BadInputError("mode", self.mode, "1 or 2")
        for i, kind in enumerate(self.conflicts):
            if kind not in CONFLICT_KINDS:
                raise BadInputError(f"conflicts[{i}]", kind, "any of " + ", ".join(CONFLICT_KINDS))
        _check_unique("conflicts", self.conflicts, "each kind once")
        if self.geometry is not None and "geometric" not in self.conflicts:
            allowed = "none, unless geometric is among conflicts"
            raise BadInputError("geometry", attrs.asdict(self.geometry), allowed)
        if self.solver is not None and not NAME_PATTERN.fullmatch(self.solver):
            raise BadInputError("solver", self.solver, f"the name of a solver: {NAME_RULE}")
        if self.structure is None:
            _check_count("targets", self.targets, MAX_TARGETS)
            for i, target in enumerate(self.targets):
                _check_cell(f"targets[{i}]", target, self.grid)
            _check_unique("targets", self.targets, "each cell once")
        _check_vehicles(self)
        _check_structure(self)
        if len(self.id) > MAX_ID_LENGTH:
            raise BadInputError("id", self.id, f"at most {MAX_ID_LENGTH} characters")
        if not (math.isfinite(self.deadline_s) and 0 < self.deadline_s <= MAX_DEADLINE_S):
            allowed = f"a number above 0, at most {MAX_DEADLINE_S:g}"
            raise BadInputError("deadline_s", self.deadline_s, allowed)

    @property
    def conflict_model(self) -> ConflictModel:
        """The definition of conflicts between moves."""
        table = None if self.geometry is None else conflict_table(self.geometry)
        return ConflictModel(self.conflicts, table)

    def problem(self) -> Problem:
        """Return the problem in the form that the searches use."""
        starts = [vehicle.cell for vehicle in self.vehicles]
        drivable = [vehicle.moves for vehicle in self.vehicles]
        return Problem(self.grid, self.mode, self.conflict_model, starts, self.targets, drivable)

    def choices(self) -> list[frozenset[int]]:
        """Return, per vehicle, the indices of the targets it may be assigned to."""
        return [vehicle.choice(self.targets) for vehicle in self.vehicles]

    @property
    def structure_lanes(self) -> Sequence[int]:
        """The lanes that a structure may use."""
        return range(self.grid.lanes) if self.lanes is None else self.lanes

    def resolved(self) -> PlanRequest:
        """Return the request with its structure, if it has one, replaced by targets."""
        if self.structure is None:
            return self
        cells = [vehicle.cell for vehicle in self.vehicles]
        preferred = [vehicle.lane for vehicle in self.vehicles]
        return self.with_targets(
            structure_targets(self.structure, self.structure_lanes, self.grid, cells, preferred)
        )

    def with_targets(self, targets: Sequence[Cell]) -> PlanRequest:
        """Return the request with these targets and without a structure."""
        return attrs.evolve(self, targets=tuple(targets), structure=None, lanes=None)

    @classmethod
    def from_dict(cls, data: object) -> PlanRequest:
        """Read the JSON form.

        Raises:
            BadInputError: names the first field that is wrong.
        """
        if not isinstance(data, Mapping):
            raise BadInputError("request", data, "an object")
        if data.get("schema") != REQUEST_SCHEMA:
            raise BadInputError("schema", data.get("schema"), repr(REQUEST_SCHEMA))
        _check_json("", data)
        if "targets" not in data and "structure" not in data:
            raise BadInputError("targets", None, "a list of cells; or a structure instead")
        if "targets" in data and "structure" in data:
            raise BadInputError("structure", data["structure"], _NOT_BOTH)
        document = structure(data, _Document)
        if document.mode not in (1, 2):
            raise BadInputError("mode", document.mode, "1 or 2")
        mode: Mode = 1 if document.mode == 1 else 2
        conflicts = DEFAULT_CONFLICTS[mode] if document.conflicts is None else document.conflicts
        fields = attrs.asdict(
            document, recurse=False, filter=lambda field, _: field.name != "schema"
        )
        return cls(**fields | {"grid": document.grid.grid(), "mode": mode, "conflicts": conflicts})

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the vehicles, in the order of the request."""
        return tuple(vehicle.id for vehicle in self.vehicles)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        fields = attrs.asdict(self, filter=_is_given, value_serializer=as_lists)
        return {"schema": REQUEST_SCHEMA, **fields}


@attrs.frozen
class _GridDocument:
    """The JSON form of a grid."""

    columns: int
    lanes: int
    blocked: tuple[Cell, ...] = ()

    def grid(self) -> Grid:
        """Return the grid."""
        grid = Grid(self.columns, self.lanes)
        _check_grid(grid)
        for i, cell in enumerate(self.blocked):
            if not grid.contains(cell):
                raise BadInputError(f"grid.blocked[{i}]", cell, "a cell in the grid")
        _check_unique("grid.blocked", self.blocked, "each cell once")
        return attrs.evolve(grid, blocked=self.blocked)


@attrs.frozen
class _Document:
    """The JSON form of a request; see `PlanRequest`."""

    schema: str
    grid: _GridDocument
    vehicles: tuple[VehicleRequest, ...]
    mode: int = 1
    conflicts: tuple[str, ...] | None = None
    targets: tuple[Cell, ...] = ()
    deadline_s: float = DEFAULT_DEADLINE_S
    geometry: BodyGeometry | None = None
    id: str = ""
    solver: str | None = None
    structure: str | None = None
    lanes: tuple[int, ...] | None = None


def _is_given(attribute: attrs.Attribute[Any], value: object) -> bool:
    """Return whether the JSON form contains a field."""
    return value is not None and value != "" and (attribute.name != "targets" or value != ())


def _check_json(parent: str, value: object) -> None:
    """Outside a geometry, reject nulls and keys that do not fit on one printable line."""
    items: Any = ()
    if isinstance(value, Mapping):
        prefix = f"{parent}." if parent else ""
        for key, item in value.items():
            shown = one_line(str(key), 80) or repr(key)
            if shown != key:
                raise BadInputError(prefix + shown, item, "only known keys")
        items = ((key, f"{prefix}{key}", item) for key, item in value.items())
    elif isinstance(value, list | tuple):
        items = ((i, f"{parent}[{i}]", item) for i, item in enumerate(value))
    for key, field, item in items:
        if item is None:
            raise BadInputError(field, None, "a value, or no such key")
        if key != "geometry":
            _check_json(field, item)


def _check_range(field: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise BadInputError(field, value, f"a whole number from {low} to {high}")


def _check_count(field: str, values: Sequence[object], maximum: int) -> None:
    if not 1 <= len(values) <= maximum:
        raise BadInputError(field, f"{len(values)} items", f"1 to {maximum} items")


def _check_unique(field: str, values: Sequence[object], allowed: str, name: str = "") -> None:
    """Reject duplicate values; `name` is the suffix of the field in each item."""
    first: dict[object, int] = {}
    for i, value in enumerate(values):
        if first.setdefault(value, i) != i:
            other = f"{field}[{first[value]}]"
            raise BadInputError(f"{field}[{i}]{name}", value, f"{allowed}; {other} has it, too")


def _check_grid(grid: Grid) -> None:
    _check_range("grid.columns", grid.columns, 1, MAX_COLUMNS)
    _check_range("grid.lanes", grid.lanes, 1, MAX_LANES)
    for cell in sorted(grid.blocked):
        if not grid.contains(cell):
            raise BadInputError("grid.blocked", cell, "cells in the grid")


def _check_cell(field: str, cell: Cell, grid: Grid) -> None:
    if not grid.contains(cell):
        allowed = f"column 0 to {grid.columns - 1}, lane 0 to {grid.lanes - 1}"
        raise BadInputError(field, cell, allowed)
    if not grid.is_free(cell):
        raise BadInputError(field, cell, "a cell that is not blocked")


def _check_vehicles(request: PlanRequest) -> None:
    vehicles = request.vehicles
    _check_count("vehicles", vehicles, MAX_VEHICLES)
    for i, vehicle in enumerate(vehicles):
        field = f"vehicles[{i}]"
        if not 1 <= len(vehicle.id) <= MAX_ID_LENGTH:
            raise BadInputError(f"{field}.id", vehicle.id, f"1 to {MAX_ID_LENGTH} characters")
        _check_cell(f"{field}.cell", vehicle.cell, request.grid)
        if vehicle.lane is not None:
            if vehicle.eligible is not None:
                allowed = "lane or eligible, not both"
                raise BadInputError(f"{field}.eligible", vehicle.eligible, allowed)
            _check_range(f"{field}.lane", vehicle.lane, 0, request.grid.lanes - 1)
        eligible = vehicle.eligible or ()
        for k, target in enumerate(eligible if request.structure is None else ()):
            _check_range(f"{field}.eligible[{k}]", target, 0, len(request.targets) - 1)
        _check_unique(f"{field}.eligible", eligible, "each target once")
        _check_moves(f"{field}.moves", vehicle.moves or (), request.mode)
    _check_unique("vehicles", [vehicle.id for vehicle in vehicles], "unique ids", ".id")
    _check_unique("vehicles", [vehicle.cell for vehicle in vehicles], "separate cells", ".cell")


def _check_moves(field: str, moves: Sequence[Cell], mode: Mode) -> None:
    possible = displacements(mode)[1:]
    for k, move in enumerate(moves):
        if move not in possible:
            allowed = f"one of {', '.join(map(str, possible))}, a move of mode {mode}"
            raise BadInputError(f"{field}[{k}]", move, allowed)
    _check_unique(field, moves, "each move once")


def _check_structure(request: PlanRequest) -> None:
    name, lanes = request.structure, request.structure_lanes
    if name is None:
        if request.lanes is not None:
            raise BadInputError("lanes", request.lanes, "none, unless a structure is given")
        return
    if name not in STRUCTURES:
        raise BadInputError("structure", name, "one of " + ", ".join(STRUCTURES))
    if request.targets:
        raise BadInputError("structure", name, _NOT_BOTH)
    _check_count("lanes", lanes, MAX_LANES)
    for i, lane in enumerate(lanes):
        _check_range(f"lanes[{i}]", lane, 0, request.grid.lanes - 1)
    _check_unique("lanes", lanes, "each lane once")
    for i, vehicle in enumerate(request.vehicles):
        if vehicle.eligible is not None:
            allowed = "lane, or neither: a structure's targets have no indices yet"
            raise BadInputError(f"vehicles[{i}].eligible", vehicle.eligible, allowed)
        if vehicle.moves is not None:
            allowed = "none: any vehicle may get any place of a structure"
            raise BadInputError(f"vehicles[{i}].moves", vehicle.moves, allowed)
        if vehicle.lane is not None and vehicle.lane not in lanes:
            allowed = "one of the structure's lanes " + ", ".join(map(str, lanes))
            raise BadInputError(f"vehicles[{i}].lane", vehicle.lane, allowed)
    lacking = shortage(name, lanes, request.grid, [vehicle.lane for vehicle in request.vehicles])
    if lacking is not None:
        allowed = f"a structure with a free cell for each vehicle; {lacking}"
        raise BadInputError("structure", name, allowed)
