"""Planted bugs of ramps and exits."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from laneweave.agents.core import AgentCore
from laneweave.protocol.road_layout import Exits
from laneweave.protocol.scenario.vehicle_types import VehicleTypes
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle


def ramps_are_issued_at_the_start(patch: pytest.MonkeyPatch) -> None:
    """The cells of a ramp are also assigned as they pass the start of the road."""
    assign = Roadside.assign_empty_cells

    def twice(self: Roadside, vehicles: Mapping[Name, RoadVehicle]) -> None:
        assign(self, vehicles)
        for one in list(vehicles.values()):
            for lane, entry_m in enumerate(self._meter._entry_m):
                if entry_m > 0.0 and one.arrival.lane != lane:
                    one.controller.store.assign_cell((one.admission.cell[0], lane))

    patch.setattr(Roadside, "assign_empty_cells", twice)


def cells_are_passed_on_twice(patch: pytest.MonkeyPatch) -> None:
    """Two vehicles get each cell of a vehicle that leaves."""
    on_left = Roadside.on_left

    def twice(
        self: Roadside, vehicle: RoadVehicle, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> None:
        on_left(self, vehicle, vehicles, t_s)
        for one in list(vehicles.values())[:1]:
            for cell in vehicle.controller.store.certain_cells:
                one.controller.store.assign_cell(cell)

    patch.setattr(Roadside, "on_left", twice)


def exits_are_closed(patch: pytest.MonkeyPatch) -> None:
    """Vehicles in the lane of an exit drive on."""
    left_by = Exits.left_by

    def later(self: Exits, lane: int, s_m: float) -> object:
        return left_by(self, lane, s_m) if s_m >= self._length_m else None

    patch.setattr(Exits, "left_by", later)


def late_commands_repeat_moves(patch: pytest.MonkeyPatch) -> None:
    """A vehicle that holds its cell again executes a late command for the move."""
    back = MotionController.return_to_origin

    def forgetful(self: MotionController, t_s: float) -> bool:
        tick = self.command_tick
        done = back(self, t_s)
        self.command_tick = tick
        return done

    patch.setattr(MotionController, "return_to_origin", forgetful)


def gates_stay_open(patch: pytest.MonkeyPatch) -> None:
    """An agent waits for ever with a move that can no longer begin."""
    patch.setattr(PlanExecution, "stuck", False)


def agents_insist(patch: pytest.MonkeyPatch) -> None:
    """An agent does not notice that its move was taken back."""
    patch.setattr(AgentCore, "_has_lost_track", lambda *_: False)


def types_are_ignored(patch: pytest.MonkeyPatch) -> None:
    """Leaders move trucks like cars, and their agents take such plans."""
    patch.setattr(VehicleTypes, "moves_of", lambda _self, _type: None)
