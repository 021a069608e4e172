"""A vehicle on the road: body, motion controller and sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Self

from attrs import define, evolve, field

from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Effect, Send
from laneweave.protocol.scenario.deployment_fields import MAX_HOLD_S
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.lane_ends import SOON_S, LaneEnds
from laneweave.protocol.vehicle.motion import State, cell_state
from laneweave.protocol.vehicle.sudden_stops import stopping_m
from laneweave.protocol.wire.messages import (
    ClosedFormation,
    Command,
    CurrentMotion,
    Name,
    Sense,
    addresses_of,
)
from laneweave.protocol.wire.topics import SENSE
from laneweave.sim_bridge.bodies.command_checks import NEIGHBOURING
from laneweave.sim_bridge.bodies.motion_controller import (
    FallbackLevel,
    MotionController,
    OffLatticePhase,
)
from laneweave.sim_bridge.bodies.overlaps_and_gaps import ExactNeighbours, Size, corners, pose_of
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.bodies.sensors import Sensors
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.sense_rate import SenseRate, Situation

NEAR_M = 0.01
"""Distance from its cell up to which an entering vehicle need not settle."""
RETURN_S = 4.5
"""Upper bound of the time in which a body that is in two lanes returns to its own."""


@define
class RoadVehicle:
    """Body, motion controller and sensors of one vehicle."""

    name: Name
    admission: Admission
    controller: MotionController
    sensors: Sensors | None = None
    """None: the vehicle knows its exact state, and no neighbours."""
    formation: int | None = None
    """Formation number (rolling operation: block number); None: not known yet."""
    bridge: int = 0
    """Incarnation of the bridge."""
    ready_s: float = 0.0
    """Road time from which a vehicle that has entered more slowly than v_F is in its cell, or
    almost [s]."""
    sense_rate: SenseRate = field(factory=SenseRate)
    processes: tuple[Name, ...] = ()
    """Processes with an agent for it, as in `CensusEntry`."""
    senders_per_km: float = 0.0
    """As in `Sense`."""

    @classmethod
    def entering(
        cls,
        admission: Admission,
        t_s: float,
        scenario: Scenario,
        bridge: int = 0,
        make_body: Callable[[State, Vehicle, float], Plant] = Plant,
    ) -> Self:
        """Return an admitted vehicle at road time `t_s`; it has driven at v_F since admission.

        The vehicle settles in its cell within `formation.settle_s`.
        """
        lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
        rest = cell_state(lattice, admission.cell, t_s)
        s_m, speed_mps, settle_s = rest[0] + admission.offset_m, rest[1], 0.0
        if abs(admission.offset_m) > NEAR_M:
            settle_s = scenario.formation.settle_s
        ready_s = 0.0
        if admission.start is not None:
            start = admission.start
            s_m, speed_mps = start.s_m, start.speed_mps
            settle_s, ready_s = start.settle_s, start.ready_s
        name = Name(admission.arrival.vehicle)
        limits = scenario.types[admission.arrival.vehicle_type].limits
        body = make_body((s_m, speed_mps, *rest[2:]), limits, tick_s)
        moves = scenario.types.moves_of(admission.arrival.vehicle_type) or NEIGHBOURING
        controller = MotionController(body, scenario, admission.cell, moves)
        if settle_s > 0.0:
            end_tick = round((t_s + settle_s) / tick_s)
            controller.motion = CurrentMotion(admission.cell, end_tick)
        controller.enter_lattice((admission.cell, *admission.more_cells))
        formation = None if scenario.formation.closes_by_vehicles else controller.record.joined[0]
        sensors = Sensors(scenario, name)
        return cls(name, admission, controller, sensors, formation, bridge, t_s + ready_s)

    @property
    def state(self) -> State:
        """(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""
        return self.controller.plant.state

    @property
    def size(self) -> Size:
        """Length and width of the body [m]."""
        return self.controller.plant.limits.size_m

    @property
    def body_lane(self) -> int:
        """Lane in which the centre of the body is."""
        return int(self.state[3] // self.controller.lattice.lane_width_m)

    @property
    def lanes_touched(self) -> range:
        """Lanes that the body touches, with its heading taken into account."""
        lattice = self.controller.lattice
        ys_m = [y_m for _, y_m in corners(pose_of(self.state), *self.size)]
        right_m, left_m = min(ys_m), max(ys_m)
        first, last = lattice.lanes_touched(0.5 * (right_m + left_m), left_m - right_m)
        return range(first, last + 1)

    @property
    def lanes_used(self) -> set[int]:
        """Lanes in which parts of the body are, or will be."""
        return {*self.lanes_touched, self.cell[1]}

    @property
    def has_cell(self) -> bool:
        """Whether it is on the lattice."""
        return self.controller.off_lattice is None

    @property
    def stops_m(self) -> float:
        """Position at which it stops if it begins to brake after its reaction time.

        After it has started in a part that is open again, it stops only beyond that part.
        """
        s_m, speed_mps = self.state[:2]
        return self.controller.stop_lines.section_m(self.body_lane, s_m) + stopping_m(speed_mps)

    @property
    def waits(self) -> bool:
        """Whether it waits for a lane to be open again; a vehicle that has broken down does not."""
        return not self.has_cell and self.controller.broken_mps2 is None

    @property
    def re_enters(self) -> bool:
        """Whether it has waited, and is on its way into a cell."""
        return self.controller.off_lattice is OffLatticePhase.RE_ENTERING

    @property
    def keeps_lane(self) -> bool:
        """Whether the body is in its lane, and no plan in force leads it out of its cell."""
        return self.controller.keeps_lane

    @property
    def block(self) -> int:
        """Number of the block in which the vehicle entered."""
        return self.controller.lattice.block_of(self.admission.cell[0])

    def close(self, lane_ends: LaneEnds, t_s: float) -> bool:
        """Replace the ends of lanes; return whether the vehicle takes back a move.

        Parts of lanes are closed for a time, or open again. In a formation, a vehicle that moves
        into such a lane returns to its own, unless it has left it, or would still be in both at the
        line, or its own ends soon, too. In the rolling operation it takes part in the plan that
        replaces that of the slot.
        """
        controller, lines = self.controller, self.controller.stop_lines
        before, lines.lane_ends = lines.lane_ends, lane_ends
        self.sense_rate.disturb()
        origin, target = controller.motion.origin, controller.hold_cell
        return (
            self.has_cell
            and not controller.store.territory.given_up_cells_stay_free
            and origin[1] != target[1]
            and lane_ends.closed_soon(target, t_s)
            and not before.closed_soon(target, t_s)
            and not lane_ends.has_passed(origin, t_s + SOON_S, body_m=self.state[0])
            and not (
                target[1] in self.lanes_touched and lane_ends.closed_soon(target, t_s, RETURN_S)
            )
            and controller.return_to_origin()
        )

    def join(self, closed: ClosedFormation) -> None:
        """Join a closed formation: plans must cover all of its blocks."""
        self.formation = closed.first_block
        self.sense_rate.disturb()  # its leader waits for a state of each member
        self.controller.store.join(closed.blocks)

    @property
    def arrival(self) -> Arrival:
        """Arrival at the entrance."""
        return self.admission.arrival

    @property
    def entered_s(self) -> float:
        """Road time at which the front passed the entrance."""
        return self.admission.t_s

    @property
    def cell(self) -> Cell:
        """Cell that the vehicle holds or moves to."""
        return self.controller.hold_cell

    @property
    def has_plan(self) -> bool:
        """Whether the process in charge has accepted a plan."""
        return self.controller.record.accepted is not None

    @property
    def level_ticks(self) -> Mapping[FallbackLevel, int]:
        """Ticks on each fallback level."""
        return self.controller.level_ticks

    def perceive(self, neighbours: ExactNeighbours) -> None:
        """Measure the states of the vehicle and of its neighbours."""
        if self.sensors is not None:
            measured = self.sensors.measure(self.state)
            self.controller.perceive(measured, self.sensors.measure_neighbours(neighbours))

    def sense(self, tick: int, *, caretaker: bool, left: bool = False) -> Sense:
        """Return the SENSE of a tick: measurements and state of the controller."""
        controller = self.controller
        neighbours = controller.neighbours
        return Sense(
            vehicle=self.name,
            tick=tick,
            t_s=tick * controller.tick_s,
            measured=controller.measured,
            hold_cell=controller.hold_cell,
            motion=controller.motion,
            preferred_lane=self.admission.arrival.preferred_lane,
            record=controller.record,
            ahead=neighbours.ahead,
            behind=neighbours.behind,
            setpoint=controller.plant.setpoint,
            block=self.block,
            caretaker=caretaker,
            left=left,
            bridge=self.bridge,
            off_lattice=controller.off_lattice is not None,
            vehicle_type=Name(self.arrival.vehicle_type),
            senders_per_km=self.senders_per_km,
        )

    def send_sense(self, tick: int, *, caretaker: bool = False, left: bool = False) -> list[Effect]:
        """Return the effects that send the SENSE of a tick to the processes with an agent."""
        sense = self.sense(tick, caretaker=caretaker, left=left)
        return [
            Send(SENSE, sense, {"process": process, "vehicle": self.name})
            for process in addresses_of(self.name, self.processes)
        ]

    @property
    def _situation(self) -> Situation:
        controller = self.controller
        return Situation.of(
            controller.record, controller.hold_cell, controller.motion, controller.neighbours
        )

    def hold(self, command: Command) -> None:
        """Register that the vehicle holds undisturbed, as its agent has said in a COMMAND."""
        most_ticks = round(MAX_HOLD_S / self.controller.tick_s)
        until_tick = command.tick + min(command.undisturbed_ticks, most_ticks)
        self.sense_rate.hold(self._situation, until_tick)

    def needs_sense(self, tick: int) -> bool:
        """Return whether the vehicle gets a SENSE in a tick; see `sense_rate`."""
        rate, controller = self.sense_rate, self.controller
        if not rate.full and (
            rate.is_over(tick)
            or controller.off_lattice is not None
            or controller.level > FallbackLevel.HOLD
            or not controller.has_settled(tick * controller.tick_s)
            or rate.is_disturbed_by(self._situation)
        ):
            rate.disturb()
        return rate.full

    def enter_lattice(self, cells: Sequence[Cell]) -> None:
        """Enter the lattice again: the roadside assigns cells, among them the hold cell."""
        self.admission = evolve(self.admission, cell=self.controller.hold_cell)
        self.controller.enter_lattice(cells)

    def step(self, tick: int) -> None:
        """Advance from `tick` to the next one."""
        self.controller.step(tick)
