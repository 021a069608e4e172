"""The record of a run: the recorder's files, and reports of all roles, in `summary.json`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from attrs import define, field
from numpy.typing import NDArray

from laneweave.protocol.scenario.tables import SOLVERS, Scenario, solver_of_event
from laneweave.protocol.summary import RunSummary, write_summary
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.events import (
    AGENT_TOOK_OVER,
    CARETAKER_TOOK_OVER,
    ENTERED,
    FORMATION_CLOSED,
    LEADER,
    LEFT,
    LEFT_OFF_LANE,
    OVERLAP,
    PLAN_EVENTS,
    RUN_ENDED,
)
from laneweave.protocol.wire.messages import ClosedFormation, Heartbeat, LogEvent, Name, Report
from laneweave.sim_bridge.bodies.motion_controller import Rung
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.recording.recorder import Recorder, spread
from laneweave.sim_bridge.road.demand import Arrival


class RecordedVehicle(Protocol):
    """The recorded properties of a vehicle on the road."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def arrival(self) -> Arrival:
        """Its demand."""

    @property
    def entered_s(self) -> float:
        """Road time at which its front passed s = 0."""

    @property
    def formation(self) -> int | None:
        """Number of its formation, None if the method has none."""

    @property
    def state(self) -> State:
        """(s m, v m/s, a m/s2, y m, v_y m/s, a_y m/s2)."""

    @property
    def cell(self) -> tuple[int | None, int]:
        """Column and lane that it holds or moves to; column None off the lattice."""

    @property
    def rung_ticks(self) -> Mapping[Rung, int]:
        """Ticks on each rung of the ladder; empty without a motion controller."""


@define
class _Leadership:
    """The leader, as seen in heartbeats."""

    leader: tuple[Name, int] | None = None
    heard_s: float = 0.0
    changes: int = 0
    recovery_s: list[float] = field(factory=list)


class Ending(Enum):
    """Why a run ended."""

    COMPLETE = "complete"
    """All demanded vehicles have left."""
    INTERRUPTED = "interrupted"
    """It was stopped, or something failed."""
    LIMIT = "limit"
    """The road time limit was reached."""


class RunRecord:
    """Collects a run's measurements and writes its folder."""

    def __init__(
        self, folder: Path, scenario: Scenario, method: str, stopwatch: Callable[[], float]
    ) -> None:
        """Open a run's folder; see `Recorder` for its files."""
        self._folder = folder
        self._scenario = scenario
        self._method = method
        self._stopwatch = stopwatch
        self._began = stopwatch()
        self._recorder = Recorder(folder, scenario)
        self._leadership = _Leadership()
        self._reports: dict[tuple[Name, Name], Report] = {}
        self._plans: list[dict[str, Any]] = []
        self._plans_by_solver = Counter(dict.fromkeys(SOLVERS, 0))
        self._ticks: list[tuple[float, int, float]] = []
        self._rung_ticks = dict.fromkeys(Rung, 0)
        self._missed_ticks = 0
        self._caretaker_takeovers = 0
        self._agent_takeovers = 0
        self._left_off_lane = 0
        self._left_unattended = 0
        self._closed = False

    # --- the road -----------------------------------------------------------------

    def note(self, t_s: float, kind: str, **data: object) -> None:
        """Write an event of the bridge."""
        if not self._closed:
            self._recorder.event(t_s, kind, role="bridge", **data)

    def on_demanded(self, arrival: Arrival) -> None:
        """Record a vehicle that wants to enter."""
        self._recorder.demanded(arrival)

    def on_entered(self, vehicle: RecordedVehicle) -> None:
        """Record a vehicle that has entered the road."""
        self._recorder.entered(vehicle.name, vehicle.entered_s, vehicle.formation)
        self.note(
            vehicle.entered_s,
            ENTERED,
            vehicle=vehicle.name,
            lane=vehicle.arrival.lane,
            preferred_lane=vehicle.arrival.preferred_lane,
            formation=vehicle.formation,
        )

    def on_closed(self, closed: ClosedFormation, members: Sequence[Name]) -> None:
        """Record a closed formation."""
        number, columns = closed.first_block, closed.columns(self._scenario.lattice)
        for vehicle in members:
            self._recorder.assign(vehicle, number)
        self.note(
            closed.closed_s,
            FORMATION_CLOSED,
            formation=number,
            vehicles=list(members),
            columns=[columns[0], columns[-1]],
        )

    def on_left(self, vehicle: RecordedVehicle, t_s: float, *, attended: bool) -> None:
        """Record a vehicle that has passed the end of the road since the last tick.

        `attended`: its agent was in charge, not its caretaker.
        """
        s_m, v_mps, _, y_m, _, _ = vehicle.state
        beyond_m = s_m - self._scenario.road.length_m
        left_s = t_s - beyond_m / v_mps if v_mps > 0 else t_s
        lane = int(y_m // self._scenario.road.lane_width_m)
        self._recorder.left(vehicle.name, left_s, lane)
        self._count_rungs(vehicle)
        preferred_lane = vehicle.arrival.preferred_lane
        self.note(
            left_s,
            LEFT,
            vehicle=vehicle.name,
            lane=lane,
            on_preferred_lane=lane == preferred_lane,
        )
        self._left_unattended += not attended
        if lane != preferred_lane:
            self._left_off_lane += 1
            self.note(
                left_s,
                LEFT_OFF_LANE,
                vehicle=vehicle.name,
                lane=lane,
                preferred_lane=preferred_lane,
                attended=attended,
            )

    def on_still_on_road(self, vehicle: RecordedVehicle) -> None:
        """Record a vehicle that is on the road at the end of the run."""
        self._count_rungs(vehicle)

    @property
    def missed_ticks(self) -> int:
        """Answers that had not come by their tick's deadline."""
        return self._missed_ticks

    def on_missed(self, agents: int) -> None:
        """Record the number of agents that have not answered a tick by its deadline."""
        self._missed_ticks += agents

    def on_caretaker_took_over(self, t_s: float, vehicle: Name, reason: str) -> None:
        """Record that a caretaker has taken charge, and why: see `Absence`."""
        self._caretaker_takeovers += 1
        self.note(t_s, CARETAKER_TOOK_OVER, vehicle=vehicle, reason=reason)

    def on_agent_took_over(self, t_s: float, vehicle: Name, previous: str) -> None:
        """Record that an agent has taken charge from the `caretaker` or an earlier `agent`."""
        self._agent_takeovers += 1
        self.note(t_s, AGENT_TOOK_OVER, vehicle=vehicle, previous=previous)

    def on_shown(
        self,
        t_s: float,
        vehicles: Iterable[RecordedVehicle],
        *,
        overlaps: Iterable[tuple[str, str]],
        collisions: Iterable[tuple[str, str]],
        gaps: MinGaps,
    ) -> None:
        """Record positions, overlaps, collisions and gaps at a tick."""
        overlaps = list(overlaps)
        for pair in overlaps:
            self.note(t_s, OVERLAP, vehicles=pair)
        self._recorder.safety(overlaps, collisions, gaps)
        self._recorder.tick(t_s, [_sample(vehicle) for vehicle in vehicles])

    def on_tick(self, t_s: float, on_road: int, duration_s: float) -> None:
        """Record the duration of a tick."""
        self._ticks.append((t_s, on_road, duration_s * 1e3))

    # --- the other roles ----------------------------------------------------------------------

    def on_event(self, event: LogEvent) -> None:
        """Record an event of another role."""
        if self._closed:
            return
        # Role and name of the message replace those in its data.
        data = event.data | {"role": event.role, "name": event.name}
        self._recorder.event(event.t_s, event.kind, **data)
        if event.kind in PLAN_EVENTS:
            self._plans.append(event.data)
            solver = solver_of_event(event.kind, event.data)
            if solver is not None:
                self._plans_by_solver[solver] += 1

    def on_report(self, report: Report) -> None:
        """Record the counters of a role; the newest report of a sender counts."""
        self._reports[report.role, report.name] = report

    def on_heartbeat(self, heartbeat: Heartbeat, t_s: float, now_s: float) -> None:
        """Record changes of the leader and the times without one.

        `now_s` is the node's clock.
        """
        leadership = self._leadership
        sender = (heartbeat.coordinator, heartbeat.incarnation)
        if not heartbeat.leading:
            return
        if sender != leadership.leader:
            if leadership.leader is not None:
                leadership.changes += 1
                leadership.recovery_s.append(round(now_s - leadership.heard_s, 4))
            leadership.leader = sender
            self.note(t_s, LEADER, coordinator=heartbeat.coordinator, term=heartbeat.term)
        leadership.heard_s = now_s

    # --- the end ------------------------------------------------------------------------------

    def close(self, t_s: float, ending: Ending) -> None:
        """Write all files. Idempotent: the first ending counts."""
        if self._closed:
            return
        self.note(t_s, RUN_ENDED, ending=ending.value)
        self._closed = True
        self._recorder.close()
        self._write_ticks()
        summary = self._recorder.summarise(self._method, t_s) | {"ending": ending.value}
        summary["vehicles"] |= {
            "left_off_lane": self._left_off_lane,
            "left_unattended": self._left_unattended,
        }
        write_summary(self._folder, RunSummary.from_json(summary | self._rest(t_s)))

    def _write_ticks(self) -> None:
        """Write ticks.parquet: how long each tick took, with how many vehicles on the road."""
        times, counts, durations = zip(*self._ticks, strict=True) if self._ticks else ((), (), ())
        table = pa.table(
            {
                "t_s": pa.array(times, pa.float64()),
                "on_road": pa.array(counts, pa.int32()),
                "tick_ms": pa.array(durations, pa.float32()),
            }
        )
        pq.write_table(table, self._folder / "ticks.parquet", compression="zstd")

    def _count_rungs(self, vehicle: RecordedVehicle) -> None:
        for rung, ticks in vehicle.rung_ticks.items():
            self._rung_ticks[rung] += ticks

    def _rest(self, t_s: float) -> dict[str, Any]:
        wall_s, ticks = self._stopwatch() - self._began, self._rung_ticks
        reports = self._reports.values()
        solve_ms = _milliseconds(report.solve_ms for report in reports)
        solves = sum(report.solves for report in reports)
        osqp_solves = sum(report.osqp_solves for report in reports)
        plan_ms = np.array([_number(plan.get("solve_ms")) for plan in self._plans])
        return {
            "planning": {
                "plans": len(self._plans),
                "optimal": sum(plan.get("status") == "optimal" for plan in self._plans),
                "largest_formation": max(
                    (int(_number(plan.get("vehicles"))) for plan in self._plans), default=0
                ),
                "by_solver": dict(self._plans_by_solver),
                "fallbacks": sum(plan.get("fallback") is True for plan in self._plans),
                "solve_ms": spread(plan_ms, 50, 95, largest=True),
            },
            "tracking": {
                "solves": solves,
                "osqp_solves": osqp_solves,
                "unconstrained_steps": solves - osqp_solves,
                "unusable": sum(report.unusable for report in reports),
                "hold_law_ticks": ticks[Rung.HOLD] + ticks[Rung.GIVE_WAY],
                "emergency_ticks": ticks[Rung.EMERGENCY],
                "missed_ticks": self._missed_ticks,
                "caretaker_takeovers": self._caretaker_takeovers,
                "agent_takeovers": self._agent_takeovers,
                "solve_ms": spread(solve_ms, 50, 99),
            },
            "runtime": {
                "real_time_factor": round(t_s / wall_s, 3) if wall_s > 0 else 0.0,
                "wall_s": round(wall_s, 3),
                "processes": None,
                "vehicles_per_process": self._scenario.runtime.vehicles_per_process,
                "tick_ms": spread(np.array([tick[2] for tick in self._ticks]), 50, 99),
            },
            "messages": {
                "published": _per_process(reports, "published"),
                "dropped_by_faults": 0,
                "rejected": _per_process(reports, "rejected"),
            },
            "failover": {
                "leader_changes": self._leadership.changes,
                "recovery_s": self._leadership.recovery_s,
            },
        }


def _sample(vehicle: RecordedVehicle) -> tuple[str, float, float, float, float, int | None, int]:
    s_m, v_mps, a_mps2, y_m, _, _ = vehicle.state
    column, lane = vehicle.cell
    return (vehicle.name, s_m, y_m, v_mps, a_mps2, column, lane)


def _per_process(reports: Iterable[Report], counter: str) -> int:
    """Return the sum over processes of a counter that each may report for several vehicles."""
    newest: dict[Name, int] = {}
    for report in reports:
        newest[report.process] = max(newest.get(report.process, 0), getattr(report, counter))
    return sum(newest.values())


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else 0.0


def _milliseconds(packed: Iterable[bytes]) -> NDArray[np.float64]:
    """Return the valid durations: reports come from other processes."""
    whole = b"".join(each for each in packed if len(each) % 4 == 0)
    values = np.frombuffer(whole, dtype="<f4").astype(np.float64)
    return values[np.isfinite(values) & (values >= 0.0)]
