"""Slow and obvious answers to compare the planner with."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Sequence
from random import Random
from typing import Any

from attrs import define, evolve
from hypothesis import strategies as st

from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.problem import Bans, Path
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import Mode, displacements
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS, SOLVERS
from oracles import joint_search
from oracles.moving_bodies import Bodies, drive
from oracles.path_rules import check_paths

DEADLINE_S = 60.0
"""Comparisons are about costs, not about times."""


@define
class CountingClock:
    """A clock that goes on whenever it is read."""

    tick_s: float
    now_s: float = 0.0

    def __call__(self) -> float:
        """Return the next time."""
        self.now_s += self.tick_s
        return self.now_s


def cheapest_plan(request: PlanRequest, fixed: Sequence[int] | None = None) -> int | None:
    """Return the minimum cost, or None; `fixed`: the target of each vehicle."""
    document = request.to_dict()
    for vehicle, target in zip(document["vehicles"], fixed or (), strict=False):
        vehicle["eligible"] = [target]
    return joint_search.optimal_cost(document)


def move_at(path: Path, target: int, step: int) -> int:
    """Return the move that a path makes in a step; after its end it stays at the target."""
    return path[step] if step < len(path) else target


def obeys(path: Path, target: int, bans: Bans) -> bool:
    """Return whether a path to a target makes no banned move, and is as long as it may be."""
    if len(path) < bans.earliest or (bans.latest is not None and len(path) > bans.latest):
        return False
    for step in range(max([len(path), *bans.at, *bans.since]) + 1):
        banned = bans.at.get(step, 0)
        for since, mask in bans.since.items():
            banned |= mask if step >= since else 0
        if banned >> move_at(path, target, step) & 1:
            return False
    return True


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
    draw: st.DrawFn,
    *,
    most_vehicles: int = 3,
    most_cells: int = 8,
    deadline_s: float = 60.0,
    limited: bool = False,
) -> PlanRequest:
    """Draw small requests over both modes, all sets of conflicts and some geometries.

    Some vehicles cannot drive all moves; with `limited` at least one cannot, and vehicles do not
    share cells.
    """
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
    possible = displacements(mode)[1:]
    some_moves = st.sampled_from(
        (None, None, tuple(move for move in possible if move[0] == 0))
    ) | st.lists(st.sampled_from(possible), unique=True).map(tuple)
    vehicles = tuple(
        VehicleRequest(f"v{i}", cell, eligible=draw(preference), moves=draw(some_moves))
        for i, cell in enumerate(starts)
    )
    if limited:
        lanes_only = tuple(move for move in possible if move[0] == 0)
        vehicles = (evolve(vehicles[0], moves=lanes_only), *vehicles[1:])
    kinds = draw(common) if limited else draw(common | any_kinds)
    return PlanRequest(
        Grid(columns, lanes, blocked),
        mode,
        kinds,
        vehicles,
        tuple(targets),
        deadline_s,
        draw(st.sampled_from(GEOMETRIES)) if "geometric" in kinds else None,
    )
