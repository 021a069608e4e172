"""Random formation switches, planned by the default solver and driven on the timetable.

Step k of a plan begins at t0 + k T_F, in closed loop on a `driving.Road`. At the lattice points
t0 + k T_F every body should be at its cell's point, whether it moved or held.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import count
from random import Random
from typing import Any

import numpy as np
from attrs import frozen

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plans import plan_problems
from laneweave.protocol.wire.messages import Name
from support.driving import (
    LimitUse,
    Road,
    lattice_errors_m,
    limit_figures,
    limit_use,
    road_scenario,
)
from support.states import make_plan

WITHIN_ALONG_M = 0.2
WITHIN_ACROSS_M = 0.1
"""A body this close is at its lattice point."""
SHARE_WITHIN = 0.999
LEAST_GAP_M = 9.0
"""Goals: share of lattice points, and gap of bodies that overlap laterally."""

VEHICLES = (3, 8)
COLUMNS = (6, 10)
LANES = (2, 4)

_LEAD_S = 1.0
"""All hold for so long before step 0."""
_DEADLINE_S = 60.0
_MAX_NODES = 2_000
"""Nodes, not time, bound the search: equal seeds give equal plans."""


@frozen
class Switch:
    """A formation switch with a plan."""

    scenario: Scenario
    names: tuple[Name, ...]
    paths: tuple[tuple[Cell, ...], ...]
    """By vehicle, then step: its cells, the start cell first."""
    skipped: int
    """Requests before this one that have no plan, or none that was found in time."""

    @property
    def steps(self) -> int:
        """How many slots it takes."""
        return len(self.paths[0]) - 1

    def begins(self, step: int) -> dict[Name, PlannedMove]:
        """Return the moves that begin with a step."""
        return {
            name: (step, path[step], path[step + 1])
            for name, path in zip(self.names, self.paths, strict=True)
            if path[step] != path[step + 1]
        }


@frozen
class SwitchResult:
    """Result of a switch."""

    index: int
    mode: int
    vehicles: int
    steps: int
    skipped: int
    errors_m: tuple[tuple[float, float], ...]
    """Distance from each lattice point, along and across."""
    least_gap_m: float
    overlaps: int
    limits: dict[str, LimitUse]
    braked: int
    late: int
    unusable: int


def random_switch(
    seed: int, index: int, vehicles: tuple[int, int] = VEHICLES, columns: tuple[int, int] = COLUMNS
) -> Switch:
    """Return a switch of 3 to 8 vehicles; even numbers are in mode 1, odd ones in mode 2.

    Args:
        seed: of the programme, and of the noise of measurement.
        index: number of the switch.
        vehicles: fewest and most.
        columns: fewest and most.
    """
    mode = 1 + index % 2
    for skipped in count():
        rng = Random(f"{seed}:{index}:{skipped}")
        lanes = rng.randint(*LANES)
        scenario = road_scenario(seed, mode, lanes)
        # Noise is drawn from seed and name.
        names = tuple(Name(f"s{index}v{i}") for i in range(rng.randint(*vehicles)))
        response = plan(
            _request(rng, scenario, names, Grid(rng.randint(*columns), lanes)), max_nodes=_MAX_NODES
        )
        if response.paths:
            return _legal(Switch(scenario, names, response.paths, skipped))
    raise AssertionError


def _request(rng: Random, scenario: Scenario, names: tuple[Name, ...], grid: Grid) -> PlanRequest:
    cells = [(column, lane) for column in range(grid.columns) for lane in range(grid.lanes)]
    starts, targets = rng.sample(cells, len(names)), rng.sample(cells, len(names))
    # Half of the formations want lanes, as on the road; otherwise every vehicle has a target.
    by_lane = rng.random() < 0.5
    requests = [
        VehicleRequest(name, cell, lane=targets[i][1])
        if by_lane
        else VehicleRequest(name, cell, eligible=(i,))
        for i, (name, cell) in enumerate(zip(names, starts, strict=True))
    ]
    return PlanRequest(
        grid=grid,
        mode=1 if scenario.formation.mode == 1 else 2,
        conflicts=scenario.formation.conflict_kinds,
        vehicles=tuple(requests),
        targets=tuple(targets),
        deadline_s=_DEADLINE_S,
    )


def _legal(switch: Switch) -> Switch:
    """Return a switch that vehicles would accept as a PLAN."""
    by_step = [switch.begins(step) for step in range(switch.steps)]
    plan = make_plan(
        {name: path[0] for name, path in _paths(switch)},
        {name: tuple(b[name] for b in by_step if name in b) for name in switch.names},
        t0_s=_LEAD_S,
        slot_s=switch.scenario.timing.cycles_s[0],
    )
    if problems := plan_problems(plan):
        raise RuntimeError("an illegal plan: " + "; ".join(problems))
    return switch


def drive(switch: Switch) -> Road:
    """Drive a switch on the timetable, and a slot beyond its end."""
    road = Road(switch.scenario, {name: path[0] for name, path in _paths(switch)})
    first, slot = _ticks(switch.scenario)
    for tick in range(first + (switch.steps + 1) * slot):
        step, phase = divmod(tick - first, slot)
        begins = phase == 0 and 0 <= step < switch.steps
        road.step(switch.begins(step) if begins else None)
    return road


def _paths(switch: Switch) -> Iterable[tuple[Name, tuple[Cell, ...]]]:
    return zip(switch.names, switch.paths, strict=True)


def _ticks(scenario: Scenario) -> tuple[int, int]:
    """Return the tick of t0 and the ticks of a slot."""
    tick_s = scenario.runtime.tick_s
    return round(_LEAD_S / tick_s), round(scenario.timing.cycles_s[0] / tick_s)


def switch_result(
    seed: int, index: int, vehicles: tuple[int, int] = VEHICLES, columns: tuple[int, int] = COLUMNS
) -> SwitchResult:
    """Make, drive and measure a switch; see `random_switch`."""
    switch = random_switch(seed, index, vehicles, columns)
    road = drive(switch)
    first, slot = _ticks(switch.scenario)
    points = range(1, switch.steps + 1)
    errors = lattice_errors_m(
        road.record,
        switch.scenario,
        [first + k * slot for k in points],
        [[path[k] for path in switch.paths] for k in points],
    )
    return SwitchResult(
        index=index,
        mode=switch.scenario.formation.mode,
        vehicles=len(switch.names),
        steps=switch.steps,
        skipped=switch.skipped,
        errors_m=tuple((along, across) for along, across in errors.reshape(-1, 2).tolist()),
        least_gap_m=min(road.record.gaps_m),
        overlaps=len(road.record.overlaps),
        limits=limit_use(road.record, switch.scenario),
        braked=road.braked,
        late=road.late,
        unusable=road.unusable,
    )


def summary(results: Iterable[SwitchResult]) -> dict[str, Any]:
    """Return the figures of some switches."""
    results = list(results)
    # A switch from a formation into itself has no points.
    errors = np.array([error for one in results for error in one.errors_m]).reshape(-1, 2)
    within = (errors[:, 0] <= WITHIN_ALONG_M) & (errors[:, 1] <= WITHIN_ACROSS_M)
    worst = max(results, key=lambda one: max((max(e) for e in one.errors_m), default=0.0))
    closest = min(results, key=lambda one: one.least_gap_m)
    return {
        "switches": len(results),
        "skipped": sum(one.skipped for one in results),
        "vehicles": sum(one.vehicles for one in results),
        "steps": sum(one.steps for one in results),
        "points": len(errors),
        "share_within": float(within.mean()),
        "worst_along_m": float(errors[:, 0].max()),
        "worst_across_m": float(errors[:, 1].max()),
        "p99_along_m": float(np.percentile(errors[:, 0], 99)),
        "p99_across_m": float(np.percentile(errors[:, 1], 99)),
        "worst_switch": worst.index,
        "least_gap_m": closest.least_gap_m,
        "closest_switch": closest.index,
        "overlaps": sum(one.overlaps for one in results),
        **limit_figures([one.limits for one in results]),
        "braked": sum(one.braked for one in results),
        "late": sum(one.late for one in results),
        "unusable": sum(one.unusable for one in results),
    }


def missed_goals(figures: dict[str, Any]) -> list[str]:
    """Return which goals the figures of `summary` miss, in words."""
    missed = []
    if figures["share_within"] < SHARE_WITHIN:
        missed.append(f"{figures['share_within']:.4%} of the lattice points are met")
    if figures["least_gap_m"] < LEAST_GAP_M:
        missed.append(f"the least gap is {figures['least_gap_m']:.3f} m")
    missed += [
        f"{name} is violated in {ticks} vehicle ticks, by {figures['excess'][name]:.3g} at most"
        for name, ticks in figures["violations"].items()
        if ticks
    ]
    missed += [
        f"{name}: {figures[name]}, not 0" for name in ("overlaps", "braked") if figures[name]
    ]
    return missed
