"""The result table of a run, printed when the run ends and included in its report."""

from __future__ import annotations

import statistics
from collections import Counter

from laneweave.protocol.scenario.fields import COMFORT_MPS2
from laneweave.protocol.summary import Planning, RunSummary, Safety

NO_PREFERENCES = "no preferred lanes"
MAX_LISTED = 5
"""Maximum number of recovery times that are listed individually."""


def summary_rows(summary: RunSummary, *, preferences: bool = True) -> list[tuple[str, str]]:
    """Return the rows (figure, value) of a run's table.

    Args:
        summary: summary of the run.
        preferences: whether vehicles have preferred lanes.
    """
    return [
        *_traffic_rows(summary, preferences=preferences),
        *_control_rows(summary),
        *_fault_rows(summary),
    ]


def _traffic_rows(summary: RunSummary, *, preferences: bool) -> list[tuple[str, str]]:
    vehicles, safety, travel_s = summary.vehicles, summary.safety, summary.travel_time_s
    tracking, share = summary.tracking, (summary.preferred_percent or 0.0) / 100.0
    preferred = f"{vehicles.on_preferred_lane} ({share:.2%})" if preferences else NO_PREFERENCES
    low, high = _text(safety.min_accel_mps2), _text(safety.max_accel_mps2)
    return [
        ("demand", f"{summary.volume_veh_per_lane_h:g} vehicles/(lane h), seed {summary.seed}"),
        ("simulated time", f"{summary.simulated_s:.1f} s"),
        ("vehicles left / entered", f"{vehicles.left} / {vehicles.entered}"),
        *_outside_rows(summary),
        ("maximum at one time", f"{vehicles.peak}"),
        ("in their preferred lane", preferred),
        ("travel time mean / p95 / max", _join(travel_s.mean, travel_s.p95, travel_s.max) + " s"),
        ("ticks driven without an agent", _count(tracking.hold_law_ticks)),
        ("ticks of emergency braking", _count(tracking.emergency_ticks)),
        ("overlaps", f"{safety.overlaps} (SUMO reports {safety.sumo_collisions})"),
        (
            "smallest gap, smallest headway",
            f"{_text(safety.min_gap_m)} m, {_text(safety.min_headway_s)} s",
        ),
        ("acceleration", f"{low} to {high} m/s2{_discomfort(safety)}"),
    ]


def _outside_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the row of vehicles that a complete run has left outside; none: no row."""
    outside = summary.vehicles.demanded - summary.vehicles.entered
    if not outside or summary.ending != "complete":
        return []
    return [("never entered", f"{outside}: did not come to the corridor, or exit full")]


def _discomfort(safety: Safety) -> str:
    """Return a remark about uncomfortable accelerations; empty if there were none."""
    found = (safety.min_accel_mps2, safety.max_accel_mps2)
    if all(value is None or round(abs(value), 2) <= COMFORT_MPS2 for value in found):
        return ""
    return f", beyond comfort ({COMFORT_MPS2:g} m/s2)"


def _control_rows(summary: RunSummary) -> list[tuple[str, str]]:
    planning, tracking, runtime = summary.planning, summary.tracking, summary.runtime
    plan_ms, failover = planning.solve_ms, summary.failover
    osqp, unconstrained = _count(tracking.osqp_solves), _count(tracking.unconstrained_steps)
    return [
        (
            "plans, proven optimal",
            f"{planning.plans}, {planning.optimal}, up to {planning.largest_formation} vehicles",
        ),
        ("plans by solver", _by_solver(planning)),
        ("planning time p50 / p95 / max", _join(plan_ms.p50, plan_ms.p95, plan_ms.max) + " ms"),
        ("tracking by OSQP / unconstrained", f"{osqp} / {unconstrained} ticks"),
        ("tracking CPU p50 / p99", _join(tracking.solve_ms.p50, tracking.solve_ms.p99) + " ms"),
        ("tick p50 / p99", _join(runtime.tick_ms.p50, runtime.tick_ms.p99) + " ms"),
        (
            "real-time factor",
            f"{runtime.real_time_factor:.2f} ({runtime.processes or '?'} processes)",
        ),
        ("leader changes", f"{failover.leader_changes}{_recoveries(failover.recovery_s)}"),
    ]


def _recoveries(seconds: list[float]) -> str:
    """Return the leaderless periods in brackets or, if there are many, their statistics."""
    if not seconds:
        return ""
    if len(seconds) <= MAX_LISTED:
        return f" ({', '.join(f'{each:.3f} s' for each in seconds)})"
    return f" (p50 {statistics.median(seconds):.3f}, max {max(seconds):.3f} s without)"


def _by_solver(planning: Planning) -> str:
    """Return the number of plans by each solver; "-" for summaries from earlier versions."""
    if planning.by_solver is None:
        return "-"
    made = [f"{solver} {plans}" for solver, plans in planning.by_solver.items() if plans]
    return f"{', '.join(made) or '-'} ({planning.fallbacks} fallbacks)"


def _fault_rows(summary: RunSummary) -> list[tuple[str, str]]:
    faults = summary.faults
    if faults is None:
        return []
    verbs = Counter(
        verb for one in faults["injected"] for verb in ("killed", "paused") if verb in one
    )
    rows = [
        ("processes killed, paused", f"{verbs['killed']}, {verbs['paused']}"),
        ("messages lost to faults", f"{summary.messages.dropped_by_faults}"),
    ]
    methods = faults["partition_methods"]
    if methods:
        how = ", ".join(dict.fromkeys(methods.values()))
        why = faults.get("why_no_namespaces")
        rows.append(("partitions implemented by", f"{how} ({why})" if why else how))
    return rows


def _join(*values: float | None) -> str:
    return " / ".join(map(_text, values))


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _count(value: int | None) -> str:
    return "-" if value is None else f"{value:,}"
