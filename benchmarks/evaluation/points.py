"""Results of each label and volume over the seeds of a sweep."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from attrs import frozen

from evaluation.lattice_points import lattice_spacing
from laneweave.launch.recordings.formations import read_events
from laneweave.launch.recordings.results_over_seeds import results_table
from laneweave.launch.recordings.runs import Run
from laneweave.launch.recordings.trajectories import Tracks, read_tracks
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.events import PLAN_MADE, STREAM_PLANNED
from laneweave.sim_bridge.recording.trips import WARM_UP_S

SLOW_BIN_M: Final = 50.0
SLOW_SHARE: Final = 0.5
"""Traffic is congested where its mean speed is below this share of v_F."""
LIMIT_ERROR: Final = 0.001
"""Rounding error of summaries."""
SOLVER: Final = {PLAN_MADE: "branching", STREAM_PLANNED: "rolling"}
"""The solver of plans whose events do not name it, by kind of event."""
Key = tuple[str, float]
"""(label, volume in vehicles/(lane h))."""


@frozen
class Traced:
    """Figures from the trajectories of one run or of several."""

    runs: int
    lattice_least_m: float | None
    """Minimum spacing at lattice points; None: no lattice, or no two vehicles in a lane."""
    lattice_pairs: int
    lattice_worst_off_m: float | None
    """Maximum distance of a vehicle from its cell at lattice points."""
    lattice_kept: bool
    """Whether all spacings are at least the pitch, within the tolerance."""
    slow_m: tuple[float, float] | None
    """Start and end of the congested stretch of road; None: there is none."""
    slowest_mps: float | None
    """Lowest mean speed of a bin of the road; None: there were no vehicles."""


@frozen
class PlanningTimes:
    """Planning times of a solver, over the plans of all seeds."""

    solver: str
    plans: int
    p50_ms: float
    p95_ms: float
    max_ms: float


@frozen
class PointRow:
    """Results of a label at a volume over all complete runs; None: unknown."""

    label: str
    volume_veh_per_lane_h: float
    seeds: tuple[int, ...]
    """Seeds of the complete runs, in which all vehicles have left."""
    failed: tuple[tuple[int, str], ...]
    """(seed, reason) of failed runs; complete runs with overlaps are included in the figures."""
    demanded: int
    left: int
    on_preferred_lane: int
    travel_s: float | None
    """Mean over the seeds of the mean travel time from the demanded arrival."""
    travel_sd_s: float | None
    """Standard deviation of the seeds' mean travel times."""
    travel_p95_s: float | None
    """Mean over the seeds of the 95th percentile."""
    throughput_veh_per_lane_h: float | None
    """Mean over the seeds."""
    overlaps: int
    """Pairs of bodies, over all seeds."""
    emergency_brakes: int
    """Over all seeds."""
    min_gap_m: float | None
    min_headway_s: float | None
    min_accel_mps2: float | None
    max_accel_mps2: float | None
    within_limits: bool
    """Whether all accelerations are within the vehicles' limits."""
    largest_formation: int
    planning_p95_ms: float | None
    """Worst over the seeds."""
    traced: Traced | None
    """Figures from trajectories; None: no trajectories were stored."""
    plans: int = 0
    """Over all seeds, like the following fields."""
    fallbacks: int = 0
    """Plans of the fallback planner."""
    planning: tuple[PlanningTimes, ...] = ()

    @property
    def on_lane_percent(self) -> float | None:
        """Share of vehicles that left in their preferred lane, among all that left."""
        return 100.0 * self.on_preferred_lane / self.left if self.left else None


def point_rows(runs: Iterable[Run]) -> list[PointRow]:
    """Return the rows of all labels and volumes, in the order of labels.

    Raises:
        BadInputError: runs differ in road or demand, or one occurs twice.
        OSError, ValueError, KeyError: a run's files cannot be read.
    """
    listed = sorted(runs, key=lambda run: run.order)
    check_comparable(listed)
    groups: dict[Key, list[Run]] = {}
    for run in listed:
        groups.setdefault((run.label, run.volume_veh_per_lane_h), []).append(run)
    return [_row(key, group) for key, group in groups.items()]


def check_comparable(runs: Sequence[Run]) -> None:
    """Check that runs are distinct and differ in method, volume and seed only.

    Raises:
        BadInputError: they differ in road or demand, or one occurs twice.
    """
    seen: set[tuple[str, float, int]] = set()
    for run in runs:
        first, own = runs[0].scenario, run.scenario
        if own.road != first.road:
            raise BadInputError(str(run.folder), own.road, f"{first.road}, as in the other runs")
        if own.demand.duration_s != first.demand.duration_s:
            raise BadInputError(
                str(run.folder),
                own.demand.duration_s,
                f"demand.duration_s = {first.demand.duration_s:g}, as in the other runs",
            )
        key = (run.label, run.volume_veh_per_lane_h, own.seed)
        if key in seen:
            raise BadInputError(str(run.folder), key, "each label, volume and seed only once")
        seen.add(key)


def _row(key: Key, runs: Sequence[Run]) -> PointRow:
    complete = [run for run in runs if run.summary and run.summary.ending == "complete"]
    scenario, results = runs[0].scenario, results_table(complete)

    def values(column: str) -> list[float]:
        found = results[column].to_pylist() if column in results.column_names else []
        return [float(value) for value in found if value is not None]

    times_s = values("travel_time_s_mean")
    low = min(values("safety_min_accel_mps2"), default=None)
    high = max(values("safety_max_accel_mps2"), default=None)
    return PointRow(
        label=key[0],
        volume_veh_per_lane_h=key[1],
        seeds=tuple(run.scenario.seed for run in complete),
        failed=tuple((run.scenario.seed, run.reason) for run in runs if run.reason),
        demanded=int(sum(values("vehicles_demanded"))),
        left=int(sum(values("vehicles_left"))),
        on_preferred_lane=int(sum(values("vehicles_on_preferred_lane"))),
        travel_s=_mean(times_s),
        travel_sd_s=round(float(np.std(times_s, ddof=1)), 3) if len(times_s) > 1 else None,
        travel_p95_s=_mean(values("travel_time_s_p95")),
        throughput_veh_per_lane_h=_mean(values("throughput_veh_per_lane_h")),
        overlaps=int(sum(values("safety_overlaps"))),
        emergency_brakes=int(sum(values("safety_emergency_brakes"))),
        min_gap_m=min(values("safety_min_gap_m"), default=None),
        min_headway_s=min(values("safety_min_headway_s"), default=None),
        min_accel_mps2=low,
        max_accel_mps2=high,
        within_limits=within_limits(low, high, scenario),
        largest_formation=int(max(values("planning_largest_formation"), default=0)),
        planning_p95_ms=max(values("planning_solve_ms_p95"), default=None),
        traced=_traced([run for run in complete if run.has_trajectories]),
        plans=int(sum(values("planning_plans"))),
        fallbacks=int(sum(values("planning_fallbacks"))),
        planning=planning_times(complete),
    )


def planning_times(runs: Iterable[Run]) -> tuple[PlanningTimes, ...]:
    """Return the planning times of each solver, read from the events of runs.

    Raises:
        OSError, ValueError, TypeError: events cannot be read.
    """
    found: dict[str, list[float]] = {}
    for run in runs:
        for event in read_events(run.folder, *SOLVER):
            solve_ms = event.get("solve_ms")
            if event.get("role") == "coordinator" and isinstance(solve_ms, (int, float)):
                solver = str(event.get("solver") or SOLVER[event["kind"]])
                found.setdefault(solver, []).append(float(solve_ms))
    return tuple(
        PlanningTimes(
            solver,
            len(times_ms),
            *(round(one, 2) for one in np.percentile(times_ms, [50.0, 95.0, 100.0]).tolist()),
        )
        for solver, times_ms in sorted(found.items())
    )


def within_limits(low: float | None, high: float | None, scenario: Scenario) -> bool:
    """Return whether accelerations are within the limits of the vehicles.

    Args:
        low: minimum acceleration [m/s2]; None: there were no vehicles.
        high: maximum acceleration [m/s2].
        scenario: scenario of the run.
    """
    vehicle = scenario.vehicle
    return (low is None or low >= vehicle.min_accel_mps2 - LIMIT_ERROR) and (
        high is None or high <= vehicle.max_accel_mps2 + LIMIT_ERROR
    )


def _traced(runs: Sequence[Run]) -> Traced | None:
    """Return the combined figures of the trajectories of several runs."""
    found = [trace(read_tracks(run.folder), run.scenario) for run in runs]
    if not found:
        return None
    spacings = [one.lattice_least_m for one in found if one.lattice_least_m is not None]
    offs = [one.lattice_worst_off_m for one in found if one.lattice_worst_off_m is not None]
    slow = [one.slow_m for one in found if one.slow_m is not None]
    speeds = [one.slowest_mps for one in found]
    return Traced(
        runs=len(found),
        lattice_least_m=min(spacings, default=None),
        lattice_pairs=sum(one.lattice_pairs for one in found),
        lattice_worst_off_m=max(offs, default=None),
        lattice_kept=all(one.lattice_kept for one in found),
        slow_m=(min(one[0] for one in slow), max(one[1] for one in slow)) if slow else None,
        slowest_mps=min((mps for mps in speeds if mps is not None), default=None),
    )


def trace(tracks: Tracks, scenario: Scenario) -> Traced:
    """Return the figures of the trajectories of one run.

    Args:
        tracks: trajectories of the run.
        scenario: scenario of the run.
    """
    spacing = lattice_spacing(tracks, scenario)
    slow_m, slowest_mps = slow_stretch(tracks, scenario)
    return Traced(
        runs=1,
        lattice_least_m=spacing.least_m,
        lattice_pairs=spacing.pairs,
        lattice_worst_off_m=spacing.worst_off_m,
        lattice_kept=spacing.keeps(scenario.formation.gap_m),
        slow_m=slow_m,
        slowest_mps=slowest_mps,
    )


def slow_stretch(
    tracks: Tracks, scenario: Scenario
) -> tuple[tuple[float, float] | None, float | None]:
    """Return the congested stretch of road (start, end) [m] and the minimum mean speed [m/s].

    Speeds are means over bins of the road, from the end of the warm-up to the last arrival.
    """
    steady = (tracks.t_s >= WARM_UP_S) & (tracks.t_s <= scenario.demand.duration_s)
    bins = max(1, round(scenario.road.length_m / SLOW_BIN_M))
    edges_m = np.linspace(0.0, scenario.road.length_m, bins + 1)
    count, _ = np.histogram(tracks.s_m[steady], edges_m)
    total, _ = np.histogram(tracks.s_m[steady], edges_m, weights=tracks.speed_mps[steady])
    driven = np.flatnonzero(count)
    if not len(driven):
        return None, None
    mean_mps = total[driven] / count[driven]
    slow = driven[mean_mps < SLOW_SHARE * scenario.formation.speed_mps]
    stretch = (float(edges_m[slow[0]]), float(edges_m[slow[-1] + 1])) if len(slow) else None
    return stretch, round(float(mean_mps.min()), 2)


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 3) if values else None
