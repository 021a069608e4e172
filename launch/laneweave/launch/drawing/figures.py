"""Helpers that create figures, write text into them, and save them.

matplotlib is imported when the first figure is drawn, so that the command line starts fast.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text


class FigureFormat(StrEnum):
    """Formats of the figures of reports; SVG and PDF, for papers, are vector graphics."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


DPI = 150
INK, FAINT_INK = "#30343a", "#6a7078"


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure; no display is needed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - lazily
    from matplotlib.figure import Figure  # noqa: PLC0415 - lazily

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, out: Path, dpi: float) -> None:
    """Save a figure to a file."""
    out.parent.mkdir(parents=True, exist_ok=True)
    # `savefig` would draw the figure twice: first for its layout only.
    figure.set_dpi(dpi)
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    # Without the date, equal figures are equal files.
    dated = {".svg": "Date", ".pdf": "CreationDate"}.get(out.suffix)
    figure.savefig(out, dpi=dpi, metadata={dated: None} if dated else None)


def write(
    axes: Axes,
    point: tuple[float, float],
    text: str,
    size_pt: float,
    **style: Any,  # noqa: ANN401 (properties of a text)
) -> Text:
    """Write text in which a dollar sign does not start a formula."""
    found = axes.text(*point, text, size=size_pt, color=INK, va="center", parse_math=False)
    found.set(**style)
    return found
