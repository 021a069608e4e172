"""`laneweave bench planner`: seeded formations of growing size (`request_families`).

Measures single-thread CPU time with compiled code loaded: median and 95th percentile over the
instances of a size and family, including those that reach the deadline.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from statistics import fmean
from typing import Any, Final

import attrs
import numpy as np
from rich.table import Table

from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.launch.bench.request_families import (
    TRAFFIC_KINDS,
    block_request,
    formation_request,
    traffic_request,
)
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Mode
from laneweave.sim_bridge.recording.statistics import percentiles_of


@attrs.frozen
class Family:
    """A motion mode, conflict kinds, and a generator of requests."""

    mode: Mode
    conflicts: tuple[str, ...]
    make: Callable[..., PlanRequest] = formation_request
    """Function from `request_families`."""

    def request(self, seed: int, vehicles: int, deadline_s: float) -> PlanRequest:
        """Return a request.

        Raises:
            BadInputError: the vehicles do not fit into a block.
        """
        try:
            return self.make(
                seed,
                vehicles=vehicles,
                mode=self.mode,
                conflicts=self.conflicts,
                deadline_s=deadline_s,
            )
        except ValueError as error:
            raise BadInputError("--vehicles", vehicles, f"fewer ({error})") from error


FAMILIES: Final[dict[str, Family]] = {
    "node-edge": Family(1, ("node", "edge")),
    "following": Family(1, ("node", "edge", "special-1")),
    "geometric": Family(2, ("geometric",)),
    "block": Family(1, ("node", "edge", "special-1"), block_request),
    "traffic": Family(1, TRAFFIC_KINDS, traffic_request),
}
EARLY_DEADLINE_S = 0.1
"""Short deadline for counting early feasible plans."""


def bench_planner(
    vehicles: Sequence[int],
    families: Sequence[str],
    *,
    instances: int,
    seed: int,
    deadline_s: float,
    solver: str,
) -> Iterator[dict[str, Any]]:
    """Measure the planner.

    Args:
        vehicles: formation sizes; in the family `traffic` the largest ones.
        families: names from `FAMILIES`.
        instances: number of instances per size and family.
        seed: seed of the first instance; it increases by 1 per instance.
        deadline_s: deadline of each request.
        solver: solver to run, without a fallback; see `plan`.

    Yields:
        One row per family and size.

    Raises:
        BadInputError: a size does not fit into a family; nothing has been measured.
    """
    drawn = {
        (family, size): [
            FAMILIES[family].request(seed + index, size, deadline_s) for index in range(instances)
        ]
        for family in families
        for size in vehicles
    }
    BRANCHING.load()
    for (family, size), requests in drawn.items():
        yield {
            "family": family,
            "vehicles": size,
            "mean_vehicles": round(fmean(len(one.vehicles) for one in requests), 1),
            "instances": instances,
            "solver": solver,
            "deadline_s": deadline_s,
            **_measured(requests, solver),
        }


def _measured(requests: Sequence[PlanRequest], solver: str) -> dict[str, Any]:
    times_ms, gaps, early_plans = [], [], 0
    statuses: list[str] = []
    for request in requests:
        began = time.thread_time()
        response = _plan(request, solver)
        times_ms.append((time.thread_time() - began) * 1e3)
        statuses.append(response.status)
        gaps.append(gap_percent(response))
        if times_ms[-1] > EARLY_DEADLINE_S * 1e3:
            urgent = attrs.evolve(request, deadline_s=EARLY_DEADLINE_S)
            response = _plan(urgent, solver)
        early_plans += response.cost is not None
    finite = np.array([gap for gap in gaps if math.isfinite(gap)])
    return {
        "optimal": statuses.count("optimal"),
        "feasible": statuses.count("feasible"),
        "cpu_ms": percentiles_of(np.array(times_ms), 50, 95, largest=True),
        "gap_percent": percentiles_of(finite, 50, largest=True),
        "answered_in_100_ms": early_plans,
        "late_ms": round(max(0.0, max(times_ms) - 1e3 * requests[0].deadline_s), 1),
    }


def _plan(request: PlanRequest, solver: str) -> PlanResponse:
    """Plan within a deadline in CPU time, so that other processes do not affect the results."""
    return plan(request, solver=solver, fallback=False, clock=time.thread_time)


def gap_percent(response: PlanResponse) -> float:
    """Return the gap between cost and lower bound, relative to the lower bound [%]."""
    if response.cost is None or response.lower_bound is None:
        return math.inf
    return 100.0 * (response.cost - response.lower_bound) / max(response.lower_bound, 1)


def planner_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the results of `bench_planner` as a table."""
    table = Table(
        "conflicts",
        "vehicles",
        "optimal",
        "CPU ms p50",
        "p95",
        "max",
        "gap % p50",
        "max",
        "by 0.1 s",
    )
    for row in rows:
        cpu, gap = row["cpu_ms"], row["gap_percent"]
        table.add_row(
            row["family"],
            f"{row['mean_vehicles']:g}",
            f"{row['optimal']} of {row['instances']}",
            *(f"{cpu[name]:.1f}" for name in ("p50", "p95", "max")),
            *("-" if gap[name] is None else f"{gap[name]:.1f}" for name in ("p50", "max")),
            f"{row['answered_in_100_ms']}",
        )
    return table
