"""The planner's response (`laneweave.plan.response/1`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal, get_args

import attrs
from attrs.validators import optional

from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import within
from laneweave.protocol.lattice import Cell
from laneweave.protocol.structuring import json_form, structure

RESPONSE_SCHEMA: Final = "laneweave.plan.response/1"

Status = Literal["optimal", "feasible", "infeasible", "timeout"]
STATUSES: Final[tuple[Status, ...]] = get_args(Status)

_count = within(0, 2**53)
_OPTIONAL: Final = ("solver", "targets", "waited_ms")


@attrs.frozen
class PlanResponse:
    """A plan, or the reason why there is none.

    status: `optimal`: proven, among plans of any length, or of at most `max_steps` steps;
        `feasible`: the budget was spent before the proof; `infeasible`: proven; `timeout`: no plan
        was found in time.
    cost, steps: None without a plan. lower_bound: proven lower bound; None if infeasible.
    assignment: per vehicle, the index of its target; empty without a plan.
    paths: per vehicle, its cells at all `steps` + 1 time points; empty without a plan.
    solver: the last solver that ran; None: a response from a version without a choice of solvers.
    fallback: whether `solver` replaced the requested one, which used up its share of the deadline
        or nodes, or cannot solve such requests; `paths` is the cheaper of the two path sets.
    targets: targets of the requested structure, to which `assignment` refers; None: the request
        listed its targets.
    waited_ms: time that the request waited for a service worker; None: answered
        without a service.
    """

    status: Status
    cost: int | None = attrs.field(validator=optional(_count))
    lower_bound: int | None = attrs.field(validator=optional(_count))
    steps: int | None = attrs.field(validator=optional(_count))
    assignment: tuple[int, ...]
    paths: tuple[tuple[Cell, ...], ...]
    solve_ms: float = attrs.field(validator=_count)
    assignments_tried: int = attrs.field(validator=_count)
    nodes_expanded: int = attrs.field(validator=_count)
    solver: str | None = None
    fallback: bool = False
    targets: tuple[Cell, ...] | None = None
    waited_ms: float | None = attrs.field(default=None, validator=optional(_count))

    def path_map(self, ids: Sequence[str]) -> RelativePathMap:
        """Return the plan as a relative path map; `ids` are those of the request's vehicles."""
        return RelativePathMap(tuple(ids) if self.paths else (), self.paths)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {"schema": RESPONSE_SCHEMA, **json_form(self, _is_given)}

    @classmethod
    def from_dict(cls, data: object) -> PlanResponse:
        """Read the JSON form.

        Raises:
            BadInputError: names the first field that is wrong.
        """
        if not isinstance(data, Mapping):
            raise BadInputError("response", data, "an object")
        if data.get("schema") != RESPONSE_SCHEMA:
            raise BadInputError("schema", data.get("schema"), repr(RESPONSE_SCHEMA))
        if data.get("status") not in STATUSES:
            raise BadInputError("status", data.get("status"), "one of " + ", ".join(STATUSES))
        return structure({key: data[key] for key in data if key != "schema"}, cls)


PlanFunction = Callable[..., PlanResponse]
"""Function that answers a `PlanRequest`; takes the keyword arguments of `solve.plan`."""


def _is_given(name: str, value: object) -> bool:
    """Return whether the JSON form contains a field."""
    if name == "fallback":
        return bool(value)
    return value is not None or name not in _OPTIONAL
