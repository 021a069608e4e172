"""`summary.json`: the results of one run.

The bridge writes the file when a run ends; the launcher adds the fields that only it knows.
Fields with a default are absent from summaries of earlier versions, and of runs to which they do
not apply.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import attrs
from attrs import frozen
from cattrs import Converter

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.files import write_atomically

SUMMARY_FILE = "summary.json"
SCHEMA = "laneweave.summary/1"


@frozen(kw_only=True)
class VehicleCounts:
    """Vehicle counts."""

    demanded: int
    entered: int
    left: int
    on_preferred_lane: int
    """Vehicles that left the road in their preferred lane."""
    peak: int
    """Maximum number of vehicles on the road at once."""
    at_destination: int | None = None
    """Vehicles that left by the exit that they wanted, and in their preferred lane if any."""
    left_off_lane: int | None = None
    left_unattended: int | None = None


@frozen(kw_only=True)
class TripTimes:
    """Means of the counted vehicles of one entrance or one destination [s]."""

    n: int
    """Number of counted vehicles."""
    mean: float
    delay: float
    """Excess over the time at v_F from the entrance to the destination."""


@frozen(kw_only=True)
class TravelTime:
    """Travel times of the counted vehicles [s]; None: no vehicle was counted."""

    mean: float | None
    p50: float | None
    p95: float | None
    max: float | None
    n: int | None = None
    """Number of counted vehicles."""
    by_destination: dict[str, TripTimes] | None = None
    """By the name of the exit by which they wanted to leave; `end`: the end of the road."""
    by_entrance: dict[str, TripTimes] | None = None
    """By the name of the entrance; `main`: the start of the road."""
    by_type: dict[str, TripTimes] | None = None
    """By the type of vehicle; `car`: those that the scenario's table `vehicle` describes."""


@frozen(kw_only=True)
class Safety:
    """Counts and extremes over all vehicles and ticks; None: nothing was measured."""

    overlaps: int
    """Pairs of bodies that intersected at some tick; closed parts of lanes count as bodies."""
    sumo_collisions: int
    min_gap_m: float | None
    min_headway_s: float | None
    emergency_brakes: int
    max_accel_mps2: float | None
    min_accel_mps2: float | None
    max_jerk_mps3: float | None


@frozen(kw_only=True)
class PlanningMs:
    """Planning times [ms]."""

    p50: float | None
    p95: float | None
    max: float | None


@frozen(kw_only=True)
class DurationMs:
    """Durations [ms]."""

    p50: float | None
    p99: float | None


@frozen(kw_only=True)
class Planning:
    """Plan counts over all coordinators."""

    plans: int
    optimal: int
    largest_formation: int
    by_solver: dict[str, int] | None = None
    fallbacks: int | None = None
    solve_ms: PlanningMs


@frozen(kw_only=True)
class Tracking:
    """Solve counts of agents, and counts of fallbacks."""

    solves: int
    osqp_solves: int | None = None
    unconstrained_steps: int | None = None
    unusable: int
    hold_law_ticks: int | None = None
    emergency_ticks: int | None = None
    missed_ticks: int | None = None
    caretaker_takeovers: int | None = None
    agent_takeovers: int | None = None
    solve_ms: DurationMs


@frozen(kw_only=True)
class RuntimeFigures:
    """Process counts, and the speed of the run."""

    real_time_factor: float
    wall_s: float
    processes: int | None
    """Maximum number of processes at once; None: unknown."""
    vehicles_per_process: int
    tick_ms: DurationMs


@frozen(kw_only=True)
class Messages:
    """Message counts over all processes."""

    published: int
    dropped_by_faults: int
    rejected: int | None = None


@frozen(kw_only=True)
class LeaderChanges:
    """Leadership changes."""

    leader_changes: int
    recovery_s: list[float]
    """Leaderless periods [s]; with injected faults: from each leader fault until another candidate
    led."""
    plan_recovery_s: list[float] | None = None
    """Times from each leader fault until the next plan was in force [s]."""


@frozen(kw_only=True)
class RunSummary:
    """The content of `summary.json`."""

    schema: str
    method: str
    seed: int
    volume_veh_per_lane_h: float
    lanes: int
    road_m: float
    simulated_s: float
    vehicles: VehicleCounts
    travel_time_s: TravelTime
    throughput_veh_per_lane_h: float | None
    safety: Safety
    ending: str | None = None
    """`complete`, `interrupted` or `limit`."""
    planning: Planning
    tracking: Tracking
    runtime: RuntimeFigures
    messages: Messages
    failover: LeaderChanges
    faults: dict[str, Any] | None = None
    """Injected faults; None: the run has no fault file."""
    plug_ins: list[str] | None = None
    """Name and version of the distributions whose plug-ins made plans or drove the vehicles."""
    folder: Path | None = attrs.field(default=None, eq=False)
    """Folder of the run, which is not part of the file."""

    @classmethod
    def from_json(cls, data: object) -> RunSummary:
        """Read a summary from a JSON object.

        Raises:
            BadInputError: the object is not a summary.
        """
        try:
            return _CONVERTER.structure(data, cls)
        except Exception as error:
            raise BadInputError(SUMMARY_FILE, type(data).__name__, "a run's summary") from error

    def to_json(self) -> dict[str, Any]:
        """Return the summary as a JSON object."""
        return attrs.asdict(self, filter=_is_written)

    @property
    def preferred_percent(self) -> float | None:
        """Percentage of the departed vehicles that left in their preferred lane."""
        left = self.vehicles.left
        return 100.0 * self.vehicles.on_preferred_lane / left if left else None


def read_summary(folder: Path) -> RunSummary | None:
    """Return the summary in a run's folder; None if it is missing or invalid."""
    try:
        data = json.loads((folder / SUMMARY_FILE).read_text(encoding="utf-8"))
        return attrs.evolve(RunSummary.from_json(data), folder=folder)
    except (OSError, ValueError):
        return None


def write_summary(folder: Path, summary: RunSummary) -> None:
    """Write `summary.json` atomically."""
    text = json.dumps(summary.to_json(), indent=2, allow_nan=False) + "\n"
    write_atomically(folder / SUMMARY_FILE, text)


def _is_written(one: attrs.Attribute[Any], value: object) -> bool:
    if isinstance(value, Path):
        return False
    return one.default is attrs.NOTHING or value is not None


_CONVERTER = Converter(detailed_validation=False)
