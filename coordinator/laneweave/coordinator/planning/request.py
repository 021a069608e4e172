"""What is asked of the planner, checked before anything is planned.

The JSON form is fixed (`laneweave.plan.request/1`). Whatever is wrong with a request is reported
as `BadInputError`, which names the field, the value and what is allowed. Unknown keys are errors,
too: a misspelt preference must not silently become "any target".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import attrs

from laneweave.coordinator.planning.conflicts import DEFAULT_KINDS, KINDS, ConflictModel
from laneweave.coordinator.planning.geometry.settings import Geometry
from laneweave.coordinator.planning.grid import Cell, Grid, Mode
from laneweave.coordinator.planning.json_fields import (
    as_cell,
    as_int,
    as_list,
    as_mapping,
    as_text,
    require,
)
from laneweave.coordinator.planning.preference import eligible_targets
from laneweave.coordinator.planning.structures import STRUCTURES, shortage, structure_targets
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.tables import SOLVERS

REQUEST_SCHEMA: Final = "laneweave.plan.request/1"
DEFAULT_DEADLINE_S: Final = 4.0

MAX_COLUMNS: Final = 1000
MAX_LANES: Final = 16
MAX_VEHICLES: Final = 200
MAX_TARGETS: Final = 400
MAX_ID_LENGTH: Final = 100
MAX_DEADLINE_S: Final = 3600.0

_NOT_BOTH: Final = "structure or targets, not both"
_KEYS: Final = (
    "schema",
    "id",
    "grid",
    "mode",
    "conflicts",
    "vehicles",
    "targets",
    "deadline_s",
    "geometry",
    "solver",
    "structure",
    "lanes",
)


@attrs.frozen
class VehicleRequest:
    """One vehicle: its start cell, and the lane or the targets (indices) it may be assigned to."""

    id: str
    cell: Cell
    lane: int | None = None
    eligible: tuple[int, ...] | None = None


@attrs.frozen
class PlanRequest:
    """Vehicles, targets and rules of one planning problem; checked when it is made.

    targets: none where a structure is given.
    structure: one of `STRUCTURES`, whose cells are the targets; see `structures`.
    lanes: lanes that the structure uses; None: all.
    geometry: what `geometric` is computed from; None: footprints.
    solver: one of `SOLVERS`; None: the default of whoever plans.
    id: names the request where it is asked again: a service answers it as before. Empty: no name.
    """

    grid: Grid
    mode: Mode
    conflicts: tuple[str, ...]
    vehicles: tuple[VehicleRequest, ...]
    targets: tuple[Cell, ...] = ()
    deadline_s: float = DEFAULT_DEADLINE_S
    geometry: Geometry | None = None
    id: str = ""
    solver: str | None = None
    structure: str | None = None
    lanes: tuple[int, ...] | None = None

    def __attrs_post_init__(self) -> None:
        """Reject what is inconsistent, however the request was made."""
        _check_grid(self.grid)
        if self.mode not in (1, 2):
            raise BadInputError("mode", self.mode, "1 or 2")
        _check_conflicts(self.conflicts)
        if self.geometry is not None and "geometric" not in self.conflicts:
            allowed = "none, unless geometric is among conflicts"
            raise BadInputError("geometry", self.geometry.to_dict(), allowed)
        if self.solver is not None:
            checked_solver(self.solver)
        if self.structure is None:
            _check_targets(self)
        _check_vehicles(self)
        _check_structure(self)
        if len(self.id) > MAX_ID_LENGTH:
            raise BadInputError("id", self.id, f"at most {MAX_ID_LENGTH} characters")
        if not (math.isfinite(self.deadline_s) and 0 < self.deadline_s <= MAX_DEADLINE_S):
            allowed = f"a number above 0, at most {MAX_DEADLINE_S:g}"
            raise BadInputError("deadline_s", self.deadline_s, allowed)

    @property
    def conflict_model(self) -> ConflictModel:
        """Return which moves must not be made in the same step."""
        return ConflictModel(self.conflicts, self.geometry)

    def choices(self) -> list[frozenset[int]]:
        """Return, per vehicle, the indices of the targets it may be assigned to."""
        return [eligible_targets(self.targets, v.lane, v.eligible) for v in self.vehicles]

    def _targets_to_dict(self) -> dict[str, Any]:
        if self.structure is None:
            return {"targets": [list(target) for target in self.targets]}
        lanes = {} if self.lanes is None else {"lanes": list(self.lanes)}
        return {"structure": self.structure, **lanes}

    def settled(self) -> PlanRequest:
        """Return the request with the targets of its structure; itself if it names targets."""
        if self.structure is None:
            return self
        lanes, cells = _lanes_of(self), [vehicle.cell for vehicle in self.vehicles]
        preferred = [vehicle.lane for vehicle in self.vehicles]
        return self.with_targets(
            structure_targets(self.structure, lanes, self.grid, cells, preferred)
        )

    def with_targets(self, targets: Sequence[Cell]) -> PlanRequest:
        """Return the request with these targets instead of its own, or of its structure."""
        return attrs.evolve(self, targets=tuple(targets), structure=None, lanes=None)

    @classmethod
    def from_dict(cls, data: object) -> PlanRequest:
        """Read the JSON form."""
        fields = as_mapping("request", data, _KEYS)
        named = () if "structure" in fields else ("targets",)
        require(fields, "", ("schema", "grid", "vehicles", *named))
        if fields["schema"] != REQUEST_SCHEMA:
            raise BadInputError("schema", fields["schema"], repr(REQUEST_SCHEMA))
        mode = _read_mode(fields.get("mode", 1))
        conflicts = DEFAULT_KINDS[mode]
        if "conflicts" in fields:
            names = as_list("conflicts", fields["conflicts"], len(KINDS))
            conflicts = tuple(as_text(f"conflicts[{i}]", name) for i, name in enumerate(names))
        vehicles = as_list("vehicles", fields["vehicles"], MAX_VEHICLES)
        targets = as_list("targets", fields.get("targets", ()), MAX_TARGETS)
        if "structure" in fields and "targets" in fields:
            raise BadInputError("structure", fields["structure"], _NOT_BOTH)
        lanes = as_list("lanes", fields["lanes"], MAX_LANES) if "lanes" in fields else None
        return cls(
            grid=_read_grid(fields["grid"]),
            mode=mode,
            conflicts=conflicts,
            vehicles=tuple(_read_vehicle(f"vehicles[{i}]", v) for i, v in enumerate(vehicles)),
            targets=tuple(as_cell(f"targets[{i}]", t) for i, t in enumerate(targets)),
            deadline_s=_read_deadline(fields.get("deadline_s", DEFAULT_DEADLINE_S)),
            geometry=Geometry.from_dict(fields["geometry"]) if "geometry" in fields else None,
            id=as_text("id", fields.get("id", "")),
            solver=as_text("solver", fields["solver"]) if "solver" in fields else None,
            structure=as_text("structure", fields["structure"]) if "structure" in fields else None,
            lanes=None if lanes is None else tuple(lanes),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        geometry = {} if self.geometry is None else {"geometry": self.geometry.to_dict()}
        return {
            "schema": REQUEST_SCHEMA,
            **({"id": self.id} if self.id else {}),
            "grid": {
                "columns": self.grid.columns,
                "lanes": self.grid.lanes,
                "blocked": [list(cell) for cell in sorted(self.grid.blocked)],
            },
            "mode": self.mode,
            "conflicts": list(self.conflicts),
            "vehicles": [_write_vehicle(vehicle) for vehicle in self.vehicles],
            **self._targets_to_dict(),
            "deadline_s": self.deadline_s,
            **geometry,
            **({} if self.solver is None else {"solver": self.solver}),
        }


def checked_solver(name: str, field: str = "solver") -> str:
    """Return the name of a solver.

    Raises:
        BadInputError: there is none of this name.
    """
    if name not in SOLVERS:
        raise BadInputError(field, name, "one of " + ", ".join(SOLVERS))
    return name


def _read_mode(value: object) -> Mode:
    mode = as_int("mode", value, 1, 2)
    return 1 if mode == 1 else 2


def _read_deadline(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInputError("deadline_s", value, f"a number above 0, at most {MAX_DEADLINE_S:g}")
    if isinstance(value, int) and abs(value) > MAX_DEADLINE_S:
        raise BadInputError("deadline_s", value, f"a number above 0, at most {MAX_DEADLINE_S:g}")
    return float(value)


def _read_grid(value: object) -> Grid:
    fields = as_mapping("grid", value, ("columns", "lanes", "blocked"))
    require(fields, "grid", ("columns", "lanes"))
    columns = as_int("grid.columns", fields["columns"], 1, MAX_COLUMNS)
    lanes = as_int("grid.lanes", fields["lanes"], 1, MAX_LANES)
    blocked = as_list("grid.blocked", fields.get("blocked", ()), columns * lanes)
    whole = Grid(columns, lanes)
    cells: dict[Cell, None] = {}
    for i, item in enumerate(blocked):
        cell = as_cell(f"grid.blocked[{i}]", item)
        if not whole.contains(cell):
            raise BadInputError(f"grid.blocked[{i}]", cell, "a cell in the grid")
        if cell in cells:
            raise BadInputError(f"grid.blocked[{i}]", cell, "each cell once")
        cells[cell] = None
    return Grid(columns, lanes, list(cells))


def _read_vehicle(field: str, value: object) -> VehicleRequest:
    fields = as_mapping(field, value, ("id", "cell", "lane", "eligible"))
    require(fields, field, ("id", "cell"))
    lane = as_int(f"{field}.lane", fields["lane"], 0, MAX_LANES - 1) if "lane" in fields else None
    eligible: tuple[int, ...] | None = None
    if "eligible" in fields:
        items = as_list(f"{field}.eligible", fields["eligible"], MAX_TARGETS)
        eligible = tuple(
            as_int(f"{field}.eligible[{k}]", item, 0, MAX_TARGETS - 1)
            for k, item in enumerate(items)
        )
    cell = as_cell(f"{field}.cell", fields["cell"])
    return VehicleRequest(as_text(f"{field}.id", fields["id"]), cell, lane, eligible)


def _write_vehicle(vehicle: VehicleRequest) -> dict[str, Any]:
    written: dict[str, Any] = {"id": vehicle.id, "cell": list(vehicle.cell)}
    if vehicle.lane is not None:
        written["lane"] = vehicle.lane
    if vehicle.eligible is not None:
        written["eligible"] = list(vehicle.eligible)
    return written


def _check_grid(grid: Grid) -> None:
    as_int("grid.columns", grid.columns, 1, MAX_COLUMNS)
    as_int("grid.lanes", grid.lanes, 1, MAX_LANES)
    for cell in sorted(grid.blocked):
        if not grid.contains(cell):
            raise BadInputError("grid.blocked", cell, "cells in the grid")


def _check_conflicts(conflicts: Sequence[str]) -> None:
    for i, kind in enumerate(conflicts):
        if kind not in KINDS:
            raise BadInputError(f"conflicts[{i}]", kind, "any of " + ", ".join(KINDS))
        if kind in conflicts[:i]:
            raise BadInputError(f"conflicts[{i}]", kind, "each kind once")


def _check_cell(field: str, cell: Cell, grid: Grid) -> None:
    if not grid.contains(cell):
        allowed = f"column 0 to {grid.columns - 1}, lane 0 to {grid.lanes - 1}"
        raise BadInputError(field, cell, allowed)
    if not grid.is_free(cell):
        raise BadInputError(field, cell, "a cell that is not blocked")


def _check_targets(request: PlanRequest) -> None:
    if not 1 <= len(request.targets) <= MAX_TARGETS:
        raise BadInputError("targets", len(request.targets), f"1 to {MAX_TARGETS} targets")
    seen: dict[Cell, int] = {}
    for i, target in enumerate(request.targets):
        _check_cell(f"targets[{i}]", target, request.grid)
        if target in seen:
            allowed = f"each cell once; it is targets[{seen[target]}], too"
            raise BadInputError(f"targets[{i}]", target, allowed)
        seen[target] = i


def _lanes_of(request: PlanRequest) -> Sequence[int]:
    """Return the lanes of a structure."""
    return range(request.grid.lanes) if request.lanes is None else request.lanes


def _check_structure(request: PlanRequest) -> None:
    structure = request.structure
    if structure is None:
        if request.lanes is not None:
            raise BadInputError("lanes", request.lanes, "none, unless a structure is given")
        return
    if structure not in STRUCTURES:
        raise BadInputError("structure", structure, "one of " + ", ".join(STRUCTURES))
    if request.targets:
        raise BadInputError("structure", structure, _NOT_BOTH)
    lanes = _lanes_of(request)
    if not lanes:
        raise BadInputError("lanes", lanes, "at least one lane")
    for i, lane in enumerate(lanes):
        as_int(f"lanes[{i}]", lane, 0, request.grid.lanes - 1)
        if lane in lanes[:i]:
            raise BadInputError(f"lanes[{i}]", lane, "each lane once")
    for i, vehicle in enumerate(request.vehicles):
        if vehicle.eligible is not None:
            allowed = "lane, or neither: a structure's targets have no numbers yet"
            raise BadInputError(f"vehicles[{i}].eligible", vehicle.eligible, allowed)
        if vehicle.lane is not None and vehicle.lane not in lanes:
            allowed = "one of the structure's lanes " + ", ".join(map(str, lanes))
            raise BadInputError(f"vehicles[{i}].lane", vehicle.lane, allowed)
    preferred = [vehicle.lane for vehicle in request.vehicles]
    lacking = shortage(structure, lanes, request.grid, preferred)
    if lacking is not None:
        allowed = f"a structure with a free cell for each vehicle; {lacking}"
        raise BadInputError("structure", structure, allowed)


def _check_vehicles(request: PlanRequest) -> None:
    if not 1 <= len(request.vehicles) <= MAX_VEHICLES:
        raise BadInputError("vehicles", len(request.vehicles), f"1 to {MAX_VEHICLES} vehicles")
    ids: dict[str, int] = {}
    cells: dict[Cell, int] = {}
    for i, vehicle in enumerate(request.vehicles):
        field = f"vehicles[{i}]"
        if not 1 <= len(vehicle.id) <= MAX_ID_LENGTH:
            raise BadInputError(f"{field}.id", vehicle.id, f"1 to {MAX_ID_LENGTH} characters")
        if vehicle.id in ids:
            allowed = f"unique ids; vehicles[{ids[vehicle.id]}] has it, too"
            raise BadInputError(f"{field}.id", vehicle.id, allowed)
        _check_cell(f"{field}.cell", vehicle.cell, request.grid)
        if vehicle.cell in cells:
            allowed = f"a cell of its own; vehicles[{cells[vehicle.cell]}] is there, too"
            raise BadInputError(f"{field}.cell", vehicle.cell, allowed)
        ids[vehicle.id] = cells[vehicle.cell] = i
        _check_preference(field, vehicle, request)


def _check_preference(field: str, vehicle: VehicleRequest, request: PlanRequest) -> None:
    if vehicle.lane is not None:
        if vehicle.eligible is not None:
            raise BadInputError(f"{field}.eligible", vehicle.eligible, "lane or eligible, not both")
        as_int(f"{field}.lane", vehicle.lane, 0, request.grid.lanes - 1)
    seen: set[int] = set()
    for k, target in enumerate(vehicle.eligible or ()):
        if request.structure is None:
            as_int(f"{field}.eligible[{k}]", target, 0, len(request.targets) - 1)
        if target in seen:
            raise BadInputError(f"{field}.eligible[{k}]", target, "each target once")
        seen.add(target)
