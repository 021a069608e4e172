"""A plan request: vehicles, targets and rules, checked on construction.

The JSON form is fixed (`laneweave.plan.request/1`). A `BadInputError` has all errors of a request;
each names the field, the value and what is allowed. Unknown keys are errors, too: a misspelt
preference must not silently become "any target".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
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
from laneweave.protocol.errors import (
    MAX_PROBLEMS,
    NO_VALUE,
    UNKNOWN_KEY,
    BadInputError,
    Described,
    combined,
    one_line,
    raise_all,
    unknown_name,
)
from laneweave.protocol.lattice import Cell, Mode, displacements
from laneweave.protocol.names import NAME_PATTERN, NAME_RULE
from laneweave.protocol.scenario.formation_table import (
    CONFLICT_KINDS,
    DEFAULT_CONFLICTS,
    MAX_TARGETS,
)
from laneweave.protocol.structuring import PLAIN_TYPES, json_form, structure, without

REQUEST_SCHEMA: Final = "laneweave.plan.request/1"
DEFAULT_DEADLINE_S: Final = 4.0

MAX_COLUMNS: Final = 1000
MAX_LANES: Final = 16
MAX_VEHICLES: Final = 200
MAX_ID_LENGTH: Final = 100
MAX_DEADLINE_S: Final = 3600.0
MAX_STEPS: Final = 10_000
"""Maximum number of steps of a plan, where it is limited."""

_KNOWN_KEYS: Final = "only known keys"
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
    max_steps: maximum number of steps of the plan; None: any number.
    geometry: defines the conflict kind `geometric`; None: footprints.
    solver: name of a solver, built in or a plug-in where the request is answered; None: that of
        the coordinator, or the planner chooses.
    id: a service plans pending requests with the same id once; empty: no id.
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
    max_steps: int | None = None

    def __attrs_post_init__(self) -> None:
        """Reject inconsistent requests.

        Raises:
            BadInputError: names all fields that are wrong.
        """
        raise_all(_problems(self))

    @property
    def conflict_model(self) -> ConflictModel:
        """The definition of conflicts between moves."""
        table = None if self.geometry is None else conflict_table(self.geometry)
        return ConflictModel(self.conflicts, table)

    def problem(self) -> Problem:
        """Return the problem in the form that the searches use."""
        starts = [vehicle.cell for vehicle in self.vehicles]
        drivable = [vehicle.moves for vehicle in self.vehicles]
        model, steps = self.conflict_model, self.max_steps
        return Problem(self.grid, self.mode, model, starts, self.targets, drivable, steps)

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
            BadInputError: names all fields that are wrong.
        """
        if not isinstance(data, Mapping):
            raise BadInputError("request", data, "an object")
        if data.get("schema") != REQUEST_SCHEMA:
            raise BadInputError("schema", data.get("schema"), repr(REQUEST_SCHEMA))
        problems = [*islice(_json_problems("", data), MAX_PROBLEMS)]
        if any(one.allowed == _KNOWN_KEYS for one in problems):
            raise combined(problems)
        if "targets" not in data and "structure" not in data:
            allowed = "a list of cells; or a structure instead"
            problems.append(BadInputError("targets", NO_VALUE, allowed))
        if "targets" in data and "structure" in data:
            problems.append(BadInputError("structure", data["structure"], _NOT_BOTH))
        document, unstructured = _document(data)
        problems += unstructured
        if document is None:
            raise combined(problems)
        problems += islice(_blocked_problems(document.grid), MAX_PROBLEMS)
        try:
            request = cls(**document.fields())
        except BadInputError as error:
            raise combined([*problems, error]) from None
        raise_all(problems)
        return request

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the vehicles, in the order of the request."""
        return tuple(vehicle.id for vehicle in self.vehicles)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {"schema": REQUEST_SCHEMA, **json_form(self, _is_given)}


@attrs.frozen
class _GridDocument:
    """The JSON form of a grid."""

    columns: int
    lanes: int
    blocked: tuple[Cell, ...] = ()


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
    max_steps: int | None = None

    def fields(self) -> dict[str, Any]:
        """Return the arguments of a `PlanRequest`, which checks them."""
        given = attrs.asdict(self, recurse=False, filter=lambda field, _: field.name != "schema")
        if self.conflicts is None:
            given["conflicts"] = DEFAULT_CONFLICTS.get(self.mode, ())
        grid = Grid(self.grid.columns, self.grid.lanes)
        given["grid"] = attrs.evolve(grid, blocked=filter(grid.contains, self.grid.blocked))
        return given


def _document(data: Mapping[str, Any]) -> tuple[_Document | None, Sequence[BadInputError]]:
    """Return the document of a request, and its errors.

    Errors of unknown keys do not hide the others; None: values have a wrong type or are missing.
    """
    try:
        return structure(data, _Document), ()
    except BadInputError as error:
        problems = error.problems
    if any(one.value is not UNKNOWN_KEY for one in problems):
        return None, problems
    try:
        return structure(without(data, [one.field for one in problems]), _Document), problems
    except (LookupError, BadInputError):  # a key that looks like a path; more than MAX_PROBLEMS
        return None, problems


def _is_given(name: str, value: object) -> bool:
    """Return whether the JSON form contains a field."""
    return value is not None and value != "" and (name != "targets" or value != ())


def _json_problems(parent: str, value: object) -> Iterator[BadInputError]:
    """Outside a geometry, yield nulls and keys that do not fit on one printable line."""
    if isinstance(value, Mapping):
        prefix = f"{parent}." if parent else ""
        for key, item in value.items():
            shown = one_line(str(key), 80) or repr(key)
            if shown != key:
                yield BadInputError(prefix + shown, item, _KNOWN_KEYS)
            elif item is None:
                yield BadInputError(prefix + key, None, "a value, or no such key")
            elif key != "geometry" and type(item) not in PLAIN_TYPES:
                yield from _json_problems(prefix + key, item)
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            if item is None:
                yield BadInputError(f"{parent}[{i}]", None, "a value, or no such key")
            elif type(item) not in PLAIN_TYPES:
                yield from _json_problems(f"{parent}[{i}]", item)


def _blocked_problems(grid: _GridDocument) -> Iterator[BadInputError]:
    """Yield the errors of blocked cells, which are a set in a `Grid`."""
    bare = Grid(grid.columns, grid.lanes)
    for i, cell in enumerate(() if [*_size_problems(bare)] else grid.blocked):
        if not bare.contains(cell):
            yield BadInputError(f"grid.blocked[{i}]", cell, "a cell in the grid")
    yield from _repeated("grid.blocked", grid.blocked, "each cell once")


def _out_of_range(field: str, value: int, low: int, high: int) -> Iterator[BadInputError]:
    if not low <= value <= high:
        yield BadInputError(field, value, f"a whole number from {low} to {high}")


def _wrong_count(field: str, values: Sequence[object], maximum: int) -> Iterator[BadInputError]:
    if not 1 <= len(values) <= maximum:
        yield BadInputError(field, Described(f"{len(values)} items"), f"1 to {maximum} items")


def _repeated(
    field: str, values: Sequence[object], allowed: str, name: str = ""
) -> Iterator[BadInputError]:
    """Yield duplicate values; `name` is the suffix of the field in each item."""
    first: dict[object, int] = {}
    for i, value in enumerate(values):
        if first.setdefault(value, i) != i:
            other = f"{field}[{first[value]}]"
            yield BadInputError(f"{field}[{i}]{name}", value, f"{allowed}; {other} has it, too")


def _wrong_text(field: str, text: str, min_length: int = 0) -> Iterator[BadInputError]:
    """Yield the error of an id that is too long, or that would control the terminal."""
    if not min_length <= len(text) <= MAX_ID_LENGTH:
        allowed = f"{min_length or 'at most'}{' to' if min_length else ''} {MAX_ID_LENGTH}"
        yield BadInputError(field, text, f"{allowed} characters")
    elif not text.isprintable():
        yield BadInputError(field, text, "printable characters")


def _problems(request: PlanRequest) -> Iterator[BadInputError]:
    """Yield all errors of a request.

    Items of lists that are too long are not checked, nor are cells if the grid is invalid.
    """
    of_grid = [*_size_problems(request.grid)]
    yield from of_grid
    yield from _rule_problems(request)
    of_counts = [*_wrong_count("vehicles", request.vehicles, MAX_VEHICLES)]
    if request.structure is None:
        of_counts += _wrong_count("targets", request.targets, MAX_TARGETS)
    yield from of_counts
    if of_counts:
        return
    yield from _repeated("targets", request.targets, "each cell once")
    yield from _vehicle_problems(request)
    if not of_grid:
        yield from _cell_problems(request)
        yield from _structure_problems(request)


def _size_problems(grid: Grid) -> Iterator[BadInputError]:
    yield from _out_of_range("grid.columns", grid.columns, 1, MAX_COLUMNS)
    yield from _out_of_range("grid.lanes", grid.lanes, 1, MAX_LANES)


def _rule_problems(request: PlanRequest) -> Iterator[BadInputError]:
    """Yield the errors of everything but grid, vehicles and targets."""
    if request.mode not in (1, 2):
        yield BadInputError("mode", request.mode, "1 or 2")
    for i, kind in enumerate(request.conflicts):
        if kind not in CONFLICT_KINDS:
            allowed = "any of " + ", ".join(CONFLICT_KINDS)
            yield unknown_name(f"conflicts[{i}]", kind, CONFLICT_KINDS, allowed)
    yield from _repeated("conflicts", request.conflicts, "each kind once")
    if request.geometry is not None and "geometric" not in request.conflicts:
        allowed = "none, unless geometric is among conflicts"
        yield BadInputError("geometry", attrs.asdict(request.geometry), allowed)
    if request.solver is not None and not NAME_PATTERN.fullmatch(request.solver):
        yield BadInputError("solver", request.solver, f"the name of a solver: {NAME_RULE}")
    yield from _wrong_text("id", request.id)
    if not (math.isfinite(request.deadline_s) and 0 < request.deadline_s <= MAX_DEADLINE_S):
        allowed = f"a number above 0, at most {MAX_DEADLINE_S:g}"
        yield BadInputError("deadline_s", request.deadline_s, allowed)
    if request.max_steps is not None:
        yield from _out_of_range("max_steps", request.max_steps, 0, MAX_STEPS)


def _cell_problems(request: PlanRequest) -> Iterator[BadInputError]:
    """Yield the errors of cells and lanes."""
    grid = request.grid
    for cell in sorted(grid.blocked):
        if not grid.contains(cell):
            yield BadInputError("grid.blocked", cell, "cells in the grid")
    for i, target in enumerate(request.targets if request.structure is None else ()):
        yield from _wrong_cell(f"targets[{i}]", target, grid)
    for i, vehicle in enumerate(request.vehicles):
        yield from _wrong_cell(f"vehicles[{i}].cell", vehicle.cell, grid)
        if vehicle.lane is not None:
            yield from _out_of_range(f"vehicles[{i}].lane", vehicle.lane, 0, grid.lanes - 1)


def _wrong_cell(field: str, cell: Cell, grid: Grid) -> Iterator[BadInputError]:
    if not grid.contains(cell):
        allowed = f"column 0 to {grid.columns - 1}, lane 0 to {grid.lanes - 1}"
        yield BadInputError(field, cell, allowed)
    elif not grid.is_free(cell):
        yield BadInputError(field, cell, "a cell that is not blocked")


def _vehicle_problems(request: PlanRequest) -> Iterator[BadInputError]:
    """Yield the errors of vehicles, except those about the grid."""
    vehicles = request.vehicles
    for i, vehicle in enumerate(vehicles):
        field = f"vehicles[{i}]"
        yield from _wrong_text(f"{field}.id", vehicle.id, 1)
        if vehicle.lane is not None and vehicle.eligible is not None:
            allowed = "lane or eligible, not both"
            yield BadInputError(f"{field}.eligible", vehicle.eligible, allowed)
        eligible = vehicle.eligible or ()
        for k, target in enumerate(eligible if request.structure is None else ()):
            last = len(request.targets) - 1
            yield from _out_of_range(f"{field}.eligible[{k}]", target, 0, last)
        yield from _repeated(f"{field}.eligible", eligible, "each target once")
        if request.mode in (1, 2):
            yield from _wrong_moves(f"{field}.moves", vehicle.moves or (), request.mode)
    yield from _repeated("vehicles", [vehicle.id for vehicle in vehicles], "unique ids", ".id")
    cells = [vehicle.cell for vehicle in vehicles]
    yield from _repeated("vehicles", cells, "separate cells", ".cell")


def _wrong_moves(field: str, moves: Sequence[Cell], mode: Mode) -> Iterator[BadInputError]:
    possible = displacements(mode)[1:]
    for k, move in enumerate(moves):
        if move not in possible:
            allowed = f"one of {', '.join(map(str, possible))}, a move of mode {mode}"
            yield BadInputError(f"{field}[{k}]", move, allowed)
    yield from _repeated(field, moves, "each move once")


def _structure_problems(request: PlanRequest) -> Iterator[BadInputError]:
    name, lanes = request.structure, request.structure_lanes
    if name is None:
        if request.lanes is not None:
            yield BadInputError("lanes", request.lanes, "none, unless a structure is given")
        return
    found = [*_wrong_structure(request)]
    yield from found
    preferred = [vehicle.lane for vehicle in request.vehicles]
    lacking = None if found else shortage(name, lanes, request.grid, preferred)
    if lacking is not None:
        allowed = f"a structure with a free cell for each vehicle; {lacking}"
        yield BadInputError("structure", name, allowed)


def _wrong_structure(request: PlanRequest) -> Iterator[BadInputError]:
    """Yield the errors of a structure and its lanes, and of vehicles that do not fit to it."""
    name, lanes = request.structure, request.structure_lanes
    if name not in STRUCTURES:
        yield unknown_name("structure", name, STRUCTURES)
    if request.targets:
        yield BadInputError("structure", name, _NOT_BOTH)
    yield from _wrong_count("lanes", lanes, MAX_LANES)
    for i, lane in enumerate(lanes):
        yield from _out_of_range(f"lanes[{i}]", lane, 0, request.grid.lanes - 1)
    yield from _repeated("lanes", lanes, "each lane once")
    for i, vehicle in enumerate(request.vehicles):
        if vehicle.eligible is not None:
            allowed = "lane, or neither: a structure's targets have no indices yet"
            yield BadInputError(f"vehicles[{i}].eligible", vehicle.eligible, allowed)
        if vehicle.moves is not None:
            allowed = "none: any vehicle may get any place of a structure"
            yield BadInputError(f"vehicles[{i}].moves", vehicle.moves, allowed)
        if vehicle.lane is not None and vehicle.lane not in lanes:
            allowed = "one of the structure's lanes " + ", ".join(map(str, lanes))
            yield BadInputError(f"vehicles[{i}].lane", vehicle.lane, allowed)
