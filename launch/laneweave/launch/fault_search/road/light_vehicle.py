"""Light vehicles: bodies that move in straight lines, wrong clocks, changing preferred lanes.

Motion controllers are the real ones; safety does not depend on how bodies move.
"""

from __future__ import annotations

import math

from attrs import Factory, define, evolve, field, frozen
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import CAR, Name, Sense
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle

SYNC_S = 1.0
"""Interval at which a vehicle's clock is synchronized; it drifts in between."""


@frozen
class Visit:
    """A vehicle's entry cell, entry and exit times, and clock errors."""

    vehicle: Name
    cell: Cell
    """Cell in which the vehicle enters; at the real roadside, only its lane counts."""
    enters_s: float
    """Time of entry, or of arrival at the real roadside."""
    leaves_s: float | None
    """Exit time; None: the vehicle stays until the end of the road."""
    clock_offset_s: float = 0.0
    clock_drift: float = 0.0
    """Error of the clock rate: seconds gained per second."""
    vehicle_type: str = CAR
    entry_point: int = field(default=Factory(lambda self: self.cell[1], takes_self=True))
    """Number of its entry point at the real roadside; by default, the first of its lane."""

    @property
    def until_s(self) -> float:
        """Exit time; infinite if the vehicle stays."""
        return math.inf if self.leaves_s is None else self.leaves_s


class LightBody(Plant):
    """Body that moves straight from cell to cell in given times."""

    def __init__(
        self, scenario: Scenario, limits: Vehicle, cell: Cell, t_s: float, leaves_s: float
    ) -> None:
        """Start at rest in a cell; from `leaves_s` on, the body is beyond the end of the road."""
        super().__init__((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), limits, scenario.runtime.tick_s)
        self.t_s = t_s
        """Time of the newest tick."""
        self._leaves_s = leaves_s
        self._lattice, self._slot_s = scenario.lattice, scenario.timing.cycles_s[0]
        self._origin: tuple[float, float] = cell
        self._goal: Cell = cell
        self._begin_s = self._end_s = 0.0
        self._stop_m = math.inf
        """Position at which the body waits; infinite while it is on the lattice."""

    @property
    def state(self) -> State:
        """(s m, v m/s, a m/s2, y m, v_y m/s, a_y m/s2) at the newest tick."""
        column, lane = self._place(self.t_s)
        lattice = self._lattice
        s_m = lattice.speed_mps * self.t_s + column * lattice.pitch_m
        y_m = (lane + 0.5) * lattice.lane_width_m
        if self.t_s >= self._leaves_s:
            return (math.inf, lattice.speed_mps, 0.0, y_m, 0.0, 0.0)
        if s_m >= self._stop_m:
            return (self._stop_m, 0.0, 0.0, y_m, 0.0, 0.0)
        return (s_m, lattice.speed_mps, 0.0, y_m, 0.0, 0.0)

    def go(self, cell: Cell, now_s: float, lasts_s: float) -> None:
        """Begin a motion to a cell from the current position."""
        self._origin, self._goal = self._place(now_s), cell
        self._begin_s, self._end_s = now_s, now_s + lasts_s

    def stop_at(self, s_m: float) -> None:
        """Drive on to a position, and wait there."""
        self._stop_m = s_m

    def re_enter(self, cell: Cell, now_s: float, lasts_s: float) -> None:
        """Begin a motion from the place where the body waits to a cell."""
        column = (self._stop_m - self._lattice.speed_mps * now_s) / self._lattice.pitch_m
        self._origin, self._goal = (column, self._goal[1]), cell
        self._begin_s, self._end_s = now_s, now_s + lasts_s
        self._stop_m = math.inf

    def has_arrived(self, now_s: float) -> bool:
        """Return whether the body is in the centre of its target cell."""
        return now_s >= self._end_s

    @property
    def falls_back(self) -> bool:
        """Whether its newest motion leads to a column behind, and has ended a slot ago at most."""
        recent = self.t_s <= self._end_s + self._slot_s
        return recent and self._goal[0] < self._origin[0]

    def _place(self, t_s: float) -> tuple[float, float]:
        if t_s >= self._end_s:
            return self._goal
        share = (t_s - self._begin_s) / (self._end_s - self._begin_s)
        (column, lane), (to_column, to_lane) = self._origin, self._goal
        return (column + share * (to_column - column), lane + share * (to_lane - lane))


@define
class LightVehicle(RoadVehicle):
    """Vehicle with a light body, its own clock and a variable preferred lane."""

    body: LightBody = field(init=False)
    visit: Visit = field(init=False)
    clock_jump_s: float = 0.0
    """Error of the vehicle's clock by jumps, in addition to that of the visit."""
    latest_s: float = 0.0
    """Latest road time that the vehicle's clock has shown."""

    @classmethod
    def visiting(
        cls, visit: Visit, admission: Admission, t_s: float, scenario: Scenario, bridge: int
    ) -> LightVehicle:
        """Return an admitted vehicle, which is at rest in its cell."""
        limits = scenario.types[visit.vehicle_type].limits
        body = LightBody(scenario, limits, admission.cell, t_s, visit.until_s)
        at_rest = evolve(admission, offset_m=0.0)
        vehicle = cls.entering(at_rest, t_s, scenario, bridge, lambda *_: body)
        vehicle.body, vehicle.visit = body, visit
        return vehicle

    @property
    def preferred_lane(self) -> int:
        """Preferred lane."""
        return self.arrival.preferred_lane

    def prefer(self, lane: int) -> None:
        """Change the preferred lane."""
        self.admission = evolve(self.admission, arrival=evolve(self.arrival, preferred_lane=lane))

    def step(self, tick: int) -> None:
        """Advance the body from `tick` to the next one."""
        self.body.t_s = (tick + 1) * self.controller.tick_s

    def sense(self, tick: int, *, caretaker: bool, left: bool = False) -> Sense:
        """Return the SENSE message as seen by the vehicle's own clock.

        The vehicle knows its position in the lattice from its neighbours: a wrong clock makes it
        act early or late, but does not shift its cell.
        """
        sense = super().sense(tick, caretaker=caretaker, left=left)
        visit = self.visit
        drifted_s = visit.clock_offset_s + visit.clock_drift * (sense.t_s % SYNC_S)
        ahead_s = max(drifted_s + self.clock_jump_s, -sense.t_s)
        self.latest_s = max(self.latest_s, sense.t_s + ahead_s)
        if ahead_s == 0.0:
            return sense
        s, v, a, y, v_y, a_y = sense.measured
        measured = (s + self.controller.lattice.speed_mps * ahead_s, v, a, y, v_y, a_y)
        return replace(sense, t_s=sense.t_s + ahead_s, measured=measured)
