"""The tables of a report, as HTML; everything in them is escaped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from laneweave.launch.report.comparison_figures import preferred_share
from laneweave.launch.report.runs import Comparison, Run
from laneweave.launch.run.outcome import summary_rows

_Column = tuple[str, tuple[str, ...], Callable[[Iterable[float]], float], int]
"""Heading, place in summary.json, how the values of several runs become one, digits."""

_COLUMNS = (
    ("travel time mean (s)", ("travel_time_s", "mean"), 2),
    ("p95 (s)", ("travel_time_s", "p95"), 2),
    ("throughput (veh/(lane·h))", ("throughput_veh_per_lane_h",), 0),
)
_SAFETY = (
    ("least gap (m)", ("safety", "min_gap_m"), min, 2),
    ("hardest braking (m/s²)", ("safety", "min_accel_mps2"), min, 2),
    ("emergency brakes", ("safety", "emergency_brakes"), sum, 0),
    ("overlaps", ("safety", "overlaps"), sum, 0),
)
_WORK = (("real-time factor", ("runtime", "real_time_factor"), min, 1),)
_PLANNING = (
    ("largest formation", ("planning", "largest_formation"), max, 0),
    ("plans", ("planning", "plans"), sum, 0),
    ("fallbacks", ("planning", "fallbacks"), sum, 0),
    ("p50 (ms)", ("planning", "solve_ms", "p50"), max, 1),
    ("p95 (ms)", ("planning", "solve_ms", "p95"), max, 1),
    ("max (ms)", ("planning", "solve_ms", "max"), max, 1),
)


def table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], caption: str, text_columns: int = 1
) -> str:
    """Return a table; the first columns are text, the others numbers.

    Args:
        headings: of the columns.
        rows: cells as text; the first one heads its row.
        caption: what the table shows.
        text_columns: so many columns are aligned to the left.
    """
    head = "".join(
        f'<th scope="col"{_kind(number, text_columns)}>{escape(heading)}</th>'
        for number, heading in enumerate(headings)
    )
    body = []
    for first, *others in rows:
        cells = [f'<th scope="row">{escape(first)}</th>']
        for number, cell in enumerate(others, start=1):
            cells.append(f"<td{_kind(number, text_columns)}>{escape(cell)}</td>")
        body.append(f"<tr>{''.join(cells)}</tr>")
    return (
        f'<div class="scroll"><table><caption>{escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def _kind(column: int, text_columns: int) -> str:
    return ' class="text"' if column < text_columns else ""


def run_table(run: Run) -> str:
    """Return the numbers of one run."""
    rows = [("method", run.label), *summary_rows(run.summary)]
    return table(("", "value"), rows, "What came of the run (summary.json has it all).", 2)


def traffic_table(comparison: Comparison) -> str:
    """Return travel times, throughput and shares: means over seeds with standard deviations."""
    headings = ("label", "veh/(lane·h)", "runs", *(name for name, _, _ in _COLUMNS))
    rows = []
    for label, volume, runs in _groups(comparison):
        cells = [label, f"{volume:g}", str(len(runs))]
        for _, way, digits in _COLUMNS:
            cells.append(mean_and_spread([_number(run.summary, way) for run in runs], digits))
        cells.append(mean_and_spread([preferred_share(run) for run in runs], 2))
        rows.append(cells)
    caption = "Means over the seeds, ± their standard deviation."
    return table((*headings, "on the preferred lane (%)"), rows, caption)


def safety_table(comparison: Comparison) -> str:
    """Return the extremes over all seeds."""
    headings = ("label", "veh/(lane·h)", *(name for name, *_ in (*_SAFETY, *_WORK)))
    rows = []
    for label, volume, runs in _groups(comparison):
        rows.append([label, f"{volume:g}", *_extremes(runs, (*_SAFETY, *_WORK))])
    return table(headings, rows, "Extremes or sums over the seeds, not means.")


def planning_table(comparison: Comparison) -> str:
    """Return how long planning took, and which solver planned; empty without any plan."""
    headings = ("label", "veh/(lane·h)", "solvers", *(name for name, *_ in _PLANNING))
    rows = []
    for label, volume, runs in _groups(comparison):
        if not any(_number(run.summary, ("planning", "plans")) for run in runs):
            continue
        solvers: Counter[str] = Counter()
        for run in runs:
            solvers.update(run.summary["planning"].get("by_solver", {}))
        named = ", ".join(f"{name} {plans}" for name, plans in sorted(solvers.items()) if plans)
        cells = [label, f"{volume:g}", named or "-"]
        rows.append([*cells, *_extremes(runs, _PLANNING)])
    caption = "Planning: sums over the seeds, and the worst of them for sizes and times."
    return table(headings, rows, caption, 1) if rows else ""


def _extremes(runs: Sequence[Run], columns: Sequence[_Column]) -> list[str]:
    """Return cells with what columns combine over some runs."""
    cells = []
    for _, way, combine, digits in columns:
        values = [_number(run.summary, way) for run in runs]
        known = [value for value in values if value is not None]
        cells.append(f"{combine(known):.{digits}f}" if known else "-")
    return cells


def failed_table(comparison: Comparison) -> str:
    """Return the runs that failed; empty if none did."""
    rows = [
        (run.label, f"{run.volume_veh_per_lane_h:g}", str(run.scenario.seed), run.reason)
        for run in comparison.failed
    ]
    caption = "Runs that failed; no figure and no mean contains them."
    return table(("label", "veh/(lane·h)", "seed", "why"), rows, caption, 4) if rows else ""


def mean_and_spread(values: Iterable[float | None], digits: int) -> str:
    """Return `mean ± standard deviation` of the values that there are."""
    known = np.array([value for value in values if value is not None], dtype=np.float64)
    if not len(known):
        return "-"
    mean = f"{known.mean():.{digits}f}"
    return f"{mean} ± {known.std(ddof=1):.{digits}f}" if len(known) > 1 else mean


def _groups(comparison: Comparison) -> Iterable[tuple[str, float, tuple[Run, ...]]]:
    for label in comparison.labels:
        for volume in comparison.volumes:
            runs = comparison.at(label, volume)
            if runs:
                yield label, volume, runs


def _number(summary: Mapping[str, Any], way: Sequence[str]) -> float | None:
    """Return a number of a summary; None where a method has none."""
    found: Any = summary
    for key in way:
        found = found.get(key) if isinstance(found, Mapping) else None
    return float(found) if isinstance(found, (int, float)) else None
