"""Plans in this process."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import attrs

from laneweave.coordinator.planning import solve
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.plug_ins.registry import check_solver
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.launch.run.logs import log_by_default
from laneweave.protocol.config.source_files import (
    SourceFile,
    json_lines,
    read_text,
    shown_name,
    unique_keys,
)
from laneweave.protocol.errors import BadInputError, combined, raise_all
from laneweave.protocol.names import NAME_PATTERN
from laneweave.protocol.scenario.deployment_fields import Service


def plan(
    request: PlanRequest | Mapping[str, Any] | Path | str,
    *,
    solver: str | None = None,
    deadline_s: float | None = None,
) -> PlanResponse:
    """Assign targets and plan paths in this process.

        response = laneweave.plan("docs/examples/case-study.json", deadline_s=2.0)
        print(response.status, response.cost, response.paths)

    The first plan of a new installation does not wait for branch and bound to be compiled, unless
    the solver is `branching`. To ask a coordinator instead, use `PlanClient`.

    Args:
        request: a request, its JSON form as a mapping, or the path of a JSON file.
        solver: `tappa`, `branching`, or the name of a plug-in (`laneweave.planners`); None: that of
            the request; if it names none, the planner chooses.
        deadline_s: planning time [s]; None: that of the request, by default 4 s.

    Raises:
        BadInputError: the request is unreadable or invalid, or there is no such solver.
    """
    log_by_default()
    if isinstance(request, Path | str):
        max_bytes = Service().max_request_bytes
        request = read_request(Path(request), max_bytes, field="request", with_solver=True)
    elif not isinstance(request, PlanRequest):
        request = PlanRequest.from_dict(request)
    if deadline_s is not None:
        request = attrs.evolve(request, deadline_s=deadline_s)
    requested = solver or request.solver
    return solve.plan(request, solver=solver, compiled_only=requested != BRANCHING.name)


def read_request(
    path: Path, max_bytes: int, *, field: str, with_solver: bool, **overrides: object
) -> PlanRequest:
    """Return the request in a JSON file.

    Args:
        path: the file; `STDIN`: standard input.
        max_bytes: maximum size.
        field: name of the file in errors.
        with_solver: whether its solver must be installed here.
        **overrides: values of the request to replace, which are checked all the same; None keeps
            the value.

    Raises:
        BadInputError: the file cannot be read, or the request is invalid; names all its errors.
    """
    file = _read(path, max_bytes, field)
    with file.located():
        request = _checked_request(file.tables, with_solver=with_solver)
    given = {name: value for name, value in overrides.items() if value is not None}
    return PlanRequest.from_dict(file.tables | given) if given else request


def _checked_request(data: Mapping[str, Any], *, with_solver: bool) -> PlanRequest:
    of_solver = [*_solver_problems(data)] if with_solver else []
    try:
        request = PlanRequest.from_dict(data)
    except BadInputError as error:
        raise combined([*error.problems, *of_solver]) from None
    raise_all(of_solver)
    return request


def _solver_problems(data: Mapping[str, Any]) -> Iterator[BadInputError]:
    solver = data.get("solver")
    if isinstance(solver, str) and NAME_PATTERN.fullmatch(solver):
        try:
            check_solver(solver)
        except BadInputError as error:
            yield error


def _read(path: Path, max_bytes: int, field: str) -> SourceFile:
    text, shown = read_text(path, field, "JSON", max_bytes), shown_name(path)
    try:
        data = json.loads(text, object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        raise BadInputError(field, shown, f"valid JSON ({error})") from error
    if not isinstance(data, dict):
        raise BadInputError(field, data, "a JSON object")
    return SourceFile(shown, text, data, json_lines)
