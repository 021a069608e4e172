"""The outcome of a run: its summary, completed by the launcher, and the problems that failed it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attrs import evolve, frozen
from rich.console import Console
from rich.table import Table

from laneweave.launch.faults.failover import Failover
from laneweave.launch.report.summary_table import summary_rows
from laneweave.protocol.summary import RunSummary, read_summary, write_summary


@frozen
class Outcome:
    """A finished run."""

    folder: Path
    summary: RunSummary | None
    """None: the run ended before it was written."""
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
    """Add what only the launcher knows to a run's summary, and judge the run.

    Args:
        folder: the run's folder.
        problems: problems that are already known.
        processes: highest number of role processes at one time; None: not known.
        failover: measured recoveries from faults of the leader; None: there were no faults.
        dropped: messages that faults dropped.
        faults: record of the injected faults; None: none were asked for.
    """
    summary = read_summary(folder)
    if summary is None:
        return Outcome(folder, None, (*problems, "the run left no summary"))
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
    )
    write_summary(folder, summary)
    return Outcome(folder, summary, (*problems, *_broken_promises(summary)))


def _broken_promises(summary: RunSummary) -> list[str]:
    vehicles, safety = summary.vehicles, summary.safety
    broken = []
    if safety.overlaps:
        broken.append(f"{safety.overlaps} pairs of vehicles overlapped")
    if summary.ending != "complete":
        broken.append(f"the run is not complete: {summary.ending}")
    if vehicles.left < vehicles.demanded:
        missing = vehicles.demanded - vehicles.left
        broken.append(f"{missing} of {vehicles.demanded} vehicles did not leave the road")
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
