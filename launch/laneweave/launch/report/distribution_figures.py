"""Figures of how vehicles drive: spacings and headways, decelerations and comfort."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from laneweave.launch.drawing.figures import INK, new_figure, save
from laneweave.launch.report.distributions import (
    DECELERATION,
    HEADWAY,
    JERK,
    LATERAL,
    SPACING,
    Counts,
    Quantity,
)
from laneweave.launch.report.style import (
    label_colours,
    legend_above,
    note,
    plain,
    spread_evenly,
    volume_title,
)
from laneweave.protocol.scenario.tables import Scenario

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

Counted = Mapping[tuple[str, float], Counts]
"""What was counted for a label at a volume."""

LEAST_SHARE = 1e-5
"""Lower end of the scale of exceedances."""


def draw_spacings(counted: Counted, scenario: Scenario, out: Path, dpi: int) -> None:
    """Draw spacings and time headways: quantities below each other, volumes side by side."""
    _draw(counted, (SPACING, HEADWAY), scenario, out, dpi)


def draw_comfort(counted: Counted, scenario: Scenario, out: Path, dpi: int) -> None:
    """Draw decelerations, jerks and lateral accelerations in the same way."""
    _draw(counted, (DECELERATION, JERK, LATERAL), scenario, out, dpi)


def _draw(
    counted: Counted, quantities: Sequence[Quantity], scenario: Scenario, out: Path, dpi: int
) -> None:
    labels = list(dict.fromkeys(label for label, _ in counted))
    volumes = spread_evenly(sorted({volume for _, volume in counted}))
    colours = label_colours(labels)
    if len(volumes) == 1:
        # Quantities side by side: a single column of panels would be a tower.
        figure = new_figure(3.2 * len(quantities), 3.0)
        panels = figure.subplots(1, len(quantities), squeeze=False).T
    else:
        figure = new_figure(1.0 + 2.1 * len(volumes), 0.6 + 1.95 * len(quantities))
        panels = figure.subplots(
            len(quantities), len(volumes), sharex="row", sharey="row", squeeze=False
        )
    for row, quantity in enumerate(quantities):
        for column, volume in enumerate(volumes):
            axes = panels[row, column]
            for label in labels:
                if (label, volume) in counted:
                    _draw_one(axes, counted[label, volume], quantity, label, colours[label])
            if not axes.lines:
                note(axes, "no trajectories")
            _draw_limits(axes, quantity, scenario)
            plain(axes)
            axes.set_xlabel(f"{quantity.name} ({quantity.unit})", fontsize=8.5, color=INK)
            if column == 0 or len(volumes) == 1:
                axes.set_ylabel(_axis_label(quantity), fontsize=8.5, color=INK)
            if row == 0 and len(volumes) > 1:
                axes.set_title(volume_title(volume), fontsize=9, color=INK)
    if len(labels) > 1:
        handles: dict[str, Artist] = {}
        for axes in panels.flat:
            drawn, names = axes.get_legend_handles_labels()
            handles |= dict(zip(names, drawn, strict=True))
        legend_above(figure, [handles[label] for label in labels], labels)
    save(figure, out, dpi)


def _draw_one(axes: Axes, counts: Counts, quantity: Quantity, label: str, colour: str) -> None:
    if quantity.exceedance:
        edges, shares = quantity.edges[:-1], counts.exceedance(quantity)
        seen = shares > 0.0
        axes.plot(edges[seen], shares[seen], color=colour, linewidth=1.4, label=label)
        axes.set_yscale("log")
        axes.set_ylim(LEAST_SHARE, 1.3)
        axes.set_xlim(0.0, quantity.edges[-1])
        return
    axes.plot(quantity.edges[1:-1], counts.cumulative(quantity), color=colour, label=label)
    axes.lines[-1].set_linewidth(1.4)
    axes.set_xlim(0.0, quantity.edges[-2])
    axes.set_ylim(0.0, 1.03)


def _draw_limits(axes: Axes, quantity: Quantity, scenario: Scenario) -> None:
    """Draw what a quantity may be at most, or what the formation wants it to be at least."""
    vehicle, formation = scenario.vehicle, scenario.formation
    place = {
        SPACING.name: formation.gap_m,
        HEADWAY.name: formation.gap_m / formation.speed_mps,
        DECELERATION.name: -vehicle.min_accel_mps2,
        JERK.name: vehicle.max_jerk_mps3,
        LATERAL.name: vehicle.max_lateral_accel_mps2,
    }[quantity.name]
    axes.axvline(place, color="#8a9099", linewidth=1.0, linestyle="--", zorder=1)


def _axis_label(quantity: Quantity) -> str:
    return "share of time with more" if quantity.exceedance else "share of vehicles with less"
