"""The rolling planner of a scenario's road, and the check that every plan has to pass."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.rolling.planner import (
    StreamCosts,
    StreamPlan,
    StreamPlanner,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.planning.rolling.validator import problems_of_plan
from laneweave.protocol.lattice import Cell, Mode
from laneweave.protocol.scenario.tables import Scenario

REWARD = -0.5
"""Cost of a column gained if drift is rewarded; a move costs 0.3."""


class Planner(Protocol):
    """Plans all vehicles on the road; `StreamPlanner` except in fault searches and tests."""

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
    ) -> StreamPlan:
        """Return paths for all vehicles from the beginning of a slot on."""


class CheckedPlanner:
    """Refuses plans that break a rule; a check takes half a millisecond."""

    def __init__(self, road: StreamRoad, planner: Planner) -> None:
        """Check what a planner plans for a road."""
        self._road, self._planner = road, planner

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
    ) -> StreamPlan:
        """Return paths for all vehicles from the beginning of a slot on.

        Raises:
            ValueError: the vehicles contradict each other, or the plan is wrong.
        """
        table = self._planner.plan(slot, vehicles, before, blocked)
        problems = problems_of_plan(self._road, table, vehicles, blocked)
        if problems:
            raise ValueError(f"the plan of slot {slot} is wrong: {'; '.join(problems)}")
        return table


def stream_planner(scenario: Scenario) -> Planner:
    """Return the planner of a scenario's road."""
    road = stream_road(scenario)
    return CheckedPlanner(road, StreamPlanner(road, _costs(scenario), scenario.seed))


def stream_road(scenario: Scenario) -> StreamRoad:
    """Return the road of a scenario as the rolling planner needs it."""
    formation, road = scenario.formation, scenario.road
    mode: Mode = 1 if formation.mode == 1 else 2
    return StreamRoad(
        lanes=road.lanes,
        pitch_m=formation.gap_m,
        advance_m=formation.speed_mps * scenario.cycles_s[0],
        sorting_m=(scenario.moves_from_m, road.length_m),
        length_m=road.length_m,
        body_m=scenario.vehicle.length_m,
        mode=mode,
        model=ConflictModel(formation.conflict_kinds),
    )


def _costs(scenario: Scenario) -> StreamCosts:
    return StreamCosts(forward=REWARD if scenario.formation.reward_drift else 0.0)
