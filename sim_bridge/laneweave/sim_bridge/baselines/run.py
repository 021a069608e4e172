"""A run of a reference method, tick by tick: demand, traffic, measurement, record."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Protocol

from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.wire.messages import RoadClock
from laneweave.sim_bridge.baselines.entrance import Entrance
from laneweave.sim_bridge.baselines.vehicle import Vehicle
from laneweave.sim_bridge.bodies.footprints import Bodies, Pose
from laneweave.sim_bridge.recording.run_record import Ending, RunRecord
from laneweave.sim_bridge.road.demand import arrivals
from laneweave.sim_bridge.road.entry import TIME_TOLERANCE_S


class Traffic(Protocol):
    """The vehicles on the road, and what moves them."""

    @property
    def vehicles(self) -> Collection[Vehicle]:
        """All on the road."""

    def step(self, t_s: float, entrance: Entrance) -> list[Vehicle]:
        """Move everybody on by one tick, to `t_s`, and return who entered from the entrance."""

    def poses(self) -> dict[str, Pose]:
        """Return where each vehicle is shown."""

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that SUMO takes for colliding."""

    def remove(self, vehicle: Vehicle) -> None:
        """Take a vehicle off the road."""


class ReferenceRoad:
    """The road of a reference method; `advance` it until it has ended."""

    def __init__(
        self,
        scenario: Scenario,
        traffic: Traffic,
        record: RunRecord,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Set the road up before the first tick.

        Args:
            scenario: road, demand, vehicles.
            traffic: an empty road.
            record: where measurements go.
            stopwatch: measures the duration of ticks, in s; decides nothing.
        """
        self.tick = 0
        self._scenario = scenario
        self._traffic = traffic
        self._record = record
        self._stopwatch = stopwatch
        self._arrivals = arrivals(scenario)
        self._demanded = 0
        self._left = 0
        self._entrance = Entrance(scenario)

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.tick * self._scenario.runtime.tick_s

    @property
    def ending(self) -> Ending | None:
        """Why the run is over; None: it is not."""
        if self._left == len(self._arrivals):
            return Ending.COMPLETE
        if self.t_s >= self._scenario.runtime.max_road_s:
            return Ending.LIMIT
        return None

    @property
    def clock(self) -> RoadClock:
        """What a progress bar shows."""
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
        """Go on by one tick."""
        began = self._stopwatch()
        self.tick += 1
        self._demand()
        for vehicle in self._traffic.step(self.t_s, self._entrance):
            self._record.on_entered(vehicle)
        self._measure()
        self._let_leave()
        self._record.on_tick(self.t_s, len(self._traffic.vehicles), self._stopwatch() - began)

    def _demand(self) -> None:
        """Queue those who arrived since the last tick."""
        while self._demanded < len(self._arrivals):
            arrival = self._arrivals[self._demanded]
            if arrival.t_s > self.t_s + TIME_TOLERANCE_S:
                return
            self._record.on_demanded(arrival)
            self._entrance.queue(arrival)
            self._demanded += 1

    def _measure(self) -> None:
        """Record where everybody is, and how close they are."""
        size = self._scenario.vehicle
        bodies = Bodies(self._traffic.poses(), size.length_m, size.width_m)
        self._record.on_shown(
            self.t_s,
            self._traffic.vehicles,
            overlaps=bodies.overlapping_pairs(),
            collisions=self._traffic.collisions(),
            gaps=bodies.least_gaps(),
        )

    def _let_leave(self) -> None:
        length_m = self._scenario.road.length_m
        for vehicle in [each for each in self._traffic.vehicles if each.s_m >= length_m]:
            self._traffic.remove(vehicle)
            self._left += 1
            self._record.on_left(vehicle, self.t_s, attended=True)
