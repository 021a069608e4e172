"""Vehicles on the road: body and motion controller, without an agent."""

from __future__ import annotations

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import State, cell_state
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.command_checks import NEIGHBOURING
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.paper import PAPER


def controller_in(
    cell: Cell, scenario: Scenario = PAPER, *, state: State | None = None, incarnation: int = 0
) -> MotionController:
    """Return the motion controller of a vehicle in a cell.

    Args:
        cell: where it holds.
        scenario: its limits and its lattice.
        state: of its body; None: at rest in the cell.
        incarnation: of the process in charge; 0: none.
    """
    start = cell_state(scenario.lattice, cell, 0.0) if state is None else state
    plant = Plant(start, scenario.vehicle, scenario.runtime.tick_s)
    moves = scenario.types.moves_of(CAR) or NEIGHBOURING
    controller = MotionController(plant, scenario, cell, moves)
    if incarnation:
        controller.store.put_in_charge(incarnation)
    return controller


def known(controller: MotionController) -> tuple[object, ...]:
    """Return all that a motion controller knows."""
    return (
        controller.record.incarnation,
        controller.record.joined,
        controller.record.accepted,
        controller.command_tick,
        controller.hold_cell,
        controller.motion,
        controller._jerks.tobytes(),
    )


def vehicle_in(
    cell: Cell,
    name: str = "A",
    scenario: Scenario = PAPER,
    *,
    exact: bool = True,
    controller: MotionController | None = None,
) -> RoadVehicle:
    """Return a vehicle that entered a cell at road time 0, by default with exact sensors."""
    admission = Admission(Arrival(name, cell[1], cell[1], 0.0), cell, 0.0)
    vehicle = RoadVehicle.entering(admission, 0.0, scenario)
    if exact:
        vehicle.sensors = None
    if controller is not None:
        vehicle.controller = controller
    return vehicle
