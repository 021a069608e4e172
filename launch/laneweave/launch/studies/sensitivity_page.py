"""The page of a sensitivity study: a tornado chart and a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from laneweave.launch.report.page import Picture, Section, write_page
from laneweave.launch.report.style import REFERENCE, SMALL_TEXT, picture
from laneweave.launch.report.tables import Table
from laneweave.launch.studies.sensitivity import BASE, Factor, Level, Result

CHART_FILE: Final = "tornado.png"
DPI: Final = 150
_LOW, _HIGH = "#56b4e9", "#d55e00"
HEADINGS: Final = (
    "factor", "value", "delay (s)", "in their lanes (%)", "smallest TTC (s)", "smallest gap (m)",
    "CO2, petrol (g/km)", "overlaps", "not left", "runs",
)  # fmt: skip


def draw_tornado(
    factors: Sequence[Factor], results: Mapping[str, Result], base: Result, out: Path
) -> None:
    """Draw a bar for each factor, from the mean delay at one end to that at the other."""
    with picture(7.0, 1.1 + 0.36 * len(factors), out, DPI) as figure:
        axes = figure.add_subplot()
        base_s = base.delay_s or 0.0
        axes.axvline(base_s, **REFERENCE)
        for row, factor in enumerate(reversed(factors)):
            ends = [
                (delay_s - base_s, level.text, colour)
                for level, colour in ((factor.low, _LOW), (factor.high, _HIGH))
                if level is not None
                and (delay_s := results[level.variant.label].delay_s) is not None
            ]
            # The longer bar first, so that it does not hide another one on the same side.
            ends.sort(key=lambda end: -abs(end[0]))
            sides: set[bool] = set()
            for effect_s, text, colour in ends:
                axes.barh(row, effect_s, left=base_s, height=0.6, color=colour)
                right = (effect_s >= 0.0) if not sides else not sides.pop()
                sides.add(right)
                at_s = effect_s if (effect_s >= 0.0) == right else 0.0
                axes.annotate(
                    text,
                    (base_s + at_s, row),
                    xytext=(3 if right else -3, 0),
                    textcoords="offset points",
                    ha="left" if right else "right",
                    va="center",
                    **SMALL_TEXT,
                )
        axes.set_yticks(range(len(factors)), [factor.name for factor in reversed(factors)])
        axes.margins(x=0.35)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("mean delay (s)")


def results_table(factors: Sequence[Factor], results: Mapping[str, Result], base: Result) -> Table:
    """Return the results of the base and of all levels."""
    rows = [_row(BASE, "", base)]
    for factor in factors:
        rows += [_level_row(factor, level, results) for level in factor.levels]
    return Table(HEADINGS, rows, "Means and extremes over the seeds", text_columns=2)


def _level_row(factor: Factor, level: Level, results: Mapping[str, Result]) -> tuple[str, ...]:
    return _row(factor.name, level.text, results[level.variant.label])


def _row(name: str, text: str, result: Result) -> tuple[str, ...]:
    return (
        name,
        text,
        _shown(result.delay_s, 2),
        _shown(result.in_lane_percent, 2),
        _shown(result.min_ttc_s, 2),
        _shown(result.min_gap_m, 1),
        _shown(result.co2_g_per_km, 1),
        f"{result.overlaps}",
        f"{result.not_left}",
        f"{result.runs}",
    )


def _shown(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:z.{decimals}f}"


def write_sensitivity(
    folder: Path,
    title: str,
    lead: str,
    factors: Sequence[Factor],
    results: Mapping[str, Result],
    base: Result,
) -> Path:
    """Draw the chart, write the page, and return its path."""
    chart = folder / CHART_FILE
    draw_tornado(factors, results, base, chart)
    refused = [reason for factor in factors for reason in factor.refused]
    caption = (
        "Mean delay with one setting changed at a time; the dashed line is that of the base. "
        "Delay: mean travel time beyond that at v_F."
    )
    section = Section(
        "Sensitivity",
        tables=[results_table(factors, results, base)],
        pictures=[Picture(chart, DPI, caption, "Bars from the delay at one end to the other")],
        note="; ".join(refused) and f"Impossible on this road: {'; '.join(refused)}.",
    )
    return write_page(title, lead, [section], folder)
