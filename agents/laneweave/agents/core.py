"""The vehicle agent's core: protocol, trajectory and tracking of one vehicle.

At each tick it hears what its sensors and its motion controller know, decides whether a move may
begin (`execution`), lays the reference through the lattice points (`trajectory`), and answers with
the jerks that track it (`tracker`). Between ticks it promises, accepts, and listens to the others.
When in doubt it holds its cell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from laneweave.agents.execution import PlanExecution
from laneweave.agents.tracker import Tracker, remaining_jerk
from laneweave.agents.trajectory import Reference
from laneweave.protocol.messages import (
    Command,
    Name,
    Plan,
    Prepare,
    Report,
    Sense,
    VehicleState,
)
from laneweave.protocol.motion import cell_state, hold_law, integrate
from laneweave.protocol.node import (
    Announce,
    Arrived,
    Effect,
    Event,
    Listen,
    Send,
    Started,
    Stopping,
    Unlisten,
    Withdraw,
)
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.topics import (
    COMMAND,
    PLAN,
    PREPARE,
    REPORT,
    SENSE,
    STATE,
    VEHICLE_ALIVE,
)

OVERDUE_SLOTS = 1.5
"""A move due for this many slots is reported as overdue."""
ARRIVED_ALONG_M = 0.5
ARRIVED_ACROSS_M = 0.3
"""A motion has ended when its time is over and the body is this close to the target point."""
SENSED_S = 1.0
"""How far ahead local sensing is extrapolated; what others plan to do is not known here."""


class AgentCore:
    """State machine of one vehicle's agent; see `Core` for how it is driven."""

    def __init__(
        self,
        vehicle: Name,
        incarnation: int,
        scenario: Scenario,
        make_tracker: Callable[[Scenario], Tracker] = Tracker,
    ) -> None:
        """Make an agent that knows nothing of its vehicle yet (V1)."""
        self.vehicle = vehicle
        self.formation: int | None = None
        self.ended = False
        self._scenario = scenario
        self._incarnation = incarnation
        self._tracker = make_tracker(scenario)
        self._execution: PlanExecution | None = None
        self._reference: Reference | None = None
        self._sense: Sense | None = None
        self._command: Command | None = None
        self._jerks: NDArray[np.float64] = np.zeros((0, 2))
        self._jerks_tick = 0
        self._solve_ms: list[float] = []
        self._unusable = 0
        self._own = {"vehicle": vehicle}

    @property
    def wakeup_s(self) -> float | None:
        """Ticks drive the agent; it has no clock of its own."""
        return None

    @property
    def needs_states(self) -> bool:
        """Whether the states of this vehicle's formation matter to it now."""
        return (
            not self.ended
            and self._execution is not None
            and self._sense is not None
            and self._execution.needs_states(self._sense.t_s)
        )

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Take an event; see `Core`."""
        del now_s
        match event:
            case Started():
                for topic in (SENSE, PREPARE, PLAN):
                    yield Listen(topic, self._own)
                # Last: who sees the token may rely on the subscriptions.
                yield Announce(VEHICLE_ALIVE, self._own)
            case Arrived(_, _, Sense() as sense):
                yield from self._on_sense(sense)
            case Arrived(_, _, VehicleState() as state):
                if self._execution is not None:
                    self._execution.on_state(state)
            case Arrived(_, _, Prepare() as prepare):
                if self._execution is not None and self._execution.on_prepare(prepare):
                    yield self._show()
            case Arrived(_, _, Plan() as plan):
                execution = self._execution
                if execution is not None and self._in_block(plan) and execution.on_plan(plan):
                    yield self._show()
            case Stopping():
                yield self._report()
            case _:
                pass

    def _in_block(self, plan: Plan) -> bool:
        """Tell whether a plan keeps to the block that this vehicle's formation owns.

        Plans of different formations run at the same time because their blocks are disjoint.
        """
        if self.formation is None:
            return False
        return set(plan.territory) <= self._scenario.lattice.block_cells(self.formation)

    # --- the tick -----------------------------------------------------------------------------

    def _on_sense(self, sense: Sense) -> Iterator[Effect]:
        if sense.vehicle != self.vehicle:
            return
        if sense.left:
            yield from self.leave()
            return
        if self._sense is not None and sense.tick <= self._sense.tick:
            if sense.tick == self._sense.tick and self._command is not None:
                yield Send(COMMAND, self._command, self._own)
            return
        self._sense = sense
        if self._execution is None:
            self._meet_vehicle(sense)
        self._decide(sense)
        self._command = self._drive(sense)
        yield Send(COMMAND, self._command, self._own)
        yield self._show()

    def _meet_vehicle(self, sense: Sense) -> None:
        """V1: take over what the motion controller is doing."""
        self.formation = self._scenario.lattice.block_of(sense.hold_cell[0])
        self._execution = PlanExecution(
            self.vehicle,
            self._incarnation,
            sense.hold_cell,
            OVERDUE_SLOTS * self._scenario.formation.cycle_s,
        )
        if sense.motion_end_tick > sense.tick:
            ticks = round(self._scenario.formation.move_s / self._scenario.runtime.tick_s)
            self._reference = Reference.move(
                self._scenario, sense.motion_origin, sense.hold_cell, sense.motion_end_tick - ticks
            )
        else:
            self._reference = Reference.hold(self._scenario, sense.hold_cell)
        # A body that is late still moves, though the time of its motion is over.
        self._execution.moving = not self._arrived(sense)

    def _decide(self, sense: Sense) -> None:
        """V5 to V7."""
        execution = self._execution
        assert execution is not None  # noqa: S101 (met the vehicle)
        if execution.moving and self._arrived(sense):
            execution.end_motion()
        move = execution.next_move(sense.t_s)
        if move is not None:
            execution.begin(move)
            self._reference = Reference.move(self._scenario, move[1], move[2], sense.tick)

    def _arrived(self, sense: Sense) -> bool:
        execution, reference = self._execution, self._reference
        assert execution is not None  # noqa: S101 (met the vehicle)
        if reference is None or sense.tick < reference.end_tick:
            return False
        goal = cell_state(self._scenario.lattice, execution.hold_cell, sense.t_s)
        return (
            abs(sense.state[0] - goal[0]) <= ARRIVED_ALONG_M
            and abs(sense.state[3] - goal[3]) <= ARRIVED_ACROSS_M
        )

    def _drive(self, sense: Sense) -> Command:
        execution = self._execution
        assert execution is not None  # noqa: S101 (met the vehicle)
        reference = self._reference
        assert reference is not None  # noqa: S101 (met the vehicle)
        result = self._tracker.solve(
            sense.state, reference.window(sense.tick), self._predict_ahead(sense)
        )
        self._solve_ms.append(result.solve_ms)
        if result.usable:
            self._jerks, self._jerks_tick = result.jerk, sense.tick
        else:
            self._unusable += 1
            self._fall_back(sense)
        return Command(
            vehicle=self.vehicle,
            tick=sense.tick,
            hold_cell=execution.hold_cell,
            # Past its time but not there yet: still moving, for whoever takes the vehicle over.
            motion_end_tick=max(reference.end_tick, sense.tick + 1) if execution.moving else 0,
            motion_origin=reference.origin,
            jerks=self._jerks.astype("<f4").tobytes(),
        )

    def _fall_back(self, sense: Sense) -> None:
        """Continue the last good trajectory; when it has run out, go to rest in the hold cell."""
        rest = remaining_jerk(self._jerks, sense.tick - self._jerks_tick)
        execution = self._execution
        assert execution is not None  # noqa: S101 (met the vehicle)
        if len(rest) == 0:
            rest = self._hold(sense, execution)
        self._jerks, self._jerks_tick = rest, sense.tick

    def _hold(self, sense: Sense, execution: PlanExecution) -> NDArray[np.float64]:
        scenario = self._scenario
        tick_s = scenario.runtime.tick_s
        state, jerks = sense.state, []
        for index in range(scenario.tracking.horizon_ticks):
            goal = cell_state(scenario.lattice, execution.hold_cell, sense.t_s + index * tick_s)
            jerk = hold_law(state, goal, scenario.vehicle, tick_s)
            state = integrate(state, jerk, tick_s)
            jerks.append(jerk)
        return np.array(jerks)

    def _predict_ahead(self, sense: Sense) -> NDArray[np.float64] | None:
        """Return where the nearest vehicle ahead will end, at constant speed, as far as that holds.

        It counts in the lanes that the body touches and in the lane that it enters.
        """
        if not sense.ahead:
            return None
        scenario = self._scenario
        lane_width_m, half_m = scenario.road.lane_width_m, scenario.vehicle.width_m / 2
        y_m = sense.state[3]
        execution = self._execution
        assert execution is not None  # noqa: S101 (met the vehicle)
        lanes = {
            int((y_m - half_m) // lane_width_m),
            int((y_m + half_m) // lane_width_m),
            execution.hold_cell[1],
        }
        near = [other for other in sense.ahead if other.lane in lanes]
        if not near:
            return None
        ticks = scenario.tracking.horizon_ticks + 1
        times_s = np.arange(ticks) * scenario.runtime.tick_s
        rears = [sense.state[0] + other.gap_m + other.speed_mps * times_s for other in near]
        rear: NDArray[np.float64] = np.min(rears, axis=0)
        rear[times_s > SENSED_S + 1e-9] = np.inf
        return rear

    # --- what others see ----------------------------------------------------------------------

    def _show(self) -> Effect:
        execution, sense = self._execution, self._sense
        assert execution is not None  # noqa: S101 (met the vehicle)
        assert sense is not None  # noqa: S101 (met the vehicle)
        state = VehicleState(
            vehicle=self.vehicle,
            incarnation=self._incarnation,
            formation=self.formation or 0,
            promised=execution.promised,
            accepted=execution.plan is not None,
            ready=execution.ready,
            completed=execution.completed,
            hold_cell=execution.hold_cell,
            moving=execution.moving,
            go=execution.go,
            done=execution.done,
            overdue=execution.overdue(sense.t_s),
            s_m=sense.state[0],
            y_m=sense.state[3],
            speed_mps=sense.state[1],
            t_s=sense.t_s,
        )
        return Send(STATE, state, {"formation": self.formation, "vehicle": self.vehicle})

    def leave(self) -> Iterator[Effect]:
        """End: the vehicle is not on the road any more."""
        if not self.ended:
            self.ended = True
            yield self._report()
            for topic in (SENSE, PREPARE, PLAN):
                yield Unlisten(topic, self._own)
            yield Withdraw(VEHICLE_ALIVE, self._own)

    def _report(self) -> Effect:
        report = Report(
            role=Name("agent"),
            name=self.vehicle,
            solves=len(self._solve_ms),
            unusable=self._unusable,
            solve_ms=np.array(self._solve_ms, dtype="<f4").tobytes(),
        )
        return Send(REPORT, report, {"role": "agent", "name": self.vehicle})
