"""The result table of a run, printed when the run ends and included in its report.

Each row has one value; values that a run does not have get no row.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator

from laneweave.launch.run_methods import FORMATION
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.operations import ROLLING_SOLVER
from laneweave.protocol.summary import (
    HARD_BRAKE_MPS2,
    MAX_COMFORTABLE_ACCEL_MPS2,
    MAX_COMFORTABLE_JERK_MPS3,
    TTC_SHORT_S,
    Ending,
    ObstacleFigures,
    Planning,
    RunSummary,
    Safety,
)

Row = tuple[str, str]
"""Name of a figure, and its value with unit."""


def summary_rows(summary: RunSummary, scenario: Scenario | None = None) -> list[Row]:
    """Return the rows of a run's table.

    Args:
        summary: summary of the run.
        scenario: scenario of the run; None: unknown, such as of a run without trips.
    """
    preferences = scenario is None or bool(scenario.flow.lane_shares)
    rows = [*_demand_rows(summary, scenario), *_traffic_rows(summary, preferences=preferences)]
    rows += [*_safety_rows(summary.safety), *_comfort_rows(summary)]
    if summary.planning.plans or summary.tracking.solves or summary.failover.leader_changes:
        rows += [*_planning_rows(summary.planning), *_control_rows(summary)]
    return [*rows, *_runtime_rows(summary), *_fault_rows(summary)]


def _demand_rows(summary: RunSummary, scenario: Scenario | None) -> Iterator[Row]:
    yield "demand", f"{summary.volume_veh_per_lane_h:g} veh/(lane·h)"
    if scenario is not None:
        yield "arrivals during", f"{scenario.demand.duration_s:g} s"
        if summary.method == FORMATION:
            yield "operation", scenario.formation.operation
    yield "vehicles demanded", f"{summary.vehicles.demanded}"
    yield "seed", f"{summary.seed}"


def _traffic_rows(summary: RunSummary, *, preferences: bool) -> Iterator[Row]:
    vehicles, times = summary.vehicles, summary.travel_time_s
    yield "simulated time", f"{summary.simulated_s:.1f} s"
    yield "vehicles entered", f"{vehicles.entered}"
    yield "vehicles left", f"{vehicles.left}"
    outside = vehicles.demanded - vehicles.entered
    if summary.ending == Ending.UNFINISHED.value:
        yield "unfinished: recorded until", f"{summary.simulated_s:.1f} s"
    if outside and summary.ending == Ending.COMPLETE.value:
        yield "never entered: did not come to the corridor, or exit full", f"{outside}"
    for reason, count in sorted((vehicles.left_out or {}).items()):
        yield f"left out: vehicles that {reason}", f"{count}"
    if vehicles.missed_exits:
        yield "missed exits: vehicles that left elsewhere", f"{vehicles.missed_exits}"
    if vehicles.stopped_at_lane_end:
        yield "stopped at the end of a lane", f"{vehicles.stopped_at_lane_end} vehicles"
    for one in summary.obstacles or ():
        yield _obstacle_row(one)
    yield "most vehicles at one time", f"{vehicles.peak}"
    if preferences and summary.preferred_percent is not None:
        share = f"{summary.preferred_percent:.2f} % of {vehicles.left} vehicles"
        yield "left in their preferred lane", share
    counted = "" if times.n is None else f" ({times.n} of {vehicles.demanded} vehicles)"
    if times.n == 0:
        yield "travel time, mean", f"none{counted}"
    yield from _numbers(
        ("travel time, mean", times.mean, f" s{counted}"),
        ("travel time, 95th percentile", times.p95, " s"),
        ("travel time, maximum", times.max, " s"),
    )


def _obstacle_row(one: ObstacleFigures) -> Row:
    """Return how long a part of a lane was closed, and what it cost."""
    what = f"{one.cause} of {one.vehicle}" if one.vehicle else one.cause
    until = "the end" if one.opened_s is None else f"{one.opened_s:.1f} s"
    cost = "no vehicle stopped"
    if one.stopped:
        cost = f"{one.stopped} vehicles stopped, {one.waited_s / one.stopped:.0f} s each"
    place = f"lane {one.lane}, {one.from_m:.0f} to {one.to_m:.0f} m"
    return f"{what}, {place}", f"{one.since_s:.1f} s to {until}; {cost}"


def _safety_rows(safety: Safety) -> Iterator[Row]:
    yield "overlaps of bodies", f"{safety.overlaps}"
    yield "collisions reported by SUMO", f"{safety.sumo_collisions}"
    yield from _numbers(
        ("smallest gap", safety.min_gap_m, " m"),
        ("smallest headway", safety.min_headway_s, " s"),
        ("smallest time to collision", safety.min_ttc_s, " s"),
        ("smallest post-encroachment time", safety.min_pet_s, " s"),
        ("lowest acceleration", safety.min_accel_mps2, _accel_unit(safety.min_accel_mps2)),
        ("highest acceleration", safety.max_accel_mps2, _accel_unit(safety.max_accel_mps2)),
    )
    if safety.hard_brakes:
        yield f"braked with more than {HARD_BRAKE_MPS2:g} m/s²", f"{safety.hard_brakes} vehicles"
    yield "emergency brakes", f"{safety.emergency_brakes:,}"
    if safety.ttc_below_3_s:
        yield f"time below {TTC_SHORT_S:g} s to collision", f"{safety.ttc_below_3_s:.1f} s"
    if safety.commands_refused:
        yield "refused commands of agents", f"{safety.commands_refused:,}"


def _comfort_rows(summary: RunSummary) -> Iterator[Row]:
    if summary.comfort is not None:
        accel, jerk = f"{MAX_COMFORTABLE_ACCEL_MPS2:g} m/s²", f"{MAX_COMFORTABLE_JERK_MPS3:g} m/s³"
        yield from _numbers(
            ("acceleration, root mean square", summary.comfort.accel_rms_mps2, " m/s²"),
            ("jerk, root mean square", summary.comfort.jerk_rms_mps3, " m/s³"),
            (f"time beyond {accel} or {jerk}", summary.comfort.uncomfortable_percent, " %"),
        )
    for name, own in (summary.energy or {}).items():
        if own.electricity_wh_per_km:
            yield f"energy, {name} cars", f"{own.electricity_wh_per_km:.1f} Wh/km"
        if own.fuel_g_per_km:
            figures = f"{own.fuel_g_per_km:.1f} g/km, CO2 {own.co2_g_per_km:.1f} g/km"
            yield f"fuel, {name} cars", figures


def _accel_unit(value: float | None) -> str:
    """Return the unit of an acceleration, with a remark if it is uncomfortable."""
    if value is None or round(abs(value), 2) <= MAX_COMFORTABLE_ACCEL_MPS2:
        return " m/s²"
    return f" m/s², beyond comfort ({MAX_COMFORTABLE_ACCEL_MPS2:g} m/s²)"


def _planning_rows(planning: Planning) -> Iterator[Row]:
    """Yield the rows of plans; those of the rolling operation are never proven optimal."""
    yield "plans", f"{planning.plans}"
    if not planning.plans:
        return
    by_solver = planning.by_solver or {}
    provable = planning.plans - by_solver.get(ROLLING_SOLVER, 0)
    if provable:
        yield "plans proven optimal", f"{planning.optimal} of {provable}"
        yield "largest formation", f"{planning.largest_formation} vehicles"
    for solver, plans in by_solver.items():
        if plans:
            yield f"plans by {solver}", f"{plans}"
    if planning.fallbacks is not None and provable:
        yield "plans by a fallback", f"{planning.fallbacks}"
    yield from _numbers(
        ("planning time, median", planning.solve_ms.p50, " ms"),
        ("planning time, 95th percentile", planning.solve_ms.p95, " ms"),
        ("planning time, maximum", planning.solve_ms.max, " ms"),
    )


def _control_rows(summary: RunSummary) -> Iterator[Row]:
    tracking, failover = summary.tracking, summary.failover
    yield from _counts(
        ("ticks of emergency braking", tracking.emergency_ticks),
        ("ticks driven without an agent", tracking.hold_law_ticks),
        ("ticks tracked with OSQP", tracking.osqp_solves),
        ("ticks tracked without OSQP", tracking.unconstrained_steps),
    )
    yield from _numbers(
        ("tracking CPU time, median", tracking.solve_ms.p50, " ms"),
        ("tracking CPU time, 99th percentile", tracking.solve_ms.p99, " ms"),
    )
    yield "leader changes", f"{failover.leader_changes}"
    seconds = failover.recovery_s
    if seconds:
        number = f"{len(seconds)} time{'s' if len(seconds) > 1 else ''}"
        yield "time without leader, median", f"{statistics.median(seconds):.3f} s ({number})"
        yield "time without leader, maximum", f"{max(seconds):.3f} s"


def _runtime_rows(summary: RunSummary) -> Iterator[Row]:
    runtime = summary.runtime
    yield from _numbers(
        ("tick, median", runtime.tick_ms.p50, " ms"),
        ("tick, 99th percentile", runtime.tick_ms.p99, " ms"),
        ("real-time factor", runtime.real_time_factor, ""),
    )
    yield from _counts(("processes", runtime.processes))


def _fault_rows(summary: RunSummary) -> Iterator[Row]:
    faults = summary.faults
    if faults is None:
        return
    verbs = Counter(
        verb for one in faults["injected"] for verb in ("killed", "paused") if verb in one
    )
    yield "processes killed", f"{verbs['killed']}"
    yield "processes paused", f"{verbs['paused']}"
    yield "messages lost to faults", f"{summary.messages.dropped_by_faults:,}"
    methods = faults["partition_methods"]
    if methods:
        how = ", ".join(dict.fromkeys(methods.values()))
        why = faults.get("why_no_namespaces")
        yield "partitions implemented by", f"{how} ({why})" if why else how


def _numbers(*rows: tuple[str, float | None, str]) -> Iterator[Row]:
    """Yield the rows (name, value, unit) with a value."""
    for name, value, unit in rows:
        if value is not None:
            yield name, f"{value:.2f}{unit}"


def _counts(*rows: tuple[str, int | None]) -> Iterator[Row]:
    """Yield the rows (name, count) with a count."""
    for name, count in rows:
        if count is not None:
            yield name, f"{count:,}"
