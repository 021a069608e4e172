"""What came of a run: its summary, completed by what only the launcher knows, and its verdict."""

from __future__ import annotations

import json
import statistics
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attrs import frozen
from rich.console import Console
from rich.table import Table

from laneweave.launch.faults.failover import Failover
from laneweave.protocol.scenario.tables import COMFORT_MPS2
from laneweave.sim_bridge.recording.run_record import write_summary

FEW = 5
"""Up to this number of recovery times are listed one by one."""


@frozen
class Outcome:
    """A finished run."""

    folder: Path
    summary: dict[str, Any] | None
    """As in `summary.json`; None when the run ended before there was one."""
    problems: tuple[str, ...]
    """Why it failed; empty: it did not."""

    @property
    def exit_status(self) -> int:
        """0: done; 1: the run failed or a promise was broken."""
        return 1 if self.problems else 0


def complete_summary(
    folder: Path,
    *,
    problems: Sequence[str],
    processes: int | None = None,
    failover: Failover | None = None,
    dropped: int = 0,
    faults: dict[str, Any] | None = None,
) -> Outcome:
    """Add the launcher's knowledge to a run's summary and judge the run.

    Args:
        folder: the run's folder.
        problems: what went wrong already.
        processes: most role processes at one time, where that is known.
        failover: what faults of the leader have cost; None: there were none.
        dropped: messages that faults took away.
        faults: what was done to the run; None: nothing.
    """
    path = folder / "summary.json"
    if not path.exists():
        return Outcome(folder, None, (*problems, "the run left no summary"))
    summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    summary["runtime"]["processes"] = processes
    summary["messages"]["dropped_by_faults"] = dropped
    if faults is not None:
        summary["faults"] = faults
    if failover is not None and failover.recovery_s:
        summary["failover"]["recovery_s"] = failover.recovery_s
    if failover is not None and failover.plan_recovery_s:
        summary["failover"]["plan_recovery_s"] = failover.plan_recovery_s
    write_summary(folder, summary)
    return Outcome(folder, summary, (*problems, *_broken_promises(summary)))


def _broken_promises(summary: dict[str, Any]) -> list[str]:
    vehicles, safety = summary["vehicles"], summary["safety"]
    broken = []
    if safety["overlaps"]:
        broken.append(f"{safety['overlaps']} pairs of vehicles overlapped")
    if summary["ending"] != "complete":
        broken.append(f"the run is not complete: {summary['ending']}")
    if vehicles["left"] < vehicles["demanded"]:
        missing = vehicles["demanded"] - vehicles["left"]
        broken.append(f"{missing} of {vehicles['demanded']} vehicles did not leave the road")
    return broken


def print_outcome(outcome: Outcome, console: Console) -> None:
    """Print the table at the end of a run."""
    summary = outcome.summary
    if summary is not None:
        table = Table(title=f"laneweave run: {outcome.folder}", show_header=False)
        table.add_column()
        table.add_column(justify="right")
        for label, value in summary_rows(summary):
            table.add_row(label, value)
        console.print(table)
    for problem in outcome.problems:
        console.print(f"FAILED: {problem}", style="bold red", highlight=False)


def summary_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what a run's table says, row by row: (what, value)."""
    return [*_traffic_rows(summary), *_control_rows(summary), *_fault_rows(summary)]


def _traffic_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    vehicles, safety = summary["vehicles"], summary["safety"]
    share = vehicles["on_preferred_lane"] / vehicles["left"] if vehicles["left"] else 0.0
    volume, seed = summary["volume_veh_per_lane_h"], summary["seed"]
    gap, headway = _text(safety["min_gap_m"]), _text(safety["min_headway_s"])
    low, high = _text(safety["min_accel_mps2"]), _text(safety["max_accel_mps2"])
    return [
        ("demand", f"{volume:g} vehicles/(lane h), seed {seed}"),
        ("simulated time", f"{summary['simulated_s']:.1f} s"),
        ("vehicles left / entered", f"{vehicles['left']} / {vehicles['entered']}"),
        ("most at one time", f"{vehicles['peak']}"),
        ("on their preferred lane", f"{vehicles['on_preferred_lane']} ({share:.2%})"),
        (
            "travel time mean / p95 / max",
            _join(summary["travel_time_s"], "mean", "p95", "max", unit=" s"),
        ),
        ("ticks driven without an agent", f"{summary['tracking']['hold_law_ticks']}"),
        ("ticks of emergency braking", f"{summary['tracking']['emergency_ticks']}"),
        ("overlaps", f"{safety['overlaps']} (SUMO reports {safety['sumo_collisions']})"),
        ("least gap, least headway", f"{gap} m, {headway} s"),
        ("acceleration", f"{low} to {high} m/s2{_discomfort(safety)}"),
    ]


def _discomfort(safety: dict[str, Any]) -> str:
    """Return what is to be said of accelerations that are not comfortable; empty: nothing."""
    found = (safety["min_accel_mps2"], safety["max_accel_mps2"])
    if all(value is None or round(abs(value), 2) <= COMFORT_MPS2 for value in found):
        return ""
    return f", beyond comfort ({COMFORT_MPS2:g} m/s2)"


def _control_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    planning, tracking, runtime = summary["planning"], summary["tracking"], summary["runtime"]
    failover, largest = summary["failover"], planning["largest_formation"]
    return [
        (
            "plans, proven optimal",
            f"{planning['plans']}, {planning['optimal']}, up to {largest} vehicles",
        ),
        ("plans by solver", _by_solver(planning)),
        (
            "planning time p50 / p95 / max",
            _join(planning["solve_ms"], "p50", "p95", "max", unit=" ms"),
        ),
        (
            "tracking by OSQP / unconstrained",
            f"{tracking['osqp_solves']:,} / {tracking['unconstrained_steps']:,} ticks",
        ),
        ("tracking CPU p50 / p99", _join(tracking["solve_ms"], "p50", "p99", unit=" ms")),
        ("tick p50 / p99", _join(runtime["tick_ms"], "p50", "p99", unit=" ms")),
        (
            "real-time factor",
            f"{runtime['real_time_factor']:.2f} ({runtime['processes'] or '?'} processes)",
        ),
        (
            "leader changes",
            f"{failover['leader_changes']}{_recoveries(failover['recovery_s'])}",
        ),
    ]


def _recoveries(seconds: list[float]) -> str:
    """Return the times without a leader in brackets; median and maximum if there are many."""
    if not seconds:
        return ""
    if len(seconds) <= FEW:
        return f" ({', '.join(f'{each:.3f} s' for each in seconds)})"
    return f" (p50 {statistics.median(seconds):.3f}, max {max(seconds):.3f} s without)"


def _by_solver(planning: dict[str, Any]) -> str:
    """Return how many plans each solver made; summaries of earlier versions do not say."""
    if "by_solver" not in planning:
        return "-"
    made = [f"{solver} {plans}" for solver, plans in planning["by_solver"].items() if plans]
    return f"{', '.join(made) or '-'} ({planning['fallbacks']} fallbacks)"


def _fault_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    faults = summary.get("faults")
    if faults is None:
        return []
    verbs = Counter(
        verb for one in faults["injected"] for verb in ("killed", "paused") if verb in one
    )
    rows = [
        ("processes killed, paused", f"{verbs['killed']}, {verbs['paused']}"),
        ("messages lost to faults", f"{summary['messages']['dropped_by_faults']}"),
    ]
    methods = faults["partition_methods"]
    if methods:
        how = ", ".join(dict.fromkeys(methods.values()))
        why = faults.get("why_no_namespaces")
        rows.append(("partitions made with", f"{how} ({why})" if why else how))
    return rows


def _join(values: dict[str, Any], *names: str, unit: str) -> str:
    return " / ".join(_text(values[name]) for name in names) + unit


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
