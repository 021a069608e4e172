"""Style of the figures in reports: colours of labels, axes, legends, panels."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from laneweave.launch.drawing.figures import FAINT_INK, INK, new_figure, save
from laneweave.launch.run_methods import METHODS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PALETTE: Final = (
    "#0072b2",
    "#00436b",
    "#56b4e9",
    "#009e73",
    "#8f8500",
    "#cc79a7",
    "#d55e00",
    "#e69f00",
    "#7d3600",
    "#000000",
    "#808890",
)
"""Colours of Okabe and Ito without their yellow, which is faint on white, and darker ones."""
_OTHERS: Final = ("#e6007e", "#74b800", "#6a1fd0", "#c00020", "#00a8b5")
"""Colours of labels without a colour of their own, such as plug-ins."""
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h")
_DASHES: Final = ("-", "--", "-.", (0, (1, 1.2)), (0, (6, 1.5, 1, 1.5, 1, 1.5)))
_STYLE: Final[Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#b6bbc2",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "grid.color": "#e4e6e9",
    "grid.linewidth": 0.7,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "text.color": INK,
    "xtick.color": INK,
    "xtick.labelsize": 8,
    "xtick.major.size": 3,
    "ytick.color": INK,
    "ytick.labelsize": 8,
    "ytick.major.size": 3,
    # Text in vector graphics: TrueType fonts in PDF, which journals ask for; paths in SVG.
    "pdf.fonttype": 42,
    "svg.hashsalt": "laneweave",
}
REFERENCE: Final[dict[str, Any]] = {"color": "#8a9099", "linewidth": 1.0, "linestyle": "--"}
"""Style of lines for limits and nominal values."""
SEPARATOR: Final[dict[str, Any]] = {"color": "#d8dbe0", "linewidth": 1.0, "zorder": 0}
"""Style of lines between groups."""
SMALL_TEXT: Final[dict[str, Any]] = {"fontsize": 7.5, "color": FAINT_INK}
"""Style of small text."""
MAX_COLUMNS: Final = 6
"""Maximum number of volumes side by side."""
MAX_ENTRIES: Final = 7
"""Maximum number of entries in a row of a legend."""


@contextlib.contextmanager
def picture(width_in: float, height_in: float, out: Path, dpi: float) -> Iterator[Figure]:
    """Yield an empty figure in the style of reports, and save it when the context exits."""
    import matplotlib as mpl  # noqa: PLC0415 - lazily

    with mpl.rc_context(_STYLE):
        figure = new_figure(width_in, height_in)
        yield figure
        save(figure, out, dpi)


def label_colours(labels: Iterable[str]) -> dict[str, str]:
    """Return a colour for each label; the first ones in `METHODS` always have the same colours.

    Other labels get colours of their own, then unused ones, which repeat if there are too few.
    """
    colours = dict(zip(METHODS, _PALETTE, strict=False))
    chosen = {label: colours[label] for label in labels if label in colours}
    unused = (colour for colour in reversed(_PALETTE) if colour not in chosen.values())
    free = [*_OTHERS, *unused]
    others = [label for label in dict.fromkeys(labels) if label not in chosen]
    others.sort(key=lambda label: label in METHODS)
    return chosen | {label: free[number % len(free)] for number, label in enumerate(others)}


def label_markers(labels: Iterable[str]) -> dict[str, str]:
    """Return a marker for each label; labels in `METHODS` always have the same ones."""
    known = dict.fromkeys([*METHODS, *labels])
    return {label: _MARKERS[number % len(_MARKERS)] for number, label in enumerate(known)}


def label_dashes(labels: Iterable[str]) -> dict[str, Any]:
    """Return a line style for each label, by its place among the labels."""
    return {label: _DASHES[number % len(_DASHES)] for number, label in enumerate(labels)}


def label_widths(labels: Iterable[str]) -> dict[str, float]:
    """Return a line width for each label; later lines are thinner, so that none hides another."""
    places = {label: place for place, label in enumerate(dict.fromkeys(labels))}
    step = min(0.7, 2.6 / max(1, len(places) - 1))
    return {label: 1.3 + step * (len(places) - 1 - place) for label, place in places.items()}


def spread_evenly(volumes: Sequence[float]) -> tuple[float, ...]:
    """Return at most `MAX_COLUMNS` volumes, including the first and the last."""
    if len(volumes) <= MAX_COLUMNS:
        return tuple(volumes)
    step = (len(volumes) - 1) / (MAX_COLUMNS - 1)
    return tuple(volumes[round(number * step)] for number in range(MAX_COLUMNS))


def volume_title(volume_veh_per_lane_h: float) -> str:
    """Return the title of a panel for a volume."""
    return f"{volume_veh_per_lane_h:g} veh/(lane·h)"


def legend_above(figure: Figure) -> None:
    """Draw one legend above all panels, with an entry for each label."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        entries = dict(zip(labels, handles, strict=True)) | entries
    fitted_legend(figure, list(entries.values()), labels=list(entries))


def fitted_legend(figure: Figure, handles: Sequence[Any], **style: Any) -> None:  # noqa: ANN401
    """Draw a legend above all panels, in the smallest number of rows that fit."""
    for rows in range(max(1, math.ceil(len(handles) / MAX_ENTRIES)), len(handles) + 1):
        style |= {"loc": "outside upper center", "ncols": math.ceil(len(handles) / rows)}
        legend = figure.legend(handles=handles, **({"handlelength": 2.6} | style))
        if rows == len(handles) or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def explain_empty_axes(axes: Axes, text: str) -> None:
    """Write the reason in the centre of empty axes."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", **SMALL_TEXT)
