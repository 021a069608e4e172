"""`laneweave plan`: one request, planned here or by a running coordinator."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs

from laneweave.coordinator.planning import PlanRequest, PlanResponse, checked_plan
from laneweave.coordinator.planning.explanation import explain
from laneweave.coordinator.service.client import (
    PlanClient,
    PlanError,
    RequestRefusedError,
    ServiceUnavailableError,
    client_access,
)
from laneweave.coordinator.service.query import ABSENT_S
from laneweave.launch.drawing.tappa_text import explanation_text
from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.security.access import Access

MOST_WAIT_S = 3600.0
ANSWER_MARGIN_S = 8.0
"""A coordinator gets this much longer than the request's deadline, so that it can tell of a worker
that hangs (`worker_pool.OVERDUE_S`)."""


def access_for(
    endpoint: str | None, realm: str | None, config: Path | None, client: str | None
) -> Access | None:
    """Return how to get to a coordinator; None: none is to be asked.

    Args:
        endpoint: of the router; goes before that of the configuration.
        realm: of the coordinators, where there is no configuration; None: the default one.
        config: of the deployment.
        client: as whom, where the deployment is secured; None: as `plan`.

    Raises:
        BadInputError: the configuration is not valid or names no router, or something is given
            that would have no effect.
    """
    if config is not None:
        if realm is not None:
            raise BadInputError("--realm", realm, "nothing, as --config has network.realm")
        return client_access(config, client or "plan", endpoint)
    if client is not None:
        raise BadInputError("--client", client, "only with --config")
    if endpoint is not None:
        return Access(endpoint) if realm is None else Access(endpoint, realm)
    if realm is not None:
        raise BadInputError("--realm", realm, "only with --connect")
    return None


def answer_request(
    path: Path,
    deadline_s: float | None,
    access: Access | None,
    solver: str | None,
    *,
    as_table: bool,
    drawing: Path | None = None,
    road_drawing: Path | None = None,
    scenario: Scenario | None = None,
    wait_s: float = 0.0,
) -> None:
    """Read a request, have it planned, print the answer and draw it.

    `drawing` shows the relative coordinate system, `road_drawing` the road of `scenario`.

    Without `access` it is planned here; with it, a coordinator is waited for up to `wait_s`. A
    deadline and a solver replace those of the request.

    Raises:
        BadInputError: the request cannot be read or is not valid, nobody is at the endpoint, or
            the drawing cannot be written.
        RefusedError: the coordinator refused the request.
        CommandFailedError: the coordinator failed or did not answer in time, or the drawing could
            not be written after all.
    """
    if not 0 <= wait_s <= MOST_WAIT_S:
        raise BadInputError("--wait", wait_s, f"[0, {MOST_WAIT_S:g}]")
    request = _request(path, deadline_s, solver)
    drawers = []
    if drawing is not None:
        drawers.append(_checked_drawer(drawing))
    if road_drawing is not None:
        drawers.append(_checked_road_drawer(road_drawing, scenario or Scenario(), request.mode))
    response = checked_plan(request) if access is None else _ask(access, request, wait_s)
    if as_table:
        sys.stdout.write(_table(request, response))
    else:
        sys.stdout.write(json.dumps(response.to_dict(), indent=2) + "\n")
    if response.targets is not None:
        request = request.with_targets(response.targets)
    for draw, out in drawers:
        try:
            draw(request, response)
        except OSError as error:
            raise CommandFailedError(f"{out}: not drawn: {error}") from error


def explain_request(path: Path, deadline_s: float | None, drawing: Path | None = None) -> None:
    """Read a request, run TAPPA on it here, print what it did and draw it.

    Raises:
        BadInputError: the request cannot be read or is not valid, or the drawing is no picture
            or cannot be written.
        CommandFailedError: the drawing could not be written after all.
    """
    if drawing is not None:
        from laneweave.launch.drawing.plan import check_drawing

        if drawing.suffix.lower() != ".png":
            raise BadInputError("--draw", str(drawing), "a file that ends with .png, for --explain")
        check_drawing(drawing)
    explanation = explain(_request(path, deadline_s).settled())
    sys.stdout.write(explanation_text(explanation))
    if drawing is not None:
        from laneweave.launch.drawing.tappa_process import draw_explanation

        try:
            draw_explanation(explanation, drawing)
        except OSError as error:
            raise CommandFailedError(f"{drawing}: not drawn: {error}") from error


def _request(path: Path, deadline_s: float | None, solver: str | None = None) -> PlanRequest:
    data = _read(path)
    if deadline_s is not None:
        data["deadline_s"] = deadline_s
    if solver is not None:
        data["solver"] = solver
    return PlanRequest.from_dict(data)


_Drawer = tuple[Callable[[PlanRequest, PlanResponse], None], Path]
"""What draws an answer, and where."""


def _checked_drawer(out: Path) -> _Drawer:
    from laneweave.launch.drawing import plan as plan_drawing

    plan_drawing.check_drawing(out)
    return lambda request, response: plan_drawing.draw_plan(request, response, out), out


def _checked_road_drawer(out: Path, scenario: Scenario, mode: int) -> _Drawer:
    try:
        from laneweave.launch.drawing import plan as plan_drawing
        from laneweave.launch.drawing import plan_on_road as road_drawing
        from laneweave.launch.drawing.plan_driving import scenario_in_mode
    except ModuleNotFoundError as error:
        allowed = f"only with laneweave[agent] and laneweave[sim] ({error.name} is not installed)"
        raise BadInputError("--draw-road", str(out), allowed) from error
    plan_drawing.check_drawing(out, "--draw-road")
    scenario = scenario_in_mode(scenario, mode)

    def draw(request: PlanRequest, response: PlanResponse) -> None:
        road_drawing.draw_road(request, response, scenario, out)

    return draw, out


def _table(request: PlanRequest, response: PlanResponse) -> str:
    verdict = f"{response.status}, cost {response.cost}, lower bound {response.lower_bound}"
    if not response.paths:
        return f"{response.status}, lower bound {response.lower_bound}\n"
    by = f"{response.solver}{' (fallback)' if response.fallback else ''}"
    return f"{verdict}, {response.steps} steps, planned by {by}\n\n{response.path_map(request)}\n"


def _read(path: Path) -> dict[str, Any]:
    try:
        text = sys.stdin.read() if str(path) == "-" else path.read_text(encoding="utf-8")
        data = json.loads(text)
    except OSError as error:
        raise BadInputError(
            "REQUEST.json", str(path), f"a readable file ({error.strerror})"
        ) from error
    except (ValueError, RecursionError) as error:
        raise BadInputError("REQUEST.json", str(path), f"valid JSON ({error})") from error
    if not isinstance(data, dict):
        raise BadInputError("REQUEST.json", type(data).__name__, "a JSON object")
    return data


def _ask(access: Access, request: PlanRequest, wait_s: float) -> PlanResponse:
    timeout_s = request.deadline_s + ANSWER_MARGIN_S + wait_s
    patient = attrs.evolve(access, connect_timeout_s=max(wait_s, access.connect_timeout_s))
    try:
        with PlanClient(patient, max(ABSENT_S, wait_s)) as client:
            return client.plan(request, timeout_s)
    except RequestRefusedError as error:
        raise RefusedError(str(error)) from error
    except ServiceUnavailableError as error:
        raise BadInputError("--connect", access.endpoint, "a network with a coordinator") from error
    except (PlanError, TimeoutError) as error:
        raise CommandFailedError(f"{access.endpoint}: {error}") from error
