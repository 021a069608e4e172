"""Interfaces through which the bridge reports what happens on its road."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

from laneweave.protocol.summary import Ending
from laneweave.protocol.wire.messages import ClosedFormation, Heartbeat, Name
from laneweave.protocol.wire.obstacle_messages import Obstacle
from laneweave.protocol.wire.process_messages import LogEvent, Report
from laneweave.sim_bridge.bodies.command_checks import Refusal
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.run_record import RecordedVehicle
from laneweave.sim_bridge.road.demand import Arrival


class RoadRecord(Protocol):
    """Receiver of what happens to vehicles on a road."""

    def event(self, t_s: float, kind: str, /, **data: object) -> None:
        """Record an event from the bridge."""

    def on_demanded(self, arrival: Arrival) -> None:
        """Record the arrival of a vehicle."""

    def on_entered(self, vehicle: RecordedVehicle) -> None:
        """Record a vehicle that has entered the road."""

    def on_closed(self, closed: ClosedFormation, members: Sequence[Name]) -> None:
        """Record a closed formation."""

    def on_left(self, vehicle: RecordedVehicle, t_s: float, *, attended: bool) -> None:
        """Record a vehicle that has left the road since the last tick."""

    def on_lane_end(self, t_s: float, vehicle: Name, lane: int, kind: str, s_m: float) -> None:
        """Record that a vehicle has left the lattice at a dead end, or comes back."""

    def on_obstacle(self, t_s: float, kind: str, obstacle: Obstacle) -> None:
        """Record that a part of a lane is closed for a time, or open again."""

    def on_refused(self, t_s: float, vehicle: Name, refusal: Refusal) -> None:
        """Record that a motion controller has refused a command that no correct agent sends."""

    def on_caretaker_took_over(self, t_s: float, vehicle: Name, reason: str) -> None:
        """Record that a caretaker has taken charge of a vehicle."""

    def on_agent_took_over(self, t_s: float, vehicle: Name, previous: str) -> None:
        """Record that an agent has taken charge of a vehicle."""


class Record(RoadRecord, Protocol):
    """Receiver of a road's measurements: `RunRecord`, which writes files, or a substitute."""

    @property
    def missed_ticks(self) -> int:
        """Number of answers that were missing at their tick's deadline."""

    @property
    def overlap_count(self) -> int:
        """Number of pairs of bodies that have intersected."""

    @property
    def recording(self) -> bool:
        """Whether the run is still recorded."""

    def on_still_on_road(self, vehicle: RecordedVehicle) -> None:
        """Record a vehicle that is still on the road at the end."""

    def on_missed(self, agents: int) -> None:
        """Record the number of answers that were missing at a tick's deadline."""

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

    def on_tick(self, t_s: float, on_road: int, duration_s: float) -> None:
        """Record the duration of a tick."""

    def on_event(self, event: LogEvent) -> None:
        """Record an event from another role."""

    def on_report(self, report: Report) -> None:
        """Record the counters of a role."""

    def on_heartbeat(self, heartbeat: Heartbeat, t_s: float, now_s: float) -> None:
        """Record a heartbeat of a coordinator."""

    def close(self, t_s: float, ending: Ending) -> None:
        """End the record; only the first call has an effect."""
