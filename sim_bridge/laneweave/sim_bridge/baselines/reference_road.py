"""The road of a reference method: demand, entrances, traffic, measurement and recording."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

from attrs import define

from laneweave.protocol.road_layout import Exits
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import RoadClock
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.demand import Arrival, count_until
from laneweave.sim_bridge.road.entry import TIME_TOLERANCE_S
from laneweave.sim_bridge.road.sized_bodies import bodies_of


@define(eq=False)
class ReferenceVehicle:
    """A vehicle on the road, without a formation or motion controller."""

    arrival: Arrival
    entered_s: float
    """Road time at which its front passed the entrance."""
    s_m: float
    """Position of the front bumper along the road."""
    speed_mps: float
    y_m: float
    """Position of the body's centre across the road."""
    lane: int
    """Current lane; during a lane change, the new lane."""
    accel_mps2: float = 0.0
    lateral_speed_mps: float = 0.0
    previous_lane: int | None = None
    """Old lane during a lane change."""
    formation: None = None

    @property
    def name(self) -> str:
        """Name of the vehicle."""
        return self.arrival.vehicle

    @property
    def preferred_lane(self) -> int:
        """Lane in which the vehicle wants to leave the road, or `ANY_LANE`."""
        return self.arrival.preferred_lane

    @property
    def destination(self) -> str:
        """Name of the exit by which the vehicle wants to leave, or `END_OF_ROAD`."""
        return self.arrival.destination

    @property
    def state(self) -> State:
        """(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""
        return self.s_m, self.speed_mps, self.accel_mps2, self.y_m, self.lateral_speed_mps, 0.0

    @property
    def cell(self) -> None:
        """None, since the vehicle reserves no cells."""

    @property
    def has_plan(self) -> None:
        """None: reference methods make no plans."""

    @property
    def level_ticks(self) -> Mapping[FallbackLevel, int]:
        """Empty, since there is no motion controller."""
        return {}


class Entrance:
    """Queues of waiting vehicles at the entry points of a road."""

    def __init__(self, scenario: Scenario) -> None:
        """Create empty queues."""
        self._queues: list[deque[Arrival]] = [deque() for _ in scenario.geometry.entry_points]
        self._entry_m = [point.at_m for point in scenario.geometry.entry_points]
        self._speed_mps = scenario.formation.speed_mps
        self._tick_s = scenario.runtime.tick_s

    def __len__(self) -> int:
        """Return the number of waiting vehicles."""
        return sum(map(len, self._queues))

    def queue(self, arrival: Arrival) -> None:
        """Add a vehicle to the queue of its entry point."""
        self._queues[arrival.entry_point].append(arrival)

    def next_at(self, point: int) -> Arrival | None:
        """Return the next vehicle in the queue of an entry point, if any."""
        return self._queues[point][0] if self._queues[point] else None

    def max_entry_m(self, arrival: Arrival, t_s: float) -> float:
        """Return the maximum position at which a vehicle can enter in this tick.

        A vehicle that arrived between two ticks and did not wait has driven at v_F since then.
        """
        driven_s = min(max(t_s - arrival.t_s, 0.0), self._tick_s)
        return self._entry_m[arrival.entry_point] + self._speed_mps * driven_s

    def entered_s(self, arrival: Arrival, s_m: float, t_s: float) -> float:
        """Return when a vehicle that is at `s_m` at `t_s` passed its entrance at v_F."""
        return t_s - (s_m - self._entry_m[arrival.entry_point]) / self._speed_mps

    def enter(
        self, point: int, t_s: float, s_m: float, y_m: float, speed_mps: float
    ) -> ReferenceVehicle:
        """Remove the next vehicle from a queue, and return it on the road at `t_s`."""
        arrival = self.take(point)
        return ReferenceVehicle(
            arrival, self.entered_s(arrival, s_m, t_s), s_m, speed_mps, y_m, arrival.lane
        )

    def take(self, point: int) -> Arrival:
        """Remove and return the next vehicle in the queue of an entry point."""
        return self._queues[point].popleft()


class Traffic(Protocol):
    """The vehicles on the road, moved by a reference method."""

    @property
    def vehicles(self) -> Collection[ReferenceVehicle]:
        """All vehicles on the road."""

    def step(self, t_s: float, entrance: Entrance) -> list[ReferenceVehicle]:
        """Move all vehicles to their positions at `t_s`; return the vehicles that entered."""

    def poses(self) -> dict[str, Pose]:
        """Return the pose of each vehicle."""

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that SUMO reports as colliding."""

    def remove(self, vehicle: ReferenceVehicle) -> None:
        """Remove a vehicle from the road."""


class ReferenceRoad:
    """The road of a reference method; call `advance` until `ending` is set."""

    def __init__(
        self, scenario: Scenario, stream: Sequence[Arrival], traffic: Traffic, record: RunRecord
    ) -> None:
        """Create the road before the first tick."""
        self.tick = 0
        self._scenario = scenario
        self._traffic = traffic
        self._record = record
        self._arrivals = stream
        self._demanded = 0
        self._left = 0
        self._entrance = Entrance(scenario)
        self._exits = Exits(scenario.geometry.sections, scenario.road.length_m)

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.tick * self._scenario.runtime.tick_s

    @property
    def ending(self) -> Ending | None:
        """Reason why the run has ended; None while it continues."""
        if self._left == len(self._arrivals):
            return Ending.COMPLETE
        if self.t_s >= self._scenario.runtime.max_road_s:
            return Ending.LIMIT
        return None

    @property
    def clock(self) -> RoadClock:
        """Road time and counts for the progress bar."""
        on_road = len(self._traffic.vehicles)
        return RoadClock(
            tick=self.tick,
            t_s=self.t_s,
            demanded=self._demanded,
            entered=self._left + on_road,
            on_road=on_road,
            left=self._left,
            ended=self.ending is not None,
        )

    def advance(self) -> None:
        """Advance by one tick."""
        start_s = time.perf_counter()
        self.tick += 1
        self._queue_arrivals()
        for vehicle in self._traffic.step(self.t_s, self._entrance):
            self._record.on_entered(vehicle)
        self._measure()
        self._remove_departed()
        self._record.on_tick(self.t_s, len(self._traffic.vehicles), time.perf_counter() - start_s)

    def _queue_arrivals(self) -> None:
        """Queue the vehicles that arrived since the last tick."""
        first = self._demanded
        self._demanded = count_until(self._arrivals, self.t_s + TIME_TOLERANCE_S)
        for arrival in self._arrivals[first : self._demanded]:
            self._record.on_demanded(arrival)
            self._entrance.queue(arrival)

    def _measure(self) -> None:
        """Record positions, overlaps and gaps."""
        vehicles = self._traffic.vehicles
        present = (one.arrival for one in vehicles)
        bodies = bodies_of(self._traffic.poses(), present, self._scenario)
        self._record.on_positions(
            self.t_s,
            vehicles,
            overlaps=[*bodies.overlapping_pairs(), *bodies.in_closed_lanes(self._scenario)],
            collisions=self._traffic.collisions(),
            gaps=bodies.min_gaps(),
        )

    def _remove_departed(self) -> None:
        lane_m = self._scenario.road.lane_width_m
        for vehicle in list(self._traffic.vehicles):
            if self._exits.left_by(int(vehicle.y_m // lane_m), vehicle.s_m) is not None:
                self._traffic.remove(vehicle)
                self._left += 1
                self._record.on_left(vehicle, self.t_s, attended=True)
