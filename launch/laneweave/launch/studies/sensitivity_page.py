"""The page of a sensitivity study: a tornado chart and a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from laneweave.launch.report.page import Picture, Section, write_page
from laneweave.launch.report.style import REFERENCE, SMALL_TEXT, fitted_legend, picture
from laneweave.launch.report.tables import Table
from laneweave.launch.studies.sensitivity import BASE, Factor, Result

CHART_FILE: Final = "tornado.png"
PAGE_FILE: Final = "sensitivity.html"
DPI: Final = 150
_LOW, _HIGH = "#56b4e9", "#d55e00"
HEADINGS: Final = (
    "factor", "value", "delay (s)", "arrived (%)", "smallest TTC (s)", "smallest gap (m)",
    "CO2, petrol (g/km)", "overlaps", "not left", "runs",
)  # fmt: skip


def draw_tornado(factors: Sequence[Factor], results: Mapping[str, Result], out: Path) -> None:
    """Draw bars for each factor, from the mean delay of the base to those at its ends.

    The ends have a bar each, one above the other, with a line from the smallest to the largest
    delay of a seed. Levels with which no run finished have no bar. Without travel times of the
    base, the chart is empty.
    """
    base_s = results[BASE].delay_s
    with picture(7.0, 1.5 + 0.42 * len(factors), out, DPI) as figure:
        axes = figure.add_subplot()
        rows = range(len(factors))
        for row, factor in zip(reversed(rows), factors, strict=True):
            for level, place, colour in ((factor.low, 0.2, _LOW), (factor.high, -0.2, _HIGH)):
                if level is None or base_s is None:
                    continue
                text, delay_s = level.text, results[level.label].delay_s
                if delay_s is None:
                    text, delay_s = f"{text}: no run finished", base_s
                right, delays_s = delay_s >= base_s, results[level.label].delays_s
                axes.barh(row + place, delay_s - base_s, left=base_s, height=0.36, color=colour)
                end_s = delay_s
                if len(delays_s) > 1:
                    axes.hlines(row + place, min(delays_s), max(delays_s), color="black", lw=0.8)
                    end_s = max(delays_s) if right else min(delays_s)
                axes.annotate(
                    text,
                    (end_s, row + place),
                    xytext=(3 if right else -3, 0),
                    textcoords="offset points",
                    ha="left" if right else "right",
                    va="center",
                    **SMALL_TEXT,
                )
        if base_s is not None:
            axes.axvline(base_s, **REFERENCE)
            axes.set_xlabel(f"mean delay (s); dashed: base, {base_s:z.2f} s")
        axes.set_yticks(rows, [factor.name for factor in reversed(factors)])
        axes.margins(x=0.35)
        axes.grid(visible=False, axis="y")
        names = (("low end", _LOW), ("high end", _HIGH))
        handles = [axes.barh(0, 0, color=colour, label=name) for name, colour in names]
        fitted_legend(figure, handles)


def results_table(factors: Sequence[Factor], results: Mapping[str, Result]) -> Table:
    """Return the results of the base and of all levels."""
    rows = [result_row(BASE, "", results[BASE])]
    for factor in factors:
        rows += [result_row(factor.name, one.text, results[one.label]) for one in factor.levels]
    return Table(HEADINGS, rows, "Means and extremes over the seeds", text_columns=2)


def result_row(name: str, text: str, result: Result) -> tuple[str, ...]:
    """Return the cells below `HEADINGS` for the base or for a level of a factor."""
    return (
        name,
        text,
        _shown(result.delay_s, 2),
        _shown(result.arrived_percent, 2),
        _shown(result.min_ttc_s, 2),
        _shown(result.min_gap_m, 1),
        _shown(result.co2_g_per_km, 1),
        f"{result.overlaps}",
        f"{result.not_left}",
        f"{result.runs}, {result.failed} failed" if result.failed else f"{result.runs}",
    )


def _shown(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:z.{decimals}f}"


def write_sensitivity(
    folder: Path, lead: str, factors: Sequence[Factor], results: Mapping[str, Result]
) -> Path:
    """Draw the chart, write the page, and return its path."""
    chart = folder / CHART_FILE
    draw_tornado(factors, results, chart)
    refused = [reason for factor in factors for reason in factor.refused]
    caption = (
        "Mean delay with one setting changed at a time; lines: range over the seeds. Delay: mean "
        "excess over the time at v_F, the speed of the lattice, from the entrance to the "
        "destination, in runs in which all vehicles left; T_F: time of a step; S3: the "
        "part of the road in which vehicles change lanes; N: maximum number of vehicles of a "
        "formation."
    )
    section = Section(
        "Sensitivity",
        tables=[results_table(factors, results)],
        pictures=[Picture(chart, DPI, caption, "Bars from the delay of the base to the others")],
        note=f"Impossible on this road: {'; '.join(refused)}." if refused else "",
    )
    return write_page("laneweave: sensitivity", lead, [section], folder, PAGE_FILE)
