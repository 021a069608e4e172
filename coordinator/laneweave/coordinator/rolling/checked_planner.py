"""The rolling planner for a scenario's road; every plan is checked."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial

from attrs import evolve

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.kernels import ROLLING
from laneweave.coordinator.planning.rolling.problem import (
    OpenRoad,
    StreamCosts,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.planning.rolling.rolling_validator import problems_of_plan
from laneweave.protocol.lattice import Cell, Mode
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import READY_LATE_S
from laneweave.protocol.scenario.road_geometry import first_moves_m
from laneweave.protocol.vehicle.lane_ends import early_start_m, sections_to_lines

REWARD = -0.5
"""Extra cost of a move that gains a column if drift is rewarded; a move costs 0.3."""
_MAX_ANNEALS = 6
"""Maximum number of annealings per slot (decision 76)."""
_MAX_WORK = 600.0
"""Maximum product of this number and n squared, where vehicles may move during n slots.

The time of a path search grows with n squared, so longer roads get fewer annealings."""
_MODE_2_WORK = 1.7
"""Time of an annealing in mode 2, with moves to eight cells, relative to mode 1."""
_FULL_CYCLE_S = 5.0
"""Shortest T_F [s] with the full `_MAX_WORK`; below it, the maximum is proportional to T_F."""


Planner = Callable[
    [int, Sequence[StreamVehicle], StreamPlan | None, Collection[Cell], OpenRoad | None],
    StreamPlan,
]
"""Function of slot, vehicles, previous plan, blocked cells, and what of the road is open now.

It returns paths for all vehicles from that slot on; `StreamPlanner.plan` except in fault searches
and tests."""


def checked(road: StreamRoad, planner: Planner) -> Planner:
    """Return a planner that raises `ValueError` for invalid plans.

    It can be copied and pickled if `planner` can.
    """
    return partial(_checked_plan, road, planner)


def _checked_plan(
    road: StreamRoad,
    planner: Planner,
    slot: int,
    vehicles: Sequence[StreamVehicle],
    before: StreamPlan | None,
    blocked: Collection[Cell],
    now: OpenRoad | None,
) -> StreamPlan:
    table = planner(slot, vehicles, before, blocked, now)
    problems = problems_of_plan(road.as_open(now), table, vehicles, blocked)
    if problems:
        raise ValueError(f"the plan of slot {slot} is invalid: {'; '.join(problems)}")
    return table


def stream_planner(scenario: Scenario) -> Planner:
    """Return the checked planner for a scenario's road; compile it if necessary (`kernels`).

    Raises:
        CacheError: it cannot be compiled.
    """
    from laneweave.coordinator.planning.rolling.path_search import StreamPlanner  # noqa: PLC0415 (numba is slow to load)

    ROLLING.load()
    road = stream_road(scenario)
    costs = StreamCosts(forward=REWARD) if scenario.formation.reward_drift else StreamCosts()
    return checked(road, StreamPlanner(road, costs, scenario.seed).plan)


def stream_road(scenario: Scenario) -> StreamRoad:
    """Return a scenario's road as input for the rolling planner."""
    formation, road = scenario.formation, scenario.road
    mode: Mode = 1 if formation.mode == 1 else 2
    # A vehicle that settles may begin a move late, and ahead of its cell.
    ahead_m = formation.speed_mps * READY_LATE_S + scenario.types.room_ahead_m
    around_m = first_moves_m(
        road.s1_m, road.s2_m, formation.speed_mps, formation.settle_s, in_s2=True
    )
    cycle_s = scenario.timing.cycles_s[0]
    advance_m = formation.speed_mps * cycle_s
    moves_from_m = scenario.geometry.moves_from_m
    slots = (road.length_m - moves_from_m) / advance_m
    work = max(1.0, slots) ** 2 * (_MODE_2_WORK if mode == 2 else 1.0)
    max_work = _MAX_WORK * min(1.0, cycle_s / _FULL_CYCLE_S)
    return StreamRoad(
        around_m=around_m,
        lanes=road.lanes,
        pitch_m=formation.gap_m,
        advance_m=advance_m,
        sorting_m=(moves_from_m, road.length_m),
        anneals=max(1, min(_MAX_ANNEALS, int(max_work / work))),
        length_m=road.length_m,
        body_m=scenario.types.longest_body_m,
        mode=mode,
        model=ConflictModel(formation.conflict_kinds),
        sections=sections_to_lines(scenario),
        early_m=None if formation.change_columns else early_start_m(scenario),
        restrictions=tuple(
            evolve(one, from_m=max(0.0, one.from_m - ahead_m)) for one in road.restrictions
        ),
        solid_lines=tuple(
            evolve(one, from_m=max(0.0, one.from_m - ahead_m)) for one in road.solid_lines
        ),
    )
