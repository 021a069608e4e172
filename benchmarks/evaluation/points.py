"""Results of each run of a sweep, and of each label and volume over its seeds."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from attrs import frozen

from evaluation.intervals import Interval, interval
from evaluation.lattice_points import lattice_spacing
from laneweave.launch.recordings.events import read_events
from laneweave.launch.recordings.runs import Run
from laneweave.launch.recordings.trajectories import Tracks, read_tracks
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.protocol.wire.events import PLAN_MADE, STREAM_PLANNED
from laneweave.sim_bridge.recording.trips import WARM_UP_S

JAMMED: Final = (Ending.STANDSTILL.value, Ending.LIMIT.value)
"""Endings of runs in which vehicles did not leave."""
SLOW_BIN_M: Final = 50.0
SLOW_SHARE: Final = 0.5
"""Traffic is congested where its mean speed is below this share of v_F."""
LIMIT_ERROR: Final = 0.001
"""Rounding error of summaries."""
CO2_OF: Final = "petrol"
"""Type of car whose emissions are compared."""
SOLVER: Final = {PLAN_MADE: "branching", STREAM_PLANNED: "rolling"}
"""The solver of plans whose events do not name it, by kind of event."""
Key = tuple[str, float]
"""(label, volume in vehicles/(lane h))."""
SeedKey = tuple[str, float, int]
"""(label, volume in vehicles/(lane h), seed)."""


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
    slowest_settled_mps: float | None = None
    """The same of the road behind the place up to which vehicles settle."""


@frozen
class PlanningTimes:
    """Planning times of a solver."""

    solver: str
    plans: int
    p50_ms: float
    """Over several runs: the median of their medians."""
    p95_ms: float
    """Over several runs: the highest, like the maximum."""
    max_ms: float


@frozen
class RunRow:
    """Results of a run; None: unknown."""

    label: str
    volume_veh_per_lane_h: float
    seed: int
    reason: str
    """Why the run failed; empty: it did not."""
    complete: bool
    """Whether all vehicles have left; of other runs, only the overlaps are known."""
    jammed: bool = False
    """Whether vehicles stood still or did not leave in time; other incomplete runs have crashed."""
    demanded: int = 0
    left: int = 0
    on_preferred_lane: int = 0
    travel_s: float | None = None
    """Mean travel time from the demanded arrival."""
    travel_p95_s: float | None = None
    throughput_veh_per_lane_h: float | None = None
    overlaps: int | None = 0
    """Pairs of vehicles that overlapped; None: the run has no summary."""
    emergency_brakes: int = 0
    hard_brakes: int | None = None
    """Vehicles."""
    min_gap_m: float | None = None
    min_headway_s: float | None = None
    min_accel_mps2: float | None = None
    max_accel_mps2: float | None = None
    within_limits: bool = True
    """Whether all accelerations are within the vehicles' limits."""
    min_ttc_s: float | None = None
    ttc_below_3_s: float | None = None
    min_pet_s: float | None = None
    uncomfortable_percent: float | None = None
    co2_g_per_km: float | None = None
    plans: int = 0
    fallbacks: int = 0
    """Plans of the fallback planner."""
    planning_p95_ms: float | None = None
    planning: tuple[PlanningTimes, ...] = ()
    traced: Traced | None = None
    """Figures from trajectories; None: no trajectories were stored."""

    @property
    def key(self) -> Key:
        """Label and volume."""
        return self.label, self.volume_veh_per_lane_h


@frozen
class PointRow:
    """Results of a label at a volume over its complete runs; None: unknown."""

    label: str
    volume_veh_per_lane_h: float
    runs: tuple[RunRow, ...]
    """All runs, in the order of seeds."""

    @property
    def complete(self) -> tuple[RunRow, ...]:
        """The complete runs, in which all vehicles have left; those with overlaps are included."""
        return tuple(run for run in self.runs if run.complete)

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the complete runs."""
        return tuple(run.seed for run in self.complete)

    @property
    def unfinished(self) -> int:
        """Number of runs that are not complete."""
        return len(self.runs) - len(self.complete)

    @property
    def jammed(self) -> int:
        """Number of runs that jammed."""
        return sum(run.jammed for run in self.runs)

    @property
    def overlaps(self) -> int:
        """Pairs of bodies that overlapped, in all runs with a summary."""
        return sum(run.overlaps or 0 for run in self.runs)

    def values(self, name: str) -> list[float]:
        """Return the known values of a figure, run by run."""
        found = (getattr(run, name) for run in self.complete)
        return [float(value) for value in found if value is not None]

    def total(self, name: str) -> int:
        """Return the sum of a count over the runs."""
        return int(sum(self.values(name)))

    def mean(self, name: str) -> float | None:
        """Return the mean of a figure over the runs."""
        values = self.values(name)
        return round(float(np.mean(values)), 3) if values else None

    def lowest(self, name: str) -> float | None:
        """Return the minimum of a figure over the runs."""
        return min(self.values(name), default=None)

    def highest(self, name: str) -> float | None:
        """Return the maximum of a figure over the runs."""
        return max(self.values(name), default=None)

    def interval(self, name: str) -> Interval | None:
        """Return the confidence interval of a figure's mean; None: there are too few runs."""
        return interval(self.values(name))

    @property
    def on_lane_percent(self) -> float | None:
        """Share of vehicles that left in their preferred lane, among all that left."""
        left = self.total("left")
        return 100.0 * self.total("on_preferred_lane") / left if left else None

    @property
    def within_limits(self) -> bool:
        """Whether all accelerations are within the vehicles' limits."""
        return all(run.within_limits for run in self.complete)

    @property
    def planning(self) -> tuple[PlanningTimes, ...]:
        """Planning times of each solver."""
        found: dict[str, list[PlanningTimes]] = {}
        for run in self.complete:
            for one in run.planning:
                found.setdefault(one.solver, []).append(one)
        return tuple(
            PlanningTimes(
                solver,
                sum(one.plans for one in times),
                round(statistics.median(one.p50_ms for one in times), 2),
                max(one.p95_ms for one in times),
                max(one.max_ms for one in times),
            )
            for solver, times in sorted(found.items())
        )

    @property
    def traced(self) -> Traced | None:
        """Figures from the trajectories of all runs; None: none were stored."""
        found = [run.traced for run in self.complete if run.traced is not None]
        if not found:
            return None
        spacings = [one.lattice_least_m for one in found if one.lattice_least_m is not None]
        offs = [one.lattice_worst_off_m for one in found if one.lattice_worst_off_m is not None]
        slow = [one.slow_m for one in found if one.slow_m is not None]
        speeds = [one.slowest_mps for one in found if one.slowest_mps is not None]
        settled = [one.slowest_settled_mps for one in found if one.slowest_settled_mps is not None]
        return Traced(
            runs=len(found),
            lattice_least_m=min(spacings, default=None),
            lattice_pairs=sum(one.lattice_pairs for one in found),
            lattice_worst_off_m=max(offs, default=None),
            lattice_kept=all(one.lattice_kept for one in found),
            slow_m=(min(m for m, _ in slow), max(m for _, m in slow)) if slow else None,
            slowest_mps=min(speeds, default=None),
            slowest_settled_mps=min(settled, default=None),
        )


def points_of_runs(rows: Iterable[RunRow]) -> tuple[PointRow, ...]:
    """Return the points of runs, in the order in which they appear."""
    groups: dict[Key, list[RunRow]] = {}
    for row in rows:
        groups.setdefault(row.key, []).append(row)
    return tuple(
        PointRow(*key, tuple(sorted(group, key=lambda row: row.seed)))
        for key, group in groups.items()
    )


def run_rows(runs: Iterable[Run]) -> list[RunRow]:
    """Return the rows of runs, in the order of labels, volumes and seeds.

    Raises:
        BadInputError: runs differ in road or demand, or one occurs twice.
        OSError, ValueError, KeyError: a run's files cannot be read.
    """
    listed = sorted(runs, key=lambda run: run.order)
    check_comparable(listed)
    return [_row(run) for run in listed]


def check_comparable(runs: Sequence[Run]) -> None:
    """Check that runs are distinct and differ in method, volume and seed only.

    Raises:
        BadInputError: they differ in road or demand, or one occurs twice.
    """
    seen: set[SeedKey] = set()
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


def _row(run: Run) -> RunRow:
    label, volume, seed = run.label, run.volume_veh_per_lane_h, run.scenario.seed
    found = run.summary
    if found is None or found.ending != Ending.COMPLETE.value:
        return RunRow(
            label,
            volume,
            seed,
            run.reason,
            complete=False,
            jammed=found is not None and found.ending in JAMMED,
            overlaps=None if found is None else found.safety.overlaps,
        )
    vehicles, safety, planning = found.vehicles, found.safety, found.planning
    energy = (found.energy or {}).get(CO2_OF)
    low, high = safety.min_accel_mps2, safety.max_accel_mps2
    return RunRow(
        label,
        volume,
        seed,
        run.reason,
        complete=True,
        demanded=vehicles.demanded,
        left=vehicles.left,
        on_preferred_lane=vehicles.on_preferred_lane,
        travel_s=found.travel_time_s.mean,
        travel_p95_s=found.travel_time_s.p95,
        throughput_veh_per_lane_h=found.throughput_veh_per_lane_h,
        overlaps=safety.overlaps,
        emergency_brakes=safety.emergency_brakes,
        hard_brakes=safety.hard_brakes,
        min_gap_m=safety.min_gap_m,
        min_headway_s=safety.min_headway_s,
        min_accel_mps2=low,
        max_accel_mps2=high,
        within_limits=within_limits(low, high, run.scenario),
        min_ttc_s=safety.min_ttc_s,
        ttc_below_3_s=safety.ttc_below_3_s,
        min_pet_s=safety.min_pet_s,
        uncomfortable_percent=found.comfort.uncomfortable_percent if found.comfort else None,
        co2_g_per_km=energy.co2_g_per_km if energy else None,
        plans=planning.plans,
        fallbacks=planning.fallbacks or 0,
        planning_p95_ms=planning.solve_ms.p95,
        planning=planning_times(run),
        traced=trace(read_tracks(run.folder), run.scenario) if run.has_trajectories else None,
    )


def planning_times(run: Run) -> tuple[PlanningTimes, ...]:
    """Return the planning times of each solver, read from the events of a run.

    Raises:
        OSError, ValueError, TypeError: events cannot be read.
    """
    found: dict[str, list[float]] = {}
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


def trace(tracks: Tracks, scenario: Scenario) -> Traced:
    """Return the figures of the trajectories of one run.

    Args:
        tracks: trajectories of the run.
        scenario: scenario of the run.
    """
    spacing = lattice_spacing(tracks, scenario)
    slow_m, slowest_mps, slowest_settled_mps = slow_stretch(tracks, scenario)
    return Traced(
        runs=1,
        lattice_least_m=spacing.least_m,
        lattice_pairs=spacing.pairs,
        lattice_worst_off_m=spacing.worst_off_m,
        lattice_kept=spacing.keeps(scenario.formation.gap_m),
        slow_m=slow_m,
        slowest_mps=slowest_mps,
        slowest_settled_mps=slowest_settled_mps,
    )


def slow_stretch(
    tracks: Tracks, scenario: Scenario
) -> tuple[tuple[float, float] | None, float | None, float | None]:
    """Return where traffic is slow, and how slow; means over bins of the road.

    Counted is the time from the end of the warm-up to the last arrival.

    Returns:
        The congested stretch (start, end) [m]; the lowest mean speed of the road [m/s]; that of
        the road beyond the place up to which vehicles settle at v_F [m/s]. None: there is none.
    """
    steady = (tracks.t_s >= WARM_UP_S) & (tracks.t_s <= scenario.demand.duration_s)
    bins = max(1, round(scenario.road.length_m / SLOW_BIN_M))
    edges_m = np.linspace(0.0, scenario.road.length_m, bins + 1)
    count, _ = np.histogram(tracks.s_m[steady], edges_m)
    total, _ = np.histogram(tracks.s_m[steady], edges_m, weights=tracks.speed_mps[steady])
    driven = np.flatnonzero(count)
    if not len(driven):
        return None, None, None
    mean_mps = total[driven] / count[driven]
    slow = driven[mean_mps < SLOW_SHARE * scenario.formation.speed_mps]
    stretch = (float(edges_m[slow[0]]), float(edges_m[slow[-1] + 1])) if len(slow) else None
    settled_m = scenario.formation.speed_mps * scenario.formation.settle_s
    settled_mps = mean_mps[edges_m[driven] >= settled_m]
    slowest_settled_mps = round(float(settled_mps.min()), 2) if len(settled_mps) else None
    return stretch, round(float(mean_mps.min()), 2), slowest_settled_mps
