"""The outcome of a run: its summary, completed by the launcher, and the reasons for failure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attrs import evolve, frozen
from rich.console import Console
from rich.table import Table

from laneweave.coordinator.planning.plug_ins.registry import PLANNERS
from laneweave.launch.faults.failover import Failover
from laneweave.launch.recordings.runs import scenario_of
from laneweave.launch.report.summary_table import summary_rows
from laneweave.launch.run_methods import REFERENCE_METHODS
from laneweave.protocol.summary import RunSummary, read_summary, write_summary


@frozen
class Outcome:
    """Result of a finished run."""

    folder: Path
    summary: RunSummary | None
    """Summary; None: the run wrote no summary."""
    problems: tuple[str, ...]
    """Reasons for failure; empty: the run succeeded."""

    @property
    def exit_status(self) -> int:
        """Exit status: 0 success; 1 the run failed or violated a guarantee."""
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
    """Complete the summary of a run with the launcher's data, and return the run's outcome.

    Args:
        folder: the run's folder.
        problems: problems known so far.
        processes: maximum number of simultaneous role processes; None: unknown.
        failover: measured recoveries from leader faults; None: no faults.
        dropped: number of messages dropped by faults.
        faults: record of the injected faults; None: no faults.
    """
    summary = read_summary(folder)
    if summary is None:
        return Outcome(folder, None, (*problems, "the run wrote no summary"))
    measured = summary.failover
    if failover is not None:
        measured = evolve(
            measured,
            recovery_s=failover.recovery_s or measured.recovery_s,
            plan_recovery_s=failover.plan_recovery_s or measured.plan_recovery_s,
        )
    summary = evolve(
        summary,
        runtime=evolve(summary.runtime, processes=processes),
        messages=evolve(summary.messages, dropped_by_faults=dropped),
        failover=measured,
        faults=faults if faults is not None else summary.faults,
        plug_ins=_plug_ins(summary) or None,
    )
    write_summary(folder, summary)
    trips = folder / "trips.parquet"
    of_sumo = trips.is_file() and bool(scenario_of(trips).sumo.config)
    return Outcome(folder, summary, (*problems, *_violations(summary, of_sumo=of_sumo)))


def _plug_ins(summary: RunSummary) -> list[str]:
    """Return the distributions whose plug-ins a run has used."""
    origins = [REFERENCE_METHODS.origin(summary.method)]
    planners = summary.planning.by_solver or {}
    origins += [PLANNERS.origin(name) for name, plans in planners.items() if plans]
    return sorted({origin for origin in origins if origin})


def _violations(summary: RunSummary, *, of_sumo: bool) -> list[str]:
    """Return which guarantees a run has violated.

    Args:
        summary: summary of the run.
        of_sumo: whether vehicles come from a SUMO simulation. Then a complete run may leave some
            outside: SUMO drives them elsewhere, or their exits are full.
    """
    vehicles, safety = summary.vehicles, summary.safety
    found = []
    if safety.overlaps:
        found.append(f"{safety.overlaps} pairs of vehicles overlapped")
    complete = summary.ending == "complete"
    if not complete:
        found.append(f"the run is not complete: {summary.ending}")
    expected = vehicles.entered if complete and of_sumo else vehicles.demanded
    if vehicles.left < expected:
        missing = expected - vehicles.left
        found.append(f"{missing} of {vehicles.demanded} vehicles did not leave the road")
    return found


def print_outcome(outcome: Outcome, console: Console) -> None:
    """Print the results and the problems of a run."""
    summary = outcome.summary
    if summary is not None:
        table = Table(title=f"laneweave run: {outcome.folder}", show_header=False)
        table.add_column()
        table.add_column(justify="right")
        trips = outcome.folder / "trips.parquet"
        preferences = not trips.is_file() or bool(scenario_of(trips).lane_shares)
        for label, value in summary_rows(summary, preferences=preferences):
            table.add_row(label, value)
        console.print(table)
    for problem in outcome.problems:
        console.print(f"FAILED: {problem}", style="bold red", highlight=False)
