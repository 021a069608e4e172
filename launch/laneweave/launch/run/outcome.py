"""The outcome of a run: its summary, completed by the launcher, and the reasons for failure."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import structlog
from attrs import evolve, frozen
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from laneweave.coordinator.planning.plug_ins.registry import PLANNERS
from laneweave.launch.faults.failover import Failover
from laneweave.launch.recordings.energy import energy_of
from laneweave.launch.recordings.files import TRIPS_FILE
from laneweave.launch.recordings.runs import scenario_of
from laneweave.launch.report.summary_table import summary_rows
from laneweave.launch.run_methods import FORMATION, REFERENCE_METHODS
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.summary import Ending, RunSummary, read_summary, write_summary
from laneweave.protocol.wire.obstacle_messages import BREAKDOWN

log = structlog.get_logger(__name__)


@frozen
class Outcome:
    """Result of a finished run."""

    folder: Path
    summary: RunSummary | None
    """Summary; None: the run wrote no summary."""
    problems: tuple[str, ...]
    """Reasons for failure; empty: the run succeeded, or was interrupted."""
    interrupted: bool = False
    """Whether a signal has ended the run."""

    def or_interrupt(self) -> Outcome:
        """Return this outcome, for callers that go on after the run.

        Raises:
            KeyboardInterrupt: a signal has ended the run.
        """
        if self.interrupted:
            raise KeyboardInterrupt
        return self

    @property
    def exit_status(self) -> int:
        """Exit status: 0 success; 1 the run failed, violated a guarantee or was interrupted."""
        return 1 if self.problems or self.interrupted else 0

    @property
    def has_traffic(self) -> bool:
        """Whether a vehicle has entered the road, so that there is something to show."""
        return self.summary is not None and self.summary.vehicles.entered > 0

    @property
    def ending(self) -> str:
        """How the run has ended, in a few words."""
        vehicles = self.summary.vehicles if self.summary is not None else None
        left = f": {vehicles.left} of {vehicles.demanded} left" if vehicles is not None else ""
        if self.problems:
            return f"run failed: {self.problems[0]}"
        return f"run {'interrupted' if self.interrupted else 'ended'}{left}"


def complete_summary(
    folder: Path,
    *,
    problems: Sequence[str],
    interrupted: bool = False,
    cut_short: bool = False,
    processes: int | None = None,
    failover: Failover | None = None,
    dropped: int = 0,
    faults: dict[str, Any] | None = None,
    breakdowns: int = 0,
) -> Outcome:
    """Complete the summary of a run with the launcher's data, and return the run's outcome.

    Args:
        folder: the run's folder.
        problems: problems known so far.
        interrupted: whether a signal has asked the run to end.
        cut_short: whether a fault has ended the run, as `problems` says; that vehicles are left on
            the road is no further problem.
        processes: maximum number of simultaneous role processes; None: unknown.
        failover: measured recoveries from leader faults; None: no faults.
        dropped: number of messages dropped by faults.
        faults: record of the injected faults; None: no faults.
        breakdowns: number of vehicles that were to break down.

    Raises:
        KeyboardInterrupt: the run was interrupted before it began.
    """
    summary = read_summary(folder)
    if summary is None:
        if interrupted:
            raise KeyboardInterrupt
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
    try:
        write_summary(folder, summary)
        if not interrupted:
            summary = _with_energy(folder, summary)
    except OSError as error:
        problems = (*problems, f"the summary cannot be written: {error.strerror or error}")
    trips = folder / TRIPS_FILE
    of_sumo = trips.is_file() and bool(scenario_of(trips).sumo.config)
    # A signal may arrive when the run is already complete.
    interrupted = interrupted and summary.ending == Ending.INTERRUPTED.value
    violations = _violations(summary, interrupted=interrupted or cut_short, of_sumo=of_sumo)
    happened = sum(one.cause == BREAKDOWN for one in summary.obstacles or ())
    if happened < breakdowns and not (interrupted or cut_short):
        text = f"breakdown: only {happened} of {breakdowns} vehicles that fit were on the road"
        problems = (*problems, text)
    return Outcome(folder, summary, (*problems, *violations), interrupted)


def _with_energy(folder: Path, summary: RunSummary) -> RunSummary:
    """Return the summary with the run's energy, and write it; without, if the models fail.

    Raises:
        OSError: the summary cannot be written.
    """
    try:
        energy = energy_of(folder)
    except (BadInputError, CommandFailedError, OSError) as error:
        log.warning("energy and emissions are not known", error=str(error))
        return summary
    completed = evolve(summary, energy=energy)
    if energy is not None:
        write_summary(folder, completed)
    return completed


def _plug_ins(summary: RunSummary) -> list[str]:
    """Return the distributions whose plug-ins a run has used."""
    origins = [REFERENCE_METHODS.origin(summary.method)]
    planners = summary.planning.by_solver or {}
    origins += [PLANNERS.origin(name) for name, plans in planners.items() if plans]
    return sorted({origin for origin in origins if origin})


def _violations(summary: RunSummary, *, interrupted: bool, of_sumo: bool) -> list[str]:
    """Return which guarantees a run has violated.

    Args:
        summary: summary of the run.
        interrupted: whether a signal or a fault has ended the run, which is then not complete.
        of_sumo: as in `RunSummary.not_left`.
    """
    vehicles, safety = summary.vehicles, summary.safety
    found = []
    if safety.overlaps:
        found.append(f"{safety.overlaps} pairs of vehicles overlapped")
    if summary.recorded_until_s is not None:
        found.append(f"the run is recorded until {summary.recorded_until_s:g} s: the disk failed")
    if interrupted:
        return found
    if summary.ending != Ending.COMPLETE.value:
        limit = " (runtime.max_road_s)" if summary.ending == Ending.LIMIT.value else ""
        found.append(f"the run is not complete: {summary.ending}{limit}")
    if missing := summary.not_left(of_sumo=of_sumo):
        found.append(f"{missing} of {vehicles.demanded} vehicles did not leave the road")
    if vehicles.missed_exits and summary.faults is None and summary.method == FORMATION:
        found.append(f"{vehicles.missed_exits} of {vehicles.left} vehicles missed their exits")
    return found


def print_outcome(outcome: Outcome, console: Console) -> None:
    """Print the results and the problems of a run; on stderr, that it was interrupted."""
    summary = outcome.summary
    if summary is not None:
        table = Table(title=f"laneweave run: {escape(str(outcome.folder))}", show_header=False)
        table.add_column()
        table.add_column(justify="right")
        trips = outcome.folder / TRIPS_FILE
        scenario = scenario_of(trips) if trips.is_file() else None
        for label, value in summary_rows(summary, scenario):
            table.add_row(label, escape(value))
        console.print(table)
    for problem in outcome.problems:
        console.print(f"FAILED: {problem}", style="bold red", highlight=False, markup=False)
    if outcome.interrupted and summary is not None:
        t_s, folder = summary.simulated_s, outcome.folder
        sys.stderr.write(f"interrupted at {t_s:.1f} s of road time; the data so far: {folder}\n")
