"""The record of a run: its files, and the results of all roles in `summary.json`.

    trajectories.parquet   one row per vehicle and tick
    trips.parquet          one row per demanded vehicle
    ticks.parquet          one row per tick
    events.jsonl           one JSON object per line, flushed line by line

The Parquet files are written in row groups during the run, and can be read after each of them. So
the record stores little more than what is on the road or not written yet, however long the run is.

Every `SAVE_EVERY_S`, all rows and a summary until then are saved, with the ending `unfinished`: a
process that is killed loses no more. If the disk fails, recording stops, and the run goes on.

The metadata of the first two files contain the scenario as JSON (`columns.SCENARIO_KEY`), so that
figures can be drawn from these files alone. The columns are declared in the module `columns`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

import pyarrow as pa
from attrs import define, evolve, field
from msgspec import structs

from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import END_OF_ROAD, Exits, LaneSection
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import (
    SCHEMA,
    Ending,
    LeaderChanges,
    RunSummary,
    RuntimeFigures,
    Tracking,
    VehicleCounts,
    write_summary,
)
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.events import (
    AGENT_TOOK_OVER,
    CARETAKER_TOOK_OVER,
    COMMAND_REFUSED,
    ENTERED,
    FORMATION_CLOSED,
    LEADER,
    LEFT,
    LEFT_LATTICE,
    LEFT_OFF_LANE,
    OVERLAP,
    RUN_ENDED,
)
from laneweave.protocol.wire.messages import ClosedFormation, Heartbeat, Name
from laneweave.protocol.wire.obstacle_messages import Obstacle
from laneweave.protocol.wire.process_messages import LogEvent, Report
from laneweave.sim_bridge.bodies.command_checks import Refusal
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.driving_measures import DrivingMeasures
from laneweave.sim_bridge.recording.events import Events
from laneweave.sim_bridge.recording.leadership import Leadership
from laneweave.sim_bridge.recording.missed_lanes import MissedLanes, leaderless_after_s
from laneweave.sim_bridge.recording.obstacle_log import ObstacleLog
from laneweave.sim_bridge.recording.reports import ReportTotals
from laneweave.sim_bridge.recording.ticks import Ticks
from laneweave.sim_bridge.recording.trajectories import Sample, Trajectories
from laneweave.sim_bridge.recording.trips import Trip, Trips, metadata_of, throughput, travel_time
from laneweave.sim_bridge.road.demand import Arrival

FIRST_SAVE_S, SAVE_EVERY_S = 2.0, 8.0
"""Wall time until a run is first saved, and between two savings while it goes on."""
REPEAT_REFUSAL_S = 10.0
"""Shortest time between two events for refused commands of a vehicle, for one reason."""
NONE_LEFT_OUT: Mapping[str, int] = MappingProxyType({})


class RecordedVehicle(Protocol):
    """The recorded properties of a vehicle on the road."""

    @property
    def name(self) -> str:
        """Name of the vehicle."""

    @property
    def arrival(self) -> Arrival:
        """Arrival at the entrance."""

    @property
    def entered_s(self) -> float:
        """Road time at which its front passed s = 0."""

    @property
    def formation(self) -> int | None:
        """Number of the formation, if any."""

    @property
    def state(self) -> State:
        """(s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2])."""

    @property
    def cell(self) -> Cell | None:
        """Cell that the vehicle holds or moves to; None: the method has no lattice."""

    @property
    def has_plan(self) -> bool | None:
        """Whether the process in charge has accepted a plan; None: the method makes no plans."""

    @property
    def level_ticks(self) -> Mapping[FallbackLevel, int]:
        """Ticks on each fallback level; empty without a motion controller."""


@define
class _Counts:
    """Counts of vehicles, and of changes of the process in charge."""

    caretaker_takeovers: int = 0
    agent_takeovers: int = 0
    left_unattended: int = 0
    missed_exits: int = 0
    refused: int = 0
    """Commands that motion controllers have refused."""
    stopped: set[Name] = field(factory=set)
    """Vehicles that have left the lattice at the end of a lane."""


class RunRecord:
    """Collector of a run's measurements, and writer of its files."""

    def __init__(
        self,
        folder: Path,
        scenario: Scenario,
        method: str,
        stopwatch: Callable[[], float],
        left_out: Mapping[str, int] = NONE_LEFT_OUT,
    ) -> None:
        """Open the files of a run in its folder; create the folder if necessary.

        Args:
            folder: the run's folder.
            scenario: the scenario.
            method: value of `laneweave run --method`.
            stopwatch: returns the wall time [s].
            left_out: number of vehicles that the run leaves out, by reason.

        Raises:
            CommandFailedError: a file cannot be created.
        """
        self._folder = folder
        self._scenario = scenario
        self._method = method
        self._stopwatch = stopwatch
        self._began = stopwatch()
        self._save_at_s = time.monotonic() + FIRST_SAVE_S
        """Time at which everything is saved next."""
        self._disk = disk = Disk()
        self._measures = DrivingMeasures(scenario)
        metadata = metadata_of(scenario)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._events = Events(folder / "events.jsonl", disk)
            self._trajectories = Trajectories(
                folder / "trajectories.parquet",
                metadata,
                scenario.lattice,
                self._measures,
                disk,
            )
            self._trips = Trips(folder / "trips.parquet", metadata, disk)
            self._ticks = Ticks(folder / "ticks.parquet", disk)
        except OSError as error:
            text = f"{folder}: the run cannot be recorded: {error.strerror or error}"
            raise CommandFailedError(text) from error
        self._leadership = Leadership(scenario.network.election_s)
        self._missed_lanes = MissedLanes(leaderless_after_s(scenario))
        self._reports = ReportTotals()
        self._level_ticks: Counter[FallbackLevel] = Counter()
        self._counts = _Counts()
        self._left_out = left_out
        self._obstacles = ObstacleLog()
        self._refused_s = dict[tuple[Name, str], float]()
        """Time of the last event for a refused command, by vehicle and reason."""
        self._exits = Exits(scenario.geometry.sections, scenario.road.length_m)
        self._closed = False
        self._recorded_s = 0.0
        """Road time until which everything is on the disk."""
        self.missed_ticks = 0
        """Number of answers that were missing at their tick's deadline."""

    @property
    def overlap_count(self) -> int:
        """Number of pairs of bodies that have intersected."""
        return self._trajectories.overlap_count

    @property
    def recording(self) -> bool:
        """Whether the run is still recorded; not after an error of the disk."""
        return self._disk.works

    # --- the road -----------------------------------------------------------------

    def event(self, t_s: float, kind: str, /, **data: object) -> None:
        """Write an event from the bridge."""
        self._events.add(t_s, kind, {"role": "bridge"} | data)

    def on_demanded(self, arrival: Arrival) -> None:
        """Record the arrival of a vehicle."""
        scenario = self._scenario
        free_s = scenario.geometry.free_flow_trip_s(arrival.entry_point, arrival.destination)
        entrance = scenario.geometry.entry_points[arrival.entry_point].entrance
        self._trips.add(Trip(arrival, entrance=entrance, free_flow_s=round(free_s, 6)))

    def on_entered(self, vehicle: RecordedVehicle) -> None:
        """Record a vehicle that has entered the road."""
        trip = self._trips[Name(vehicle.name)]
        trip.entered_s, trip.formation = vehicle.entered_s, vehicle.formation
        # One from outside may have changed lanes since it was demanded.
        trip.arrival = vehicle.arrival
        own_type = self._scenario.types[vehicle.arrival.vehicle_type]
        self._measures.enter(vehicle.name, own_type.limits)
        self.event(
            vehicle.entered_s,
            ENTERED,
            vehicle=vehicle.name,
            lane=vehicle.arrival.lane,
            preferred_lane=vehicle.arrival.preferred_lane,
            destination=vehicle.arrival.destination,
            formation=vehicle.formation,
        )

    def on_closed(self, closed: ClosedFormation, members: Sequence[Name]) -> None:
        """Record a closed formation."""
        number, columns = closed.first_block, closed.columns(self._scenario.lattice)
        for vehicle in members:
            self._trips[vehicle].formation = number
        self.event(
            closed.closed_s,
            FORMATION_CLOSED,
            formation=number,
            vehicles=list(members),
            columns=[columns[0], columns[-1]],
        )

    def on_left(self, vehicle: RecordedVehicle, t_s: float, *, attended: bool) -> None:
        """Record a vehicle that has left the road since the last tick, by its end or an exit.

        One that a simulator has taken back before counts as on its way to its destination.

        `attended`: whether the vehicle's agent was in charge, not a caretaker.
        """
        s_m, v_mps, _, y_m, _, _ = vehicle.state
        lane, arrival = int(y_m // self._scenario.road.lane_width_m), vehicle.arrival
        left_by = self._exits.left_by(lane, s_m)
        section = left_by or self._exits.section_at(lane, s_m) or LaneSection(lane, to_m=s_m)
        left_s = t_s - max(s_m - section.to_m, 0.0) / v_mps if v_mps > 0 else t_s
        trip = self._trips[Name(vehicle.name)]
        trip.left_s, trip.final_lane = left_s, lane
        geometry = self._scenario.geometry
        rest_s = geometry.rest_s(s_m, arrival.destination)
        if left_by is None and rest_s >= 0.0:
            trip.exit = arrival.destination
            trip.free_flow_s -= rest_s
        else:
            trip.exit = section.exit if section.to_m < self._scenario.road.length_m else END_OF_ROAD
        at_destination = section.serves(arrival.preferred_lane, arrival.destination) or (
            lane in arrival.right_lanes and section.serves(lane, arrival.destination)
        )
        trip.at_destination = at_destination
        self._counts.missed_exits += trip.exit != arrival.destination
        self._level_ticks.update(vehicle.level_ticks)
        self._counts.left_unattended += not attended
        reasons = self._missed_lanes.pop(
            Name(vehicle.name),
            t_s,
            planned=vehicle.has_plan,
            leader_until_s=self._leadership.until_s,
        )
        where = {"vehicle": vehicle.name, "lane": lane, "exit": trip.exit}
        self.event(left_s, LEFT, **where, on_preferred_lane=at_destination)
        if not at_destination:
            self.event(
                left_s,
                LEFT_OFF_LANE,
                **where,
                preferred_lane=arrival.preferred_lane,
                destination=arrival.destination,
                attended=attended,
                **reasons,
            )

    def on_lane_end(self, t_s: float, vehicle: Name, lane: int, kind: str, s_m: float) -> None:
        """Record that a vehicle has left the lattice at a dead end, or comes back; see `events`."""
        self._missed_lanes.on_lane_end(vehicle, kind)
        self._obstacles.on_lane_end(t_s, vehicle, lane, kind, s_m)
        if kind == LEFT_LATTICE:
            self._counts.stopped.add(vehicle)
        self.event(t_s, kind, vehicle=vehicle, lane=lane)

    def on_obstacle(self, t_s: float, kind: str, obstacle: Obstacle) -> None:
        """Record that a part of a lane is closed for a time, or open again; see `events`."""
        self._obstacles.on_obstacle(t_s, kind, obstacle)
        self.event(t_s, kind, **structs.asdict(obstacle))

    def on_refused(self, t_s: float, vehicle: Name, refusal: Refusal) -> None:
        """Count a refused command; write an event if there was none for a while."""
        self._counts.refused += 1
        reason = refusal.problem.value
        if t_s >= self._refused_s.get((vehicle, reason), -math.inf) + REPEAT_REFUSAL_S:
            self._refused_s[vehicle, reason] = t_s
            excess_m = round(refusal.excess_m, 3)
            self.event(
                t_s,
                COMMAND_REFUSED,
                vehicle=vehicle,
                reason=reason,
                excess_m=excess_m,
                occupant=refusal.occupant,
            )

    def on_still_on_road(self, vehicle: RecordedVehicle) -> None:
        """Record a vehicle that is still on the road when the run ends."""
        self._level_ticks.update(vehicle.level_ticks)

    def on_missed(self, agents: int) -> None:
        """Record the number of answers that were missing at a tick's deadline."""
        self.missed_ticks += agents

    def on_caretaker_took_over(self, t_s: float, vehicle: Name, reason: str) -> None:
        """Record that a caretaker has taken charge; `reason` is an `Absence`."""
        self._counts.caretaker_takeovers += 1
        self._missed_lanes.on_caretaker(t_s, vehicle)
        self.event(t_s, CARETAKER_TOOK_OVER, vehicle=vehicle, reason=reason)

    def on_agent_took_over(self, t_s: float, vehicle: Name, previous: str) -> None:
        """Record that an agent has taken charge from the `caretaker` or an earlier `agent`."""
        self._counts.agent_takeovers += 1
        self._missed_lanes.on_agent(vehicle)
        self.event(t_s, AGENT_TOOK_OVER, vehicle=vehicle, previous=previous)

    def on_positions(
        self,
        t_s: float,
        vehicles: Iterable[RecordedVehicle],
        *,
        overlaps: Iterable[tuple[str, str]],
        collisions: Iterable[tuple[str, str]],
        gaps: MinGaps,
    ) -> None:
        """Record positions, overlaps, collisions and gaps after a tick."""
        overlaps = list(overlaps)
        for pair in overlaps:
            self.event(t_s, OVERLAP, vehicles=pair)
        self._trajectories.distances(overlaps, collisions, gaps)
        self._trajectories.tick(t_s, [_sample(vehicle) for vehicle in vehicles])

    def on_tick(self, t_s: float, on_road: int, duration_s: float) -> None:
        """Record the duration of a tick."""
        self._ticks.add(t_s, on_road, duration_s)
        if time.monotonic() >= self._save_at_s:
            self.save(t_s)
            self._save_at_s = time.monotonic() + SAVE_EVERY_S

    def save(self, t_s: float) -> None:
        """Save all rows, and a summary until road time `t_s`: the process may be killed."""
        for file in (self._trajectories, self._trips, self._ticks):
            file.save()
        if self._disk.works:
            self._recorded_s = t_s
        with self._disk.writing():
            self._write_summary(t_s, Ending.UNFINISHED)

    # --- the other roles ----------------------------------------------------------------------

    def on_event(self, event: LogEvent) -> None:
        """Record an event from another role."""
        # The message's role and name override those in its data.
        data = event.data | {"role": event.role, "name": event.name}
        self._events.add(event.t_s, event.kind, data)

    def on_report(self, report: Report) -> None:
        """Record the counters of a role, replacing its earlier ones."""
        self._reports.add(report)

    def on_heartbeat(self, heartbeat: Heartbeat, t_s: float, now_s: float) -> None:
        """Record leader changes and leaderless periods; `now_s` is the node's clock."""
        leader = self._leadership.on_heartbeat(heartbeat, t_s, now_s)
        if leader is not None:
            self.event(t_s, LEADER, **leader)

    # --- the end ------------------------------------------------------------------------------

    def close(self, t_s: float, ending: Ending) -> None:
        """Write all files; only the first call has an effect.

        With the ending `UNFINISHED`, they are as if the process had been killed after `save`.
        """
        if self._closed:
            return
        if ending is not Ending.UNFINISHED:
            until_s = self._leadership.until_s
            self.event(t_s, RUN_ENDED, ending=ending.value, leader_until_s=until_s)
        self._closed = True
        with self._disk.writing(), ExitStack() as closing:
            for file in (self._events, self._trajectories, self._trips, self._ticks):
                closing.callback(file.close)
        with self._disk.writing():
            self._write_summary(t_s, ending)

    def _write_summary(self, t_s: float, ending: Ending) -> None:
        write_summary(self._folder, self._summary(self._trips.table(), t_s, ending))

    def _summary(self, trips: pa.Table, t_s: float, ending: Ending) -> RunSummary:
        scenario, wall_s = self._scenario, self._stopwatch() - self._began
        left = trips.num_rows - trips["left_s"].null_count
        on_preferred_lane = trips["on_preferred_lane"].to_pylist().count(True)
        return RunSummary(
            schema=SCHEMA,
            method=self._method,
            seed=scenario.seed,
            volume_veh_per_lane_h=scenario.demand.volume_veh_per_lane_h,
            lanes=scenario.road.lanes,
            road_m=scenario.road.length_m,
            simulated_s=round(t_s, 6),
            vehicles=VehicleCounts(
                demanded=trips.num_rows,
                entered=trips.num_rows - trips["entered_s"].null_count,
                left=left,
                on_preferred_lane=on_preferred_lane,
                at_destination=on_preferred_lane,
                peak=self._trajectories.peak,
                left_off_lane=left - on_preferred_lane,
                missed_exits=self._counts.missed_exits,
                stopped_at_lane_end=len(self._counts.stopped),
                left_out=dict(self._left_out) or None,
                left_unattended=self._counts.left_unattended,
            ),
            travel_time_s=travel_time(trips),
            throughput_veh_per_lane_h=throughput(trips, scenario.road.lanes),
            safety=evolve(self._trajectories.safety(), commands_refused=self._counts.refused),
            comfort=self._trajectories.comfort(),
            ending=ending.value,
            obstacles=self._obstacles.figures,
            recorded_until_s=None if self._disk.works else round(self._recorded_s, 6),
            planning=self._events.planning(),
            tracking=self._tracking(),
            runtime=RuntimeFigures(
                real_time_factor=round(t_s / wall_s, 3) if wall_s > 0 else 0.0,
                wall_s=round(wall_s, 3),
                processes=None,
                vehicles_per_process=scenario.runtime.vehicles_per_process,
                tick_ms=self._ticks.durations(),
            ),
            messages=self._reports.messages(radio=scenario.radio.enabled),
            failover=LeaderChanges(
                leader_changes=self._leadership.changes,
                recovery_s=self._leadership.recovery_s,
            ),
        )

    def _tracking(self) -> Tracking:
        reports, ticks = self._reports, self._level_ticks
        solves, osqp_solves = reports.total("solves"), reports.total("osqp_solves")
        return Tracking(
            solves=solves,
            osqp_solves=osqp_solves,
            unconstrained_steps=solves - osqp_solves,
            unusable=reports.total("unusable"),
            hold_law_ticks=ticks[FallbackLevel.HOLD] + ticks[FallbackLevel.GIVE_WAY],
            emergency_ticks=ticks[FallbackLevel.EMERGENCY],
            missed_ticks=self.missed_ticks,
            caretaker_takeovers=self._counts.caretaker_takeovers,
            agent_takeovers=self._counts.agent_takeovers,
            solve_ms=reports.solve_ms(),
        )


def _sample(vehicle: RecordedVehicle) -> Sample:
    s_m, v_mps, a_mps2, y_m, v_y_mps, _ = vehicle.state
    reserved = vehicle.cell or (None, None)
    preferred_lane = vehicle.arrival.preferred_lane
    return (vehicle.name, s_m, y_m, v_mps, v_y_mps, a_mps2, *reserved, preferred_lane)
