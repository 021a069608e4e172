"""The driver: from the cell to hold, or the move to make, to jerks for the motion controller.

It lays the reference through the lattice points (`trajectory`), tracks it (`tracker`), and has
something sensible to drive when a solution is not usable. It knows nothing of the protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from attrs import frozen
from numpy.typing import NDArray

from laneweave.agents.tracker import Tracker, remaining_jerk
from laneweave.agents.trajectory import Reference
from laneweave.protocol.lattice import Cell, Move
from laneweave.protocol.messages import Sense
from laneweave.protocol.motion import at_rest_in_cell, cell_state, hold_law, integrate
from laneweave.protocol.scenario import Scenario

SENSED_S = 1.0
"""How far ahead local sensing is extrapolated; what others plan to do is not known here."""


@frozen
class Drive:
    """What the motion controller should play from this tick on."""

    motion_end_tick: int
    """End of the motion under way; 0 when the vehicle holds."""
    motion_origin: Cell
    jerks: bytes
    """Little-endian float32 pairs (along, across) in m/s3, one for each tick of the horizon."""


@frozen
class Effort:
    """What driving has cost so far."""

    solves: int = 0
    unusable: int = 0
    solve_ms: bytes = b""
    """Little-endian float32 CPU milliseconds, one for each solve."""


class Driver(Protocol):
    """Drives one vehicle; `TrackingDriver` in every real agent."""

    def take_over(self, sense: Sense) -> None:
        """Go on with what the motion controller is doing."""

    def begin(self, move: Move, tick: int) -> None:
        """Begin a move at this tick."""

    def at_rest(self, sense: Sense) -> bool:
        """Tell whether the motion under way has ended."""

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Return what to play from this tick on."""

    @property
    def effort(self) -> Effort:
        """What it has cost so far."""


class TrackingDriver:
    """Tracks references with a quadratic program at each tick."""

    def __init__(
        self, scenario: Scenario, make_tracker: Callable[[Scenario], Tracker] = Tracker
    ) -> None:
        """Make a driver that knows nothing of its vehicle yet."""
        self._scenario = scenario
        self._tracker = make_tracker(scenario)
        self._reference: Reference | None = None
        self._goal: Cell = (0, 0)
        self._jerks: NDArray[np.float64] = np.zeros((0, 2))
        self._jerks_tick = 0
        self._solve_ms: list[float] = []
        self._unusable = 0

    @property
    def effort(self) -> Effort:
        """What it has cost so far."""
        solve_ms = np.array(self._solve_ms, dtype="<f4").tobytes()
        return Effort(len(self._solve_ms), self._unusable, solve_ms)

    def take_over(self, sense: Sense) -> None:
        """Go on with what the motion controller is doing."""
        scenario = self._scenario
        self._goal = sense.hold_cell
        if sense.motion_end_tick > sense.tick:
            ticks = round(scenario.formation.move_s / scenario.runtime.tick_s)
            self._reference = Reference.move(
                scenario, sense.motion_origin, sense.hold_cell, sense.motion_end_tick - ticks
            )
        else:
            self._reference = Reference.hold(scenario, sense.hold_cell)

    def begin(self, move: Move, tick: int) -> None:
        """Begin a move at this tick."""
        self._goal = move[2]
        self._reference = Reference.move(self._scenario, move[1], move[2], tick)

    def at_rest(self, sense: Sense) -> bool:
        """Tell whether the motion's time is over and the body is at its target.

        A body that is late still moves, though the time of its motion is over.
        """
        return sense.tick >= self._path.end_tick and at_rest_in_cell(
            sense.state, self._scenario.lattice, self._goal, sense.t_s
        )

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Track the reference; on an unusable solution continue what there is."""
        reference = self._path
        result = self._tracker.solve(
            sense.state, reference.window(sense.tick), self._predict_ahead(sense)
        )
        self._solve_ms.append(result.solve_ms)
        if result.usable:
            self._jerks, self._jerks_tick = result.jerk, sense.tick
        else:
            self._unusable += 1
            self._fall_back(sense)
        return Drive(
            # Past its time but not there yet: still moving, for whoever takes the vehicle over.
            motion_end_tick=max(reference.end_tick, sense.tick + 1) if moving else 0,
            motion_origin=reference.origin,
            jerks=self._jerks.astype("<f4").tobytes(),
        )

    @property
    def _path(self) -> Reference:
        assert self._reference is not None  # noqa: S101 (it has taken over)
        return self._reference

    def _fall_back(self, sense: Sense) -> None:
        """Continue the last good trajectory; when it has run out, go to rest in the hold cell."""
        rest = remaining_jerk(self._jerks, sense.tick - self._jerks_tick)
        if len(rest) == 0:
            rest = self._hold(sense)
        self._jerks, self._jerks_tick = rest, sense.tick

    def _hold(self, sense: Sense) -> NDArray[np.float64]:
        scenario = self._scenario
        tick_s = scenario.runtime.tick_s
        state, jerks = sense.state, []
        for index in range(scenario.tracking.horizon_ticks):
            goal = cell_state(scenario.lattice, self._goal, sense.t_s + index * tick_s)
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
        lanes = {
            int((y_m - half_m) // lane_width_m),
            int((y_m + half_m) // lane_width_m),
            self._goal[1],
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
