"""Measurements of an episode, in memory."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

from attrs import define
from msgspec import structs

from laneweave.protocol.road_layout import Exits, LaneSection
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.protocol.wire.events import PLANNING_FAILED
from laneweave.protocol.wire.messages import ClosedFormation, Heartbeat, Name
from laneweave.protocol.wire.obstacle_messages import Obstacle
from laneweave.protocol.wire.process_messages import LogEvent, Report
from laneweave.sim_bridge.bodies.command_checks import Refusal
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.run_record import RecordedVehicle
from laneweave.sim_bridge.road.demand import Arrival


@define
class Trip:
    """What has been measured of one vehicle that has entered."""

    entered_s: float
    """Road time at which it entered the road."""
    left_s: float | None = None
    """Road time at which it left the road; None: it is on the road."""
    at_destination: bool = False
    """Whether it left in its preferred lane, or by its exit."""
    discomfort: float = 0.0
    """Integral of the squared acceleration, along and across the road [m2/s3]."""


class EpisodeRecord:
    """Trips, overlaps and events of an episode; implements `Record`."""

    def __init__(self, scenario: Scenario) -> None:
        """Begin without vehicles."""
        self.trips: dict[str, Trip] = {}
        """Trips of all vehicles that have entered, by name."""
        self.overlaps: list[tuple[float, str, str]] = []
        """Road time and names of each overlap of two bodies, or of a body and a closed lane."""
        self.min_gap_m = math.inf
        """Minimum net gap between two vehicles in line."""
        self.events: Counter[str] = Counter()
        """Number of events by kind, of all roles."""
        self.planning_errors: list[str] = []
        """Errors of plans that could not be made."""
        self.missed_ticks = 0
        self.recording = True
        self.ending: Ending | None = None
        """How the episode has ended; None: it goes on."""
        self._exits = Exits(scenario.geometry.sections, scenario.road.length_m)
        self._lane_m = scenario.road.lane_width_m
        self._tick_s = scenario.runtime.tick_s

    def event(self, t_s: float, kind: str, /, **data: object) -> None:
        """Count an event from the bridge."""
        del t_s, data
        self.events[kind] += 1

    @property
    def overlap_count(self) -> int:
        """Number of pairs of bodies that have intersected."""
        return len({frozenset(pair) for _, *pair in self.overlaps})

    def on_demanded(self, arrival: Arrival) -> None:
        """Do nothing: the trip begins when the vehicle enters."""

    def on_entered(self, vehicle: RecordedVehicle) -> None:
        """Begin a trip."""
        self.trips[vehicle.name] = Trip(vehicle.entered_s)

    def on_closed(self, closed: ClosedFormation, members: Sequence[Name]) -> None:
        """Do nothing."""

    def on_left(self, vehicle: RecordedVehicle, t_s: float, *, attended: bool) -> None:
        """End a trip."""
        del attended
        s_m, v_mps, _, y_m, _, _ = vehicle.state
        lane, arrival = int(y_m // self._lane_m), vehicle.arrival
        section = self._exits.left_by(lane, s_m) or LaneSection(lane, to_m=s_m)
        trip = self.trips[vehicle.name]
        trip.left_s = t_s - (s_m - section.to_m) / v_mps if v_mps > 0 else t_s
        trip.at_destination = section.serves(arrival.preferred_lane, arrival.destination)

    def on_refused(self, t_s: float, vehicle: Name, refusal: Refusal) -> None:
        """Do nothing."""

    def on_lane_end(self, t_s: float, vehicle: Name, lane: int, kind: str, s_m: float) -> None:
        """Count that a vehicle has left the lattice at a dead end, or comes back."""
        del s_m
        self.event(t_s, kind, vehicle=vehicle, lane=lane)

    def on_obstacle(self, t_s: float, kind: str, obstacle: Obstacle) -> None:
        """Count that a part of a lane is closed for a time, or open again."""
        self.event(t_s, kind, **structs.asdict(obstacle))

    def on_still_on_road(self, vehicle: RecordedVehicle) -> None:
        """Do nothing."""

    def on_missed(self, agents: int) -> None:
        """Count answers that were missing at a tick's deadline."""
        self.missed_ticks += agents

    def on_caretaker_took_over(self, t_s: float, vehicle: Name, reason: str) -> None:
        """Do nothing."""

    def on_agent_took_over(self, t_s: float, vehicle: Name, previous: str) -> None:
        """Do nothing."""

    def on_positions(
        self,
        t_s: float,
        vehicles: Iterable[RecordedVehicle],
        *,
        overlaps: Iterable[tuple[str, str]],
        collisions: Iterable[tuple[str, str]],
        gaps: MinGaps,
    ) -> None:
        """Add overlaps and accelerations of a tick."""
        del collisions
        self.overlaps += ((t_s, *pair) for pair in overlaps)
        self.min_gap_m = min(self.min_gap_m, gaps.gap_m)
        for vehicle in vehicles:
            _, _, accel_mps2, _, _, lateral_mps2 = vehicle.state
            squared = accel_mps2 * accel_mps2 + lateral_mps2 * lateral_mps2
            self.trips[vehicle.name].discomfort += squared * self._tick_s

    def on_tick(self, t_s: float, on_road: int, duration_s: float) -> None:
        """Do nothing."""

    def on_event(self, event: LogEvent) -> None:
        """Count an event from another role."""
        self.events[event.kind] += 1
        if event.kind == PLANNING_FAILED:
            self.planning_errors.append(str(event.data.get("error")))

    def on_report(self, report: Report) -> None:
        """Do nothing."""

    def on_heartbeat(self, heartbeat: Heartbeat, t_s: float, now_s: float) -> None:
        """Do nothing."""

    def close(self, t_s: float, ending: Ending) -> None:
        """Store how the episode has ended."""
        del t_s
        self.ending = self.ending or ending
