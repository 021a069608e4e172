"""What the planner answers (`laneweave.plan.response/1`)."""

from __future__ import annotations

from typing import Any, Final, Literal

import attrs

from laneweave.coordinator.planning.grid import Cell
from laneweave.coordinator.planning.json_fields import (
    as_bool,
    as_cell,
    as_int,
    as_list,
    as_mapping,
    as_text,
    require,
)
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.request import MAX_TARGETS, MAX_VEHICLES, PlanRequest
from laneweave.protocol.errors import BadInputError

RESPONSE_SCHEMA: Final = "laneweave.plan.response/1"

Status = Literal["optimal", "feasible", "infeasible", "timeout"]
STATUSES: Final[tuple[Status, ...]] = ("optimal", "feasible", "infeasible", "timeout")

_MOST: Final = 2**53
_FIELDS: Final = (
    "schema",
    "status",
    "cost",
    "lower_bound",
    "steps",
    "assignment",
    "paths",
    "solve_ms",
    "assignments_tried",
    "nodes_expanded",
)
_OPTIONAL: Final = ("solver", "fallback", "targets", "waited_ms")


@attrs.frozen
class PlanResponse:
    """A plan, or why there is none.

    status: `optimal` is proven without any bound on the number of steps, `feasible` means that
        the budget was spent first, `infeasible` is proven, `timeout` means nothing is known.
    cost, steps: None without a plan. lower_bound: proven; None if infeasible.
    assignment: per vehicle, the index of its target; empty without a plan.
    paths: per vehicle, its cells at all `steps` + 1 time points; empty without a plan.
    solver: which one planned last; None: a response from before there was a choice.
    fallback: it took over, because the solver that was asked for reached its share of the deadline
        or of the nodes, or cannot treat such requests; `paths` are the cheapest of both.
    targets: of the structure that the request named, in the order of `assignment`'s indices; None:
        the request named its targets.
    waited_ms: at a service, how long the request waited for a worker; None: it was planned here.
    """

    status: Status
    cost: int | None
    lower_bound: int | None
    steps: int | None
    assignment: tuple[int, ...]
    paths: tuple[tuple[Cell, ...], ...]
    solve_ms: float
    assignments_tried: int
    nodes_expanded: int
    solver: str | None = None
    fallback: bool = False
    targets: tuple[Cell, ...] | None = None
    waited_ms: float | None = None

    def path_map(self, request: PlanRequest) -> RelativePathMap:
        """Return the plan as a relative path map."""
        ids = tuple(vehicle.id for vehicle in request.vehicles)
        return RelativePathMap(ids if self.paths else (), self.paths)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "schema": RESPONSE_SCHEMA,
            "status": self.status,
            "cost": self.cost,
            "lower_bound": self.lower_bound,
            "steps": self.steps,
            "assignment": list(self.assignment),
            "paths": [[list(cell) for cell in path] for path in self.paths],
            "solve_ms": self.solve_ms,
            "assignments_tried": self.assignments_tried,
            "nodes_expanded": self.nodes_expanded,
            **({} if self.solver is None else {"solver": self.solver}),
            **({"fallback": True} if self.fallback else {}),
            **(
                {}
                if self.targets is None
                else {"targets": [list(target) for target in self.targets]}
            ),
            **({} if self.waited_ms is None else {"waited_ms": self.waited_ms}),
        }

    @classmethod
    def from_dict(cls, data: object) -> PlanResponse:
        """Read the JSON form."""
        fields = as_mapping("response", data, (*_FIELDS, *_OPTIONAL))
        require(fields, "", _FIELDS)
        if fields["schema"] != RESPONSE_SCHEMA:
            raise BadInputError("schema", fields["schema"], repr(RESPONSE_SCHEMA))
        if fields["status"] not in STATUSES:
            raise BadInputError("status", fields["status"], "one of " + ", ".join(STATUSES))
        assignment = as_list("assignment", fields["assignment"], MAX_VEHICLES)
        return cls(
            status=fields["status"],
            cost=_optional_int("cost", fields["cost"]),
            lower_bound=_optional_int("lower_bound", fields["lower_bound"]),
            steps=_optional_int("steps", fields["steps"]),
            assignment=tuple(
                as_int(f"assignment[{i}]", j, 0, MAX_TARGETS - 1) for i, j in enumerate(assignment)
            ),
            paths=_read_paths(fields["paths"]),
            solve_ms=_milliseconds("solve_ms", fields["solve_ms"]),
            assignments_tried=as_int("assignments_tried", fields["assignments_tried"], 0, _MOST),
            nodes_expanded=as_int("nodes_expanded", fields["nodes_expanded"], 0, _MOST),
            solver=as_text("solver", fields["solver"]) if "solver" in fields else None,
            fallback=as_bool("fallback", fields.get("fallback", False)),
            targets=_read_targets(fields["targets"]) if "targets" in fields else None,
            waited_ms=_milliseconds("waited_ms", fields["waited_ms"])
            if "waited_ms" in fields
            else None,
        )


def _milliseconds(field: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= _MOST:
        raise BadInputError(field, value, f"a number from 0 to {_MOST}")
    return float(value)


def _optional_int(field: str, value: object) -> int | None:
    return None if value is None else as_int(field, value, 0, _MOST)


def _read_targets(value: object) -> tuple[Cell, ...]:
    targets = as_list("targets", value, MAX_TARGETS)
    return tuple(as_cell(f"targets[{j}]", target) for j, target in enumerate(targets))


def _read_paths(value: object) -> tuple[tuple[Cell, ...], ...]:
    paths = as_list("paths", value, MAX_VEHICLES)
    return tuple(
        tuple(
            as_cell(f"paths[{i}][{k}]", cell)
            for k, cell in enumerate(as_list(f"paths[{i}]", path, 10**6))
        )
        for i, path in enumerate(paths)
    )
