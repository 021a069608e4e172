"""Helpers that create figures, write text into them, and save them.

matplotlib is imported when the first figure is drawn, so that the command line starts fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text

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
    figure.savefig(out, dpi=dpi)


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
