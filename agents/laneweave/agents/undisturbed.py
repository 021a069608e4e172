"""When a vehicle holds its cell undisturbed, so that fewer messages suffice.

The motion controller follows a trajectory of several seconds and brakes on its own. So a vehicle
that holds, with nothing that acts on it and nothing that others wait for, needs no SENSE in every
tick, and sends no COMMAND and STATE then: every `runtime.hold_period_ticks` is enough. The agent
says so in its COMMAND (`Command.undisturbed_ticks`). If anything changes around the vehicle, the
bridge sends the next SENSE earlier (`sim_bridge.road.sense_rate`).
"""

from __future__ import annotations

import zlib

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plan_execution import LISTEN_S, ExecutionPhase, PlanExecution
from laneweave.protocol.wire.messages import CurrentMotion, Name, Sense

_WAITS_FOR_STATES = (ExecutionPhase.TAKEN, ExecutionPhase.GATED)


class HoldWatch:
    """Watches how long nothing has happened to a vehicle."""

    def __init__(self, scenario: Scenario, vehicle: Name) -> None:
        """Read the period from a scenario; the name of the vehicle decides on its phase."""
        runtime = scenario.runtime
        self._period_ticks = runtime.hold_ticks
        # Vehicles that are disturbed together get SENSE in different ticks afterwards.
        self._first_ticks = 1 + zlib.crc32(vehicle.encode()) % self._period_ticks
        # A vehicle that waits for this one listens `LISTEN_S` before its move is due.
        self._ahead_s = LISTEN_S + (self._period_ticks + 1) * runtime.tick_s
        self._known: object = None
        """What other processes know of the vehicle, apart from its position."""
        self._since_tick = 0
        """Tick of the last change."""
        self._next_tick = 0
        """Tick of the next SENSE if nothing changes around the vehicle; 0: it is at the full
        rate."""

    def look(self, sense: Sense, execution: PlanExecution, *, free: bool) -> CurrentMotion | None:
        """Return the motion of a vehicle that holds undisturbed; None: it needs every SENSE.

        Called at each SENSE. What has changed last is published in each tick of a period, since
        messages may be lost.

        Args:
            sense: that of this tick.
            execution: state of the protocol after this tick.
            free: whether the vehicle is at rest in its cell, and follows its own reference.
        """
        tick, phase = sense.tick, execution.phase
        known = (
            execution.incarnation,
            execution.promised,
            phase,
            execution.completed,
            execution.hold_cell,
            execution.moving,
            sense.record,
        )
        # An earlier SENSE than expected: something has changed around the vehicle.
        if known != self._known or tick < self._next_tick:
            self._known, self._since_tick, self._next_tick = known, tick, 0
        if (
            self._period_ticks == 1
            or not free
            or tick < self._since_tick + self._period_ticks
            or execution.moving
            or phase in _WAITS_FOR_STATES
            or execution.is_awaited(sense.t_s, self._ahead_s)
        ):
            self._next_tick = 0
            return None
        ticks = self._period_ticks if self._next_tick else self._first_ticks
        self._next_tick = tick + ticks
        return CurrentMotion(execution.hold_cell, 0, ticks)
