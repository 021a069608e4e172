"""`laneweave plan`: read a request, make or explain its plan, print and draw it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import attrs

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.launch.library.plans import plan, read_request
from laneweave.protocol.errors import BadInputError, CommandFailedError, RefusedError
from laneweave.protocol.scenario.fields import Scenario

if TYPE_CHECKING:
    from laneweave.protocol.security.connection import Access

MAX_WAIT_S = 3600.0
ANSWER_MARGIN_S = 8.0
"""Time to wait beyond the deadline, so that the coordinator can report a hung worker
(`worker_pool.OVERDUE_S`)."""


def access_for(
    endpoint: str | None, realm: str | None, config: Path | None, client: str | None
) -> Access | None:
    """Return how to connect to a coordinator, or None to plan in this process.

    Args:
        endpoint: endpoint of the router; overrides the configured one.
        realm: realm of the coordinator if there is no configuration; None: the default realm.
        config: configuration of the deployment.
        client: client name in a secured deployment; None: `plan`.

    Raises:
        BadInputError: the configuration is invalid or has no endpoint, or an argument would have no
            effect.
    """
    if config is not None:
        if realm is not None:
            raise BadInputError("--realm", realm, "only without --config, which has network.realm")
        from laneweave.coordinator.service.client import client_access

        return client_access(config, client or "plan", endpoint)
    if client is not None:
        raise BadInputError("--client", client, "only with --config")
    if endpoint is not None:
        from laneweave.protocol.security.connection import Access

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
    """Read a request; make, print and draw its plan. With `access`, a coordinator makes the plan.

    `drawing` shows the relative coordinate system, `road_drawing` the road of `scenario`, which
    also has the maximum size of a request. `wait_s` is the time to wait for a coordinator.
    `deadline_s` and `solver` override the request's values.

    Raises:
        BadInputError: the request is unreadable or invalid, no coordinator is reachable, or a
            drawing cannot be written.
        RefusedError: the coordinator rejected the request.
        CommandFailedError: the coordinator failed or did not answer in time, or writing the drawing
            failed.
    """
    if not 0 <= wait_s <= MAX_WAIT_S:
        raise BadInputError("--wait", wait_s, f"[0, {MAX_WAIT_S:g}]")
    settings = scenario or Scenario()
    request = _request(path, deadline_s, solver, settings, with_solver=access is None)
    drawers = []
    if drawing is not None:
        drawers.append(_checked_drawer(drawing))
    if road_drawing is not None:
        drawers.append(_checked_road_drawer(road_drawing, settings, request.mode))
    response = plan(request) if access is None else _ask(access, request, wait_s)
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
            raise CommandFailedError(f"{out}: cannot be drawn: {error}") from error
        _report_drawing(out)


def explain_request(
    path: Path,
    deadline_s: float | None,
    drawing: Path | None = None,
    scenario: Scenario | None = None,
) -> None:
    """Read a request, run TAPPA on it, then print and draw its steps.

    `scenario` has the maximum size of a request.

    Raises:
        BadInputError: the request is unreadable or invalid, or the drawing cannot be written or is
            not a PNG file.
        CommandFailedError: writing the drawing failed.
    """
    from laneweave.coordinator.planning.paper.explanation import explain
    from laneweave.launch.drawing.tappa_text import explanation_text

    if drawing is not None:
        from laneweave.launch.drawing.plan import check_drawing

        if drawing.suffix.lower() != ".png":
            raise BadInputError("--draw", str(drawing), "a file that ends with .png, for --explain")
        check_drawing(drawing)
    explanation = explain(_request(path, deadline_s, None, scenario or Scenario()).resolved())
    sys.stdout.write(explanation_text(explanation))
    if drawing is not None:
        from laneweave.launch.drawing.tappa_process import draw_explanation

        try:
            draw_explanation(explanation, drawing)
        except OSError as error:
            raise CommandFailedError(f"{drawing}: cannot be drawn: {error}") from error
        _report_drawing(drawing)


def _report_drawing(file: Path) -> None:
    """Say where a drawing is, on stderr: the plan on stdout stays valid JSON."""
    sys.stderr.write(f"drawing: {file}\n")


def _request(
    path: Path,
    deadline_s: float | None,
    solver: str | None,
    settings: Scenario,
    *,
    with_solver: bool = True,
) -> PlanRequest:
    return read_request(
        path,
        settings.service.max_request_bytes,
        field="REQUEST.json",
        with_solver=with_solver,
        deadline_s=deadline_s,
        solver=solver,
    )


_Drawer = tuple[Callable[[PlanRequest, PlanResponse], None], Path]
"""Function that draws a response, and the file that it writes."""


def _checked_drawer(out: Path) -> _Drawer:
    from laneweave.launch.drawing import plan as plan_drawing

    plan_drawing.check_drawing(out)
    return lambda request, response: plan_drawing.draw_plan(request, response, out), out


def _checked_road_drawer(out: Path, scenario: Scenario, mode: int) -> _Drawer:
    try:
        from laneweave.launch.drawing import plan as plan_drawing
        from laneweave.launch.drawing import plan_on_road as road_drawing
    except ModuleNotFoundError as error:
        allowed = f"only with laneweave[agent] and laneweave[sim] ({error.name} is not installed)"
        raise BadInputError("--draw-road", str(out), allowed) from error
    plan_drawing.check_drawing(out, "--draw-road")
    scenario = road_drawing.scenario_in_mode(scenario, mode)
    return lambda request, response: road_drawing.draw_road(request, response, scenario, out), out


def _table(request: PlanRequest, response: PlanResponse) -> str:
    bound = f"lower bound {response.lower_bound}"
    if not response.paths:
        return f"{response.status}, {bound}\n"
    by = f"{response.solver}{' (fallback)' if response.fallback else ''}"
    line = (
        f"{response.status}, cost {response.cost}, {bound}, {response.steps} steps, planned by {by}"
    )
    return f"{line}\n\n{response.path_map(request.ids)}\n"


def _ask(access: Access, request: PlanRequest, wait_s: float) -> PlanResponse:
    from laneweave.coordinator.service.client import (
        PlanClient,
        PlanError,
        RequestRefusedError,
        ServiceUnavailableError,
    )

    timeout_s = request.deadline_s + ANSWER_MARGIN_S + wait_s
    access = attrs.evolve(access, connect_timeout_s=max(wait_s, access.connect_timeout_s))
    try:
        with PlanClient(access) as client:
            return client.plan(request, timeout_s)
    except RequestRefusedError as error:
        raise RefusedError(str(error)) from error
    except ServiceUnavailableError as error:
        allowed = f"a network on which a coordinator answers within {timeout_s:g} s"
        raise BadInputError("--connect", access.endpoint, allowed) from error
    except (PlanError, TimeoutError) as error:
        raise CommandFailedError(f"{access.endpoint}: {error}") from error
