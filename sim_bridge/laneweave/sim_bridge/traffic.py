"""A vehicle on the road."""

from __future__ import annotations

from attrs import define

from laneweave.protocol.messages import Name, Neighbour, Sense
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
            min_gap_m=scenario.tracking.min_gap_m,
        )
        return cls(Name(admission.arrival.vehicle), admission, controller)

    @property
    def state(self) -> State:
        """(s m, v m/s, a m/s2, y m, v_y m/s, a_y m/s2)."""
        return self.controller.plant.state

    @property
    def formation(self) -> int:
        """Number of the formation in whose block it entered."""
        return self.controller.lattice.block_of(self.admission.cell[0])

    def sense(self, tick: int, *, caretaker: bool, left: bool = False) -> Sense:
        """Return what its sensors and its motion controller know at a tick.

        Args:
            tick: number of the tick that begins.
            caretaker: whether its caretaker is in charge.
            left: whether it has left the road.
        """
        controller = self.controller
        return Sense(
            vehicle=self.name,
            tick=tick,
            t_s=tick * controller.tick_s,
            state=self.state,
            hold_cell=controller.hold_cell,
            motion_end_tick=controller.motion_end_tick,
            motion_origin=controller.motion_origin,
            preferred_lane=self.admission.arrival.preferred_lane,
            ahead=self.ahead,
            formation=self.formation,
            attendant=controller.attendant,
            caretaker=caretaker,
            joined=controller.joined,
            accepted=controller.accepted,
            left=left,
        )

    def step(self, tick: int) -> None:
        """Drive from `tick` to the next one."""
        self.controller.step(tick, self.ahead)
