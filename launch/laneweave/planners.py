"""Interface of planners that users add; docs/OWN_PLANNER.md explains it.

A planner is a function from a `PlanRequest` and `PlanLimits` to one path per vehicle, named by an
entry point of the group `laneweave.planners`. Then `laneweave run --solver NAME`, `laneweave plan
--solver NAME`, coordinators, and requests with `"solver": "NAME"` use it.
"""

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.plan_validator import problems_of_paths
from laneweave.coordinator.planning.plug_ins.registry import Paths, PlanLimits, Planner
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.protocol.lattice import Cell, displacements

__all__ = (
    "Cell",
    "ConflictModel",
    "Grid",
    "Move",
    "Paths",
    "PlanLimits",
    "PlanRequest",
    "Planner",
    "VehicleRequest",
    "displacements",
    "problems_of_paths",
)
