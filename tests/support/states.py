"""VEHICLE_STATE messages for tests."""

from __future__ import annotations

from typing import Any

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Ballot, Name, VehicleState


def holding(
    vehicle: Name, promised: Ballot | None, hold_cell: Cell = (0, 0), **more: object
) -> VehicleState:
    """Return the state of a vehicle of formation 0; `more` replaces or adds fields."""
    values: dict[str, Any] = {
        "vehicle": vehicle,
        "incarnation": 1,
        "formation": 0,
        "joined": (0,),
        "promised": promised,
        "accepted": False,
        "ready": False,
        "completed": 0,
        "hold_cell": hold_cell,
        "moving": False,
        "go": False,
        "done": False,
        "overdue": False,
        "attended": True,
        "s_m": 0.0,
        "y_m": 0.0,
        "speed_mps": 0.0,
        "t_s": 0.0,
    }
    return VehicleState(**(values | more))
