"""The caretaker: it speaks for a vehicle whose agent died, fell silent, or never came.

It has no I/O, clock or randomness. It runs the same plan execution as an agent and shows the same
states, with two differences: it never starts a move, and it accepts only plans in which its own
vehicle has none. So whoever plans for the vehicle's formation need not wait for the agent and need
not guess: the vehicle promises where it stays, and the others are planned around it.

What its vehicle does is not its work: the motion controller finishes the trajectory that it has
and holds. The caretaker gives way as soon as an agent claims the vehicle with a COMMAND.
"""

from __future__ import annotations

from laneweave.protocol.vehicle.execution import PlanExecution
from laneweave.protocol.wire.messages import Plan, Prepare, VehicleState
from laneweave.sim_bridge.road.vehicle import RoadVehicle


class Caretaker:
    """Whoever is in charge of one vehicle in place of its agent."""

    def __init__(self, vehicle: RoadVehicle, incarnation: int, tick: int) -> None:
        """Take charge of a vehicle, whatever it is doing.

        Args:
            vehicle: the vehicle.
            incarnation: greater than that of any process that was in charge before.
            tick: number of the tick that begins.

        Raises:
            ValueError: the incarnation is not greater than the one in charge.
        """
        controller = vehicle.controller
        controller.hand_over(incarnation)
        self._vehicle = vehicle
        self._execution = PlanExecution(
            vehicle=vehicle.name,
            incarnation=incarnation,
            hold_cell=controller.hold_cell,
            lattice=controller.lattice,
            joined=controller.joined,
            moving=controller.moving(tick),
            estate=frozenset(controller.estate) if controller.rolling else None,
        )
        self._execution.on_estate(vehicle.sense(tick, caretaker=True))

    def on_message(self, message: Prepare | Plan, tick: int) -> VehicleState | None:
        """V2 and V3: promise, or accept a plan in which this vehicle only holds.

        Returns:
            The state to show at once; None: there is nothing to say.
        """
        execution, controller = self._execution, self._vehicle.controller
        if isinstance(message, Prepare):
            heeded = execution.on_prepare(message)
            controller.join(execution.wanted_joined)
            execution.on_joined(controller.joined)
            if execution.promised is not None:
                controller.promise(execution.promised)
        else:
            execution.on_estate(self._vehicle.sense(tick, caretaker=True))
            heeded = not message.moves.get(execution.vehicle) and execution.on_plan(message)
            if heeded:
                if execution.deed is not None:
                    controller.draw_up(execution.deed)
                controller.accept(message.ballot)
                execution.on_noted(controller.accepted)
        return self.show(tick) if heeded else None

    def show(self, tick: int) -> VehicleState:
        """Return what to show at a tick; V7 when the controller's motion has ended by then."""
        vehicle, execution = self._vehicle, self._execution
        if execution.moving and not vehicle.controller.moving(tick):
            execution.end_motion()
        sense = vehicle.sense(tick, caretaker=True)
        return execution.state(sense, vehicle.block, attended=False)
