"""Plans in this process."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from laneweave.coordinator.planning import solve
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.launch.run.logs import log_by_default
from laneweave.protocol.errors import BadInputError


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
            the request, by default `tappa`.
        deadline_s: planning time [s]; None: that of the request, by default 4 s.

    Raises:
        BadInputError: the request is unreadable or invalid, or there is no such solver.
    """
    log_by_default()
    if not isinstance(request, PlanRequest):
        data = request if isinstance(request, Mapping) else _read(Path(request))
        request = PlanRequest.from_dict(data)
    if deadline_s is not None:
        request = attrs.evolve(request, deadline_s=deadline_s)
    requested = solver or request.solver
    return solve.plan(request, solver=solver, compiled_only=requested != BRANCHING.name)


def _read(path: Path) -> object:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise BadInputError("request", str(path), f"a readable file ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise BadInputError("request", str(path), f"valid JSON ({error})") from error
