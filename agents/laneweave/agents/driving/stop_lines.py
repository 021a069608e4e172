"""Stop lines of lanes that end, as limits of the reference.

A reference that stays in a lane up to its stop line would be late to stop if the line counted only
within the time for which sensed vehicles are predicted. The line is known in advance, so it limits
the reference over the whole horizon, while the reference touches the lane. The horizon is about as
long as a slot: when braking begins, it is too late for the next move out of the lane.
"""

from __future__ import annotations

import numpy as np
from attrs import evolve
from numpy.typing import NDArray

from laneweave.agents.driving.tracking_problem import Gaps
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.motion import State

Array = NDArray[np.float64]


class StopLines:
    """The stop lines of a road, for the tracker of one vehicle."""

    def __init__(self, scenario: Scenario, limits: Vehicle) -> None:
        """Read the lines from a scenario."""
        self.ends = LaneEnds(scenario)
        self._lattice = scenario.lattice
        self._touch_m = 0.5 * (scenario.road.lane_width_m + limits.width_m)
        # In commanded positions: a standing body is this far ahead of its commanded state.
        self._before_m = (
            scenario.tracking.min_gap_m + limits.actuator_lag_s * scenario.formation.speed_mps
        )

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self.ends)

    def limit(self, gaps: Gaps, states: Array, measured: State) -> Gaps:
        """Return the gaps, with stop lines as upper bounds where the reference would pass them.

        Args:
            gaps: bounds set by other vehicles.
            states: states of the reference (N + 1, 6).
            measured: measured state of the body.
        """
        lines = [
            (
                end,
                (np.abs(states[:, 3] - self._lattice.cell_y_m(end.lane)) < self._touch_m)
                # The reference may lead into the lane where it is open again.
                & (states[:, 0] < end.reopens_m),
            )
            for end in self._ahead(measured)
        ]
        latest = gaps.latest
        for end, touching in lines:
            line_m = end.stop_m - self._before_m
            if not (touching & (states[:, 0] > line_m)).any():
                continue
            limit = np.where(touching, line_m, np.inf)
            latest = limit if latest is None else np.minimum(latest, limit)
        return gaps if latest is gaps.latest else evolve(gaps, latest=latest)

    def _ahead(self, measured: State) -> list[LaneEnd]:
        """Return the dead end ahead of a body in each lane that has one."""
        lanes, (s_m, speed_mps) = range(self._lattice.lanes), measured[:2]
        ends = (self.ends.heeded(lane, s_m, speed_mps) for lane in lanes)
        return [end for end in ends if end is not None]
