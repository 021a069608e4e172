"""A vehicle on the road."""

from __future__ import annotations

from attrs import define

from laneweave.protocol.messages import Name, Neighbour
from laneweave.protocol.motion import State, cell_state
from laneweave.protocol.scenario import Scenario
from laneweave.sim_bridge.entry import Admission
from laneweave.sim_bridge.motion_controller import MotionController
from laneweave.sim_bridge.plant import Plant


@define
class RoadVehicle:
    """Body, motion controller and sensors of one vehicle."""

    name: Name
    admission: Admission
    controller: MotionController
    ahead: tuple[Neighbour, ...] = ()

    @classmethod
    def entering(cls, admission: Admission, t_s: float, scenario: Scenario) -> RoadVehicle:
        """Return a vehicle in the cell in which it was admitted, at road time `t_s`."""
        lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
        state = cell_state(lattice, admission.cell, t_s)
        controller = MotionController(
            Plant(state, scenario.vehicle, tick_s),
            scenario.vehicle,
            lattice,
            tick_s,
            admission.cell,
        )
        return cls(Name(admission.arrival.vehicle), admission, controller)

    @property
    def state(self) -> State:
        """(s m, v m/s, a m/s2, y m, v_y m/s, a_y m/s2)."""
        return self.controller.plant.state
