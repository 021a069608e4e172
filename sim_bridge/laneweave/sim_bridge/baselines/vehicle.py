"""A vehicle of a reference method: where it is, and on which lane it counts."""

from __future__ import annotations

from collections.abc import Mapping

from attrs import define

from laneweave.protocol.vehicle.motion import State
from laneweave.sim_bridge.bodies.motion_controller import Rung
from laneweave.sim_bridge.road.demand import Arrival


@define(eq=False)
class Vehicle:
    """A vehicle on the road; as recorded, one without formation, cell and motion controller."""

    arrival: Arrival
    entered_s: float
    """Road time at which its front passed s = 0."""
    s_m: float
    """Front bumper."""
    speed_mps: float
    y_m: float
    """Centre of its body."""
    lane: int
    """Where it drives; while it changes lanes, where it changes to."""
    accel_mps2: float = 0.0
    lateral_speed_mps: float = 0.0
    previous_lane: int | None = None
    """While it changes lanes: where it comes from."""
    formation: None = None

    @property
    def name(self) -> str:
        """Its name."""
        return self.arrival.vehicle

    @property
    def preferred_lane(self) -> int:
        """Where it wants to leave the road."""
        return self.arrival.preferred_lane

    @property
    def finished(self) -> bool:
        """Whether it has finished all its lane changes."""
        return self.lane == self.preferred_lane and self.previous_lane is None

    @property
    def state(self) -> State:
        """(s m, v m/s, a m/s2, y m, v_y m/s, a_y m/s2)."""
        return (
            self.s_m,
            self.speed_mps,
            self.accel_mps2,
            self.y_m,
            self.lateral_speed_mps,
            0.0,
        )

    @property
    def cell(self) -> tuple[None, int]:
        """No column, and its lane."""
        return None, self.lane

    @property
    def rung_ticks(self) -> Mapping[Rung, int]:
        """None: it has no ladder of fallbacks."""
        return {}
