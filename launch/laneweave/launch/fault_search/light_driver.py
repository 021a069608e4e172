"""The light driver: the seam of `AgentCore` at which a simulated run leaves trajectories out."""

from __future__ import annotations

from laneweave.agents.driving.driver import Drive, SolverStats
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import at_rest_in_cell
from laneweave.protocol.wire.messages import Motion, Sense


class LightDriver:
    """Names the cell to hold and the tick at which a move should be over; sends no jerks.

    When a motion has ended it decides as `TrackingDriver` does: its time is over and the body is
    there.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Make a driver that knows nothing of its vehicle yet."""
        self._lattice = scenario.lattice
        self._origin: Cell = (0, 0)
        self._goal: Cell = (0, 0)
        self._end_tick = self._ticks = 0

    @property
    def solver_stats(self) -> SolverStats:
        """Nothing is solved here."""
        return SolverStats()

    def take_over(self, sense: Sense) -> None:
        """Go on with what the motion controller is doing."""
        self._origin, self._goal = sense.motion_origin, sense.hold_cell
        self._end_tick, self._ticks = sense.motion_end_tick, sense.motion_ticks

    def begin(self, move: PlannedMove, tick: int, ticks: int) -> None:
        """Begin a move at this tick; it takes `ticks` of them."""
        _, self._origin, self._goal = move
        self._end_tick, self._ticks = tick + ticks, ticks

    def at_rest(self, sense: Sense) -> bool:
        """Tell whether the motion's time is over and the body is at its target."""
        return sense.tick >= self._end_tick and at_rest_in_cell(
            sense.state, self._lattice, self._goal, sense.t_s
        )

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Return when the motion under way ends, without jerks."""
        end_tick = max(self._end_tick, sense.tick + 1) if moving else 0
        return Drive(end_tick, self._origin, self._ticks, b"")

    def motion(self, tick: int) -> None:
        """Tell others nothing: nobody here has trajectories, and events are what a search costs."""

    def on_motion(self, motion: Motion) -> None:
        """Ignore others' motions."""
