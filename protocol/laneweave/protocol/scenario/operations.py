"""The operations: in what they differ, apart from their coordinators and what vehicles own.

`OPERATIONS` describes each value of `formation.operation`; `protocol.vehicle.territory` says what
vehicles own in each.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from attrs import frozen

DEFAULT_OPERATION: Final = "formations"
ROLLING_SOLVER: Final = "rolling"
"""Name of the rolling operation's planner, also in counts of plans by solver."""


@frozen
class OperationTraits:
    """In what an operation differs from others."""

    has_formations: bool
    """Whether vehicles drive in formations, which need room for all of their vehicles together."""
    unused: frozenset[str]
    """Fields and tables of a scenario file that have no effect, and are therefore rejected."""
    entry_spread: float
    """Maximum time between a vehicle and its cell as they pass the start of the road, as a share of
    the time between two cells. With half of it, a vehicle waits only if it is too close behind
    another vehicle. With more, vehicles catch up with cells left empty, so queues dissolve sooner.
    """
    common_slots: bool
    """Whether all vehicles move in the same slots, so that there is one T_F."""
    closing_mps: float | None
    """Speed at which a vehicle may close up to another if T_F is not given; None: v_F / 2."""
    accel_ratio: float
    """Peak acceleration of a minimum-jerk move, divided by the limit, if T_F is not given."""
    clearing_slots: int
    """Time in slots that vehicles get to leave the lane ahead of a fast vehicle that enters: one
    for planning, one for each vehicle that can leave only after a neighbour."""
    planner: str | None = None
    """Name of the operation's own planner; None: `formation.solver` is used."""


OPERATIONS: Mapping[str, OperationTraits] = MappingProxyType(
    {
        DEFAULT_OPERATION: OperationTraits(
            has_formations=True,
            unused=frozenset(
                {
                    "formation.sort_in_s2",
                    "formation.reward_drift",
                    "formation.change_columns",
                    "road.restrictions",
                    "road.solid_lines",
                    "sumo.config",
                }
            ),
            entry_spread=0.75,
            common_slots=False,
            # Plans of formations need short slots where many steps must fit. The check of moves
            # refuses a few scenarios more, and asks for a longer T_F.
            closing_mps=8.0,
            accel_ratio=1.3,
            clearing_slots=4,  # formations settle first
        ),
        "rolling": OperationTraits(
            has_formations=False,
            unused=frozenset(
                {
                    "formation.entry",
                    "formation.close",
                    "formation.max_vehicles",
                    "formation.max_columns",
                    "formation.max_joined",
                    "formation.join",
                    "formation.structures",
                    "formation.targets",
                    "formation.solver",
                    "formation.weight_straight",
                    "formation.weight_oblique",
                    "formation.planning_deadline_s",
                    "formation.max_nodes",
                }
            ),
            entry_spread=0.5,
            common_slots=True,
            closing_mps=None,
            accel_ratio=1.2,
            clearing_slots=3,
            planner=ROLLING_SOLVER,
        ),
    }
)
