"""Slow and obvious answers to compare the planner with."""

from __future__ import annotations

import heapq
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from random import Random
from typing import Any

from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_model import ConflictModel, Move
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.problem import Grid
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import Cell, Mode
from laneweave.protocol.scenario.fields import CONFLICT_KINDS, SOLVERS
from oracles.moving_bodies import Bodies, drive
from oracles.path_rules import check_paths

DEADLINE_S = 60.0
"""Comparisons are about costs, not about times."""


def moves_from(cell: Cell, grid: Grid, mode: Mode) -> list[Move]:
    found = []
    for column, lane in itertools.product((-1, 0, 1), repeat=2):
        if mode == 1 and column and lane:
            continue
        to = cell[0] + column, cell[1] + lane
        if 0 <= to[0] < grid.columns and 0 <= to[1] < grid.lanes and to not in grid.blocked:
            found.append((cell, to))
    return found


@lru_cache(maxsize=200_000)
def conflict(model: ConflictModel, a: Move, b: Move) -> bool:
    return model.kind(a, b) is not None


def joint_moves(
    options: Sequence[Sequence[Move]], model: ConflictModel, chosen: tuple[Move, ...] = ()
) -> Iterator[tuple[Move, ...]]:
    if len(chosen) == len(options):
        yield chosen
        return
    for move in options[len(chosen)]:
        if not any(conflict(model, move, other) for other in chosen):
            yield from joint_moves(options, model, (*chosen, move))


def cheapest_plan(request: PlanRequest, fixed: Sequence[int] | None = None) -> int | None:
    """Return the optimal cost by Dijkstra's algorithm over all joint states, or None.

    A vehicle on a target that nobody else has taken may declare that it has arrived for good; each
    other vehicle pays one per step.
    """
    model = request.conflict_model
    choices = [frozenset({j}) for j in fixed] if fixed is not None else request.choices()
    start = tuple(v.cell for v in request.vehicles)
    moving = (-1,) * len(start)
    best = {(start, moving): 0}
    heap = [(0, start, moving)]
    while heap:
        cost, cells, parked = heapq.heappop(heap)
        if best[cells, parked] < cost:
            continue
        if all(j >= 0 for j in parked):
            return cost
        following: list[tuple[int, tuple[Cell, ...], tuple[int, ...]]] = [
            (cost, cells, (*parked[:i], j, *parked[i + 1 :]))
            for i, cell in enumerate(cells)
            for j in choices[i]
            if parked[i] < 0 and request.targets[j] == cell and j not in parked
        ]
        options = [
            [(cell, cell)] if parked[i] >= 0 else moves_from(cell, request.grid, request.mode)
            for i, cell in enumerate(cells)
        ]
        paid = cost + parked.count(-1)
        following += [
            (paid, tuple(to for _, to in joint), parked) for joint in joint_moves(options, model)
        ]
        for entry in following:
            key = entry[1], entry[2]
            if key not in best or entry[0] < best[key]:
                best[key] = entry[0]
                heapq.heappush(heap, entry)
    return None


def faults(request: dict[str, Any], cost: int | None, solver: str) -> list[str]:
    """Return what is wrong with the answer of one solver, if the minimum cost is this.

    The paths are checked by independent rules; with a geometry, also by driving them with delays.
    """
    asked = PlanRequest.from_dict({**request, "deadline_s": DEADLINE_S})
    response = plan(asked, solver=solver, fallback=False).to_dict()
    claims = [response[key] for key in ("status", "cost", "lower_bound")]
    expected = ["infeasible" if cost is None else "optimal", cost, cost]
    if claims != expected:
        return [f"answers {claims}, the oracle {expected}"]
    if cost is None:
        return []
    found = check_paths(request, response)
    if "geometry" in request:
        random = Random(json.dumps(request))
        min_m = min(drive(request, response, random) for _ in range(3))
        if min_m < Bodies(**request["geometry"]).clearance_along_m:
            found.append(f"only {min_m:.2f} m apart")
    return found


def assert_agreement(
    requests: Iterable[dict[str, Any]],
    oracle: Callable[[dict[str, Any]], int | None],
    solvers: Sequence[str] = SOLVERS,
) -> None:
    """Assert that solvers plan at the cost that an oracle proves, with legal paths."""
    wrong = []
    for request in requests:
        cost = oracle(request)
        wrong += [
            f"{solver}: {fault}: {json.dumps(request)}"
            for solver in solvers
            for fault in faults(request, cost, solver)
        ]
    assert not wrong, "\n".join(wrong)


GEOMETRIES = (None, BodyGeometry(), BodyGeometry(lateness_s=0.0), BodyGeometry(lateness_s=0.5))

MODES: st.SearchStrategy[Mode] = st.sampled_from((1, 2))


@st.composite
def requests(
    draw: st.DrawFn, *, most_vehicles: int = 3, most_cells: int = 8, deadline_s: float = 60.0
) -> PlanRequest:
    """Draw small requests over both modes, all sets of conflicts and some geometries."""
    mode = draw(MODES)
    lanes = draw(st.integers(1, 3))
    columns = draw(st.integers(2, max(2, most_cells // lanes)))
    every = list(itertools.product(range(columns), range(lanes)))
    blocked = draw(st.lists(st.sampled_from(every), max_size=1))
    cells = [cell for cell in every if cell not in blocked]
    count = draw(st.integers(1, min(most_vehicles, len(cells))))
    some_cells = st.permutations(cells)
    starts = draw(some_cells)[:count]
    targets = draw(some_cells)[: min(len(cells), count + draw(st.integers(0, 1)))]
    common = st.sampled_from(
        [("node", "edge", "special-1"), ("node", "edge", "special-1", "closing")]
    )
    any_kinds = st.lists(st.sampled_from(CONFLICT_KINDS), unique=True).map(tuple)
    preference = st.none() | st.lists(
        st.integers(0, len(targets) - 1), unique=True, min_size=1
    ).map(tuple)
    vehicles = tuple(
        VehicleRequest(f"v{i}", cell, eligible=draw(preference)) for i, cell in enumerate(starts)
    )
    kinds = draw(common | any_kinds)
    return PlanRequest(
        Grid(columns, lanes, blocked),
        mode,
        kinds,
        vehicles,
        tuple(targets),
        deadline_s,
        draw(st.sampled_from(GEOMETRIES)) if "geometric" in kinds else None,
    )
