"""The style of a report's figures: colours of labels, axes, legends."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

from laneweave.launch.drawing.figures import FAINT_INK, INK
from laneweave.launch.methods import METHODS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PALETTE: Final = (
    "#2f6fc4",
    "#12438c",
    "#7db4e6",
    "#1f9e89",
    "#e0992f",
    "#cf3f3a",
    "#8a5bb5",
    "#7a5c4d",
    "#d46fae",
    "#808890",
    "#a8a13a",
)
GRID: Final = "#e4e6e9"
MAX_COLUMNS: Final = 6
"""Volumes that fit side by side."""


def label_colours(labels: Iterable[str]) -> dict[str, str]:
    """Return the colour of each label, by its place in the table of methods.

    Other labels have unused colours, as long as there are some.
    """
    colours = dict(zip(METHODS, _PALETTE, strict=False))
    chosen = {label: colours[label] for label in labels if label in colours}
    free = [colour for colour in reversed(_PALETTE) if colour not in chosen.values()] or ["#808890"]
    others = [label for label in dict.fromkeys(labels) if label not in chosen]
    return chosen | {label: free[number % len(free)] for number, label in enumerate(others)}


def spread_evenly(volumes: Sequence[float]) -> tuple[float, ...]:
    """Return at most `MAX_COLUMNS` volumes, the first and the last among them."""
    if len(volumes) <= MAX_COLUMNS:
        return tuple(volumes)
    step = (len(volumes) - 1) / (MAX_COLUMNS - 1)
    return tuple(volumes[round(number * step)] for number in range(MAX_COLUMNS))


def volume_title(volume_veh_per_lane_h: float) -> str:
    """Return the title of a panel for a volume."""
    return f"{volume_veh_per_lane_h:g} veh/(lane·h)"


def plain(axes: Axes, *, grid: str = "both") -> None:
    """Give axes a light grid, and hide the upper and right spines."""
    axes.grid(axis="y" if grid == "y" else "both", color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("#b6bbc2")
    axes.tick_params(colors=INK, labelsize=8, length=3)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)


def legend_above(figure: Figure, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """Put one legend above all panels."""
    figure.legend(
        handles,
        labels,
        loc="outside upper center",
        ncols=min(6, len(labels)),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
    )


def note(axes: Axes, text: str) -> None:
    """Write the reason into the middle of empty axes."""
    axes.text(
        0.5,
        0.5,
        text,
        transform=axes.transAxes,
        ha="center",
        va="center",
        fontsize=8,
        color=FAINT_INK,
    )
