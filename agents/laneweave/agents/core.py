"""The vehicle agent's core: the claim on one vehicle, plan execution, and driving.

At each tick the agent receives a SENSE with measurements and the state of the motion controller,
checks that it is in charge of the vehicle, decides whether a move may begin (`plan_execution`), and
answers with a COMMAND that contains a trajectory (`driver`). Between ticks it answers PREPARE and
PLAN and handles the states of other vehicles.

**The claim.** One process at a time acts for a vehicle; the motion controller decides which. An
agent claims the vehicle with its first COMMAND, and sends nothing to other processes until a SENSE
reports that it is in charge. While another one is in charge, it sends nothing at all. If the
caretaker is in charge (because the agent hung or its messages were lost), the agent takes a new
incarnation and claims the vehicle again.

**The road.** A SENSE names its bridge. A newer bridge has another road and begins at tick 0: the
agent discards its state, takes a new incarnation, and ignores late messages from the old bridge. It
does the same if only lower ticks, or only an older bridge, are shown for a while: then what seemed
to be newer was wrong.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from laneweave.agents.driving.driver import Driver, SolverStats, TrackingDriver
from laneweave.agents.undisturbed import HoldWatch
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, PlannedMove, stretch_of
from laneweave.protocol.road_layout import NO_PARTS, TemporaryParts
from laneweave.protocol.runtime.node import Arrived, Effect, Event, Refuse, Send, Stopping
from laneweave.protocol.scenario.deployment_fields import MAX_HOLD_S
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES
from laneweave.protocol.vehicle.lane_ends import SOON_S, LaneEnds
from laneweave.protocol.vehicle.motion import displaced
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.vehicle.territory import territory_of
from laneweave.protocol.wire.bounds import check_ballot
from laneweave.protocol.wire.identities import above
from laneweave.protocol.wire.messages import (
    CAR,
    Command,
    CurrentMotion,
    Motion,
    Name,
    Plan,
    Prepare,
    Sense,
    VehicleRecord,
    VehicleState,
)
from laneweave.protocol.wire.newest import FORGET_S, NewestRoad
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import COMMAND, MOTION, REPORT, STATE

MAX_REPEATS = 50
"""Maximum number of ticks in which a process repeats a move that the motion controller does not
begin. The messages may be lost, or the move taken back."""


class _Claim:
    """The incarnation with which this process claims its vehicle."""

    def __init__(self, new_incarnation: Callable[[], int]) -> None:
        self._new = new_incarnation
        self.renew()

    def renew(self) -> None:
        """Take a new incarnation."""
        self.incarnation = self._new()
        self.raised = False
        """Whether it is above the clock because that of a process in charge was."""

    def raise_above(self, other: int) -> None:
        """Take a new incarnation, above that of the process in charge."""
        number = self._new()
        self.incarnation = above(number, other)
        self.raised = self.incarnation != number


class AgentCore:
    """State machine of one vehicle's agent; see `Core`."""

    def __init__(
        self,
        vehicle: Name,
        new_incarnation: Callable[[], int],
        scenario: Scenario,
        make_driver: Callable[[Scenario, Vehicle], Driver] = TrackingDriver,
        rules: RuleBook = VEHICLE_RULES,
    ) -> None:
        """Make an agent that has not yet received a SENSE (V1).

        Args:
            vehicle: name of the vehicle.
            new_incarnation: returns a number greater than all previous incarnations.
            scenario: lattice, types of vehicles, timing.
            make_driver: returns the driver of a vehicle with some limits; the fault search passes
                a cheaper one.
            rules: rules of plan execution; tests plant bugs here.
        """
        self.vehicle = vehicle
        self.ended = False
        self.execution: PlanExecution | None = None
        """None before the first SENSE."""
        self._scenario = scenario
        self._claim = _Claim(new_incarnation)
        runtime = scenario.runtime
        self._bounds = runtime.bounds(self._claim.incarnation)
        self._durations = scenario.timing.move_durations
        self._road = NewestRoad(runtime.max_pace)
        self._make_driver = make_driver
        self._vehicle_type: str = CAR
        self._driver = make_driver(scenario, scenario.vehicle)
        self._drivable: frozenset[Cell] | None = None
        self._lane_ends, self._territory = LaneEnds(scenario), territory_of(scenario)
        self._temporary = NO_PARTS
        self._rules = rules
        self._hold_watch = HoldWatch(scenario, vehicle)
        self.wanted_motions: tuple[int, ...] = ()
        """Stretches of columns whose motions are needed now; empty while not in charge."""
        self.wanted_states: tuple[int, ...] = ()
        """Blocks whose states are needed now."""
        self._begun: tuple[PlannedMove, int] | None = None
        """The move that was begun last, and its duration in ticks."""
        self._begun_with = 0, self._lane_ends
        """The tick in which it was begun first, or this process took over, and the ends of lanes as
        known then."""
        self._sense: Sense | None = None
        self._command: Command | None = None
        self._waking = False
        """Whether a COMMAND has ended the rest of the vehicle, and no SENSE has followed yet."""
        self._own = {"vehicle": vehicle}

    @property
    def wakeup_s(self) -> float | None:
        """None: the agent acts on ticks and messages only."""
        return None

    @property
    def in_charge(self) -> bool:
        """Whether the last SENSE reports that this process is in charge of the vehicle."""
        sense = self._sense
        return (
            sense is not None
            and sense.record.incarnation == self._claim.incarnation
            and not sense.caretaker
            and not self.ended
        )

    @property
    def solver_stats(self) -> SolverStats:
        """Solve counters and solve times."""
        return self._driver.solver_stats

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Handle an event; see `Core`."""
        if isinstance(event, Arrived):
            message = event.message
            if isinstance(message, Sense):
                try:
                    effects = self._on_sense(message, now_s)
                except BadInputError as error:
                    return [Refuse(error)]
            elif self.in_charge:
                effects = self._on_message(message)
            else:
                return []
            self._want_states()
            return effects
        return [self._final_report()] if isinstance(event, Stopping) else []

    def _want_states(self) -> None:
        execution, sense = self.execution, self._sense
        self.wanted_states = ()
        if execution is None or execution.plan is None or sense is None or not self.in_charge:
            return
        if execution.needs_states(sense.t_s):
            self.wanted_states = execution.plan.blocks

    def on_obstacles(self, temporary: TemporaryParts) -> None:
        """Handle the parts of lanes that are not open as always."""
        if temporary == self._temporary:
            return
        self._temporary = temporary
        self._lane_ends = LaneEnds(self._scenario, temporary)
        self._driver.close(self._lane_ends)
        if self.execution is not None:
            self.execution.lane_ends = self._lane_ends

    def on_motion(self, motion: Motion) -> None:
        """Handle the motion of a vehicle in one of the wanted stretches."""
        self._driver.on_motion(motion)

    def _on_message(self, message: object) -> list[Effect]:
        execution = self.execution
        assert execution is not None  # noqa: S101 (in charge: there was a SENSE)
        if self._sense is not None and self._sense.off_lattice:
            return []
        match message:
            case VehicleState():
                execution.on_state(message)
            case Prepare():
                try:
                    check_ballot(message.ballot, self._road.t_s)
                except BadInputError as error:
                    return [Refuse(error)]
                if execution.on_prepare(message):
                    return [*self._request_storage(execution), self._state()]
            case Plan():
                if self._scenario.timing.move_ticks(message.slot_s) not in self._durations:
                    slots_s = ", ".join(f"{slot_s:g}" for slot_s in self._scenario.timing.slots_s)
                    return [Refuse(BadInputError("slot_s", message.slot_s, f"one of {slots_s}"))]
                if execution.on_plan(message) or self._waking:
                    return self._request_storage(execution)
            case _:
                pass
        return []

    # --- the tick -----------------------------------------------------------------------------

    def _on_sense(self, sense: Sense, now_s: float) -> list[Effect]:
        if sense.vehicle != self.vehicle:
            return []
        road = self._road
        self._bounds.check(sense, road.latest_s(now_s), now_s)
        number = road.number
        t_s = sense.tick * self._scenario.runtime.tick_s
        if not sense.bridge and road.bridge > 0:
            return []
        if not road.on_message(sense.bridge, t_s, now_s, self._forget_s):
            return []
        if road.number != number and self._sense is not None:
            self._forget_road()
        if sense.left:
            return self.leave()
        if self._sense is not None and sense.tick <= self._sense.tick:
            if sense.tick == self._sense.tick and self._command is not None:
                return [*self._on_confirmation(sense), Send(COMMAND, self._command, self._own)]
            return []
        if self._sense is None:
            self._set_type(sense.vehicle_type)
        drove = self.in_charge and self._sense is not None and not self._sense.off_lattice
        self._sense, self._waking = sense, False
        # Clocks of different machines may give a caretaker the same incarnation.
        incarnation = sense.record.incarnation
        taken = sense.caretaker and incarnation == self._claim.incarnation
        if taken or incarnation > self._claim.incarnation:
            self._command, self.wanted_motions = None, ()
            if not sense.caretaker:
                return []  # another agent is in charge
            self._claim.raise_above(incarnation)
        elif incarnation < self._claim.incarnation and self._claim.raised:
            # The incarnation in an earlier SENSE may have been wrong, and the claim too high.
            self._claim.raise_above(incarnation)
        return self._act(sense, drove=drove)

    def _set_type(self, vehicle_type: str) -> None:
        """Drive a vehicle of a type; it is known from the first SENSE of a road on."""
        if vehicle_type == self._vehicle_type:
            return
        types = self._scenario.types
        if vehicle_type not in types:
            allowed = f"one of the scenario's types: {', '.join(types)}"
            raise BadInputError("vehicle_type", vehicle_type, allowed)
        self._vehicle_type = vehicle_type
        self._drivable = types.moves_of(vehicle_type)
        self._driver = self._make_driver(self._scenario, types[vehicle_type].limits)
        self._driver.close(self._lane_ends)

    def _has_lost_track(self, sense: Sense) -> bool:
        """Return whether the vehicle holds a cell to which this process has not moved it.

        It has left the lattice and entered it again while no SENSE arrived, or it is too late for
        the move that this process has begun or may begin.
        """
        execution, (begin_tick, known) = self.execution, self._begun_with
        if execution is None:
            return False
        if sense.hold_cell == execution.hold_cell:
            # An open gate for a move that can no longer begin would keep leaders waiting.
            return bool(self._lane_ends) and execution.stuck
        if sense.tick > begin_tick + MAX_REPEATS:
            return True
        if not self._lane_ends:
            return False
        if self._begun is None:
            return True
        (_, origin, target), _ = self._begun
        # The motion controller refuses a whole move into a part that is closed or cleared.
        slot_s = execution.plan.slot_s if self._temporary and execution.plan is not None else None
        ends = self._lane_ends
        return (
            sense.hold_cell != origin
            or ends.too_late(origin, target, sense.t_s, slot_s)
            # The motion controller has taken the move back. Its clock may be another one.
            or (ends is not known and ends.closed_soon(target, sense.t_s, 2.0 * SOON_S))
        )

    def _wait(self, sense: Sense) -> list[Effect]:
        """Keep the claim on a vehicle without a cell, which its motion controller drives alone."""
        self._command = Command(
            vehicle=self.vehicle,
            record=VehicleRecord(incarnation=self._claim.incarnation),
            tick=sense.tick,
            hold_cell=sense.hold_cell,
            motion=CurrentMotion(sense.motion.origin, sense.motion.end_tick),
            jerks=b"",
        )
        return [Send(COMMAND, self._command, self._own)]

    def _act(self, sense: Sense, *, drove: bool) -> list[Effect]:
        """Answer a tick; `drove`: whether this process has driven the vehicle until now."""
        if drove and (sense.off_lattice or self._has_lost_track(sense)):
            # What it has promised and accepted is void: it begins anew, like another process.
            self._claim.raise_above(self._claim.incarnation)
        in_charge = self.in_charge
        if not (drove and in_charge) or sense.off_lattice:
            # Repeated while a claim is pending, since another process may still begin a move.
            self._take_over(sense)
        execution = self.execution
        assert execution is not None  # noqa: S101 (it has taken over)
        self.wanted_motions = ()
        if sense.off_lattice:
            execution.on_record(sense.record)  # the promise stays
            return self._wait(sense)
        if in_charge:
            stretch = stretch_of(execution.hold_cell[0])
            self.wanted_motions = stretch - 1, stretch, stretch + 1
            self._decide(sense, execution)
        drive = self._driver.drive(sense, moving=execution.moving)
        hold = self._hold_watch.look(sense, execution, free=drive.free) if in_charge else None
        self._command = Command(
            vehicle=self.vehicle,
            record=execution.wanted,
            tick=sense.tick,
            hold_cell=execution.hold_cell,
            motion=drive.motion if hold is None else hold,
            jerks=drive.jerks,
        )
        effects: list[Effect] = [Send(COMMAND, self._command, self._own)]
        if in_charge:
            effects.append(self._state())
            course = self._driver.motion(sense.tick)
            if course is not None:
                stretch = stretch_of(course[0][0])
                motion = Motion(self.vehicle, self._claim.incarnation, stretch, *course, sense.tick)
                effects.append(Send(MOTION, motion, {"stretch": stretch, **self._own}))
        return effects

    def _on_confirmation(self, sense: Sense) -> list[Effect]:
        """Handle a repeated SENSE: the controller may have stored something within the tick."""
        execution = self.execution
        stale = sense.record.incarnation != self._claim.incarnation
        if execution is None or not self.in_charge or stale:
            return []
        self._sense = sense
        return [self._state()] if execution.on_record(sense.record) else []

    def _request_storage(self, execution: PlanExecution) -> list[Effect]:
        """Ask the controller to store changes now rather than with the next tick's COMMAND.

        The vehicle no longer holds undisturbed: it gets a SENSE in the next tick.
        """
        command = self._command
        assert command is not None  # noqa: S101 (in charge: it has sent one)
        motion = command.motion
        if command.undisturbed_ticks:
            motion, self._waking = CurrentMotion(command.hold_cell), True
        self._command = replace(command, record=execution.wanted, motion=motion)
        if self._command == command and not self._waking:
            return []
        return [Send(COMMAND, self._command, self._own)]

    @property
    def _forget_s(self) -> float:
        """Time without a message of the newest road after which an older one replaces it.

        It is longer while the vehicle holds undisturbed, since the bridge then sends less often.
        """
        resting = self._command is not None and self._command.undisturbed_ticks > 0
        return FORGET_S + 2.0 * MAX_HOLD_S if resting else FORGET_S

    def _forget_road(self) -> None:
        """Discard the state of an earlier bridge's vehicle, as after a restart (V1)."""
        self._claim.renew()
        self._sense = self._command = self._begun = self.execution = None
        self.wanted_motions, self.wanted_states = (), ()

    def _take_over(self, sense: Sense) -> None:
        """V1: continue the motion controller's current motion."""
        self._begun, self._begun_with = None, (sense.tick, self._lane_ends)
        self._driver.take_over(sense)
        self.execution = PlanExecution(
            vehicle=self.vehicle,
            incarnation=self._claim.incarnation,
            hold_cell=sense.hold_cell,
            territory=self._territory,
            stored=sense.record,
            rules=self._rules,
            moving=not self._driver.at_rest(sense),
            lane_ends=self._lane_ends,
            drivable=self._drivable,
        )

    def _decide(self, sense: Sense, execution: PlanExecution) -> None:
        """Advance plan execution by a tick, and begin the move that starts now."""
        if execution.moving and self._begun is not None and sense.hold_cell != self._begun[0][2]:
            # The COMMAND with the move was lost, so the body is still at its origin: a trajectory
            # that began earlier would be ahead of it. The plan may have been dropped since.
            self._begin(*self._begun, sense.tick)
        scenario, cell = self._scenario, execution.hold_cell
        room_ahead_m = scenario.types.room_ahead_m
        move = execution.on_sense(
            sense,
            arrived=execution.moving and self._driver.at_rest(sense),
            displaced=displaced(sense.measured, scenario.lattice, cell, sense.t_s, room_ahead_m),
        )
        if move is not None and execution.plan is not None:
            self._begun_with = sense.tick, self._lane_ends
            self._begin(move, scenario.timing.move_ticks(execution.plan.slot_s), sense.tick)

    def _begin(self, move: PlannedMove, lasts_ticks: int, tick: int) -> None:
        """Begin a move, or begin it anew."""
        self._begun = move, lasts_ticks
        self._driver.begin(move, tick, lasts_ticks)

    # --- messages to other processes -----------------------------------------------------------

    def _state(self) -> Effect:
        execution, sense = self.execution, self._sense
        assert execution is not None  # noqa: S101 (there was a SENSE)
        assert sense is not None  # noqa: S101 (there was a SENSE)
        state = execution.state(sense, attended=True)
        return Send(STATE, state, {"block": state.block, **self._own})

    def leave(self) -> list[Effect]:
        """Shut down: the vehicle has left the road."""
        if self.ended:
            return []
        self.ended, self.wanted_motions, self.wanted_states = True, (), ()
        return [self._final_report()]

    def _final_report(self) -> Effect:
        stats = self.solver_stats
        report = Report(
            role=Name("agent"),
            name=self.vehicle,
            solves=stats.solves,
            unusable=stats.unusable,
            osqp_solves=stats.osqp_solves,
            solve_ms=stats.solve_ms,
        )
        return Send(REPORT, report, {"role": "agent", "name": self.vehicle})
