"""Distributions of spacing, headway, deceleration and comfort over runs: histograms and figures.

The samples are from steady traffic, between the end of the warm-up (`trips.py: WARM_UP_S`) and the
end of the demand, or from the whole run if that period is too short.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from attrs import field, frozen

from laneweave.launch.recordings.trajectories import JUMP_MPS, Bools, Floats, Tracks
from laneweave.launch.report.style import (
    REFERENCE,
    SMALL_TEXT,
    explain_empty_axes,
    label_colours,
    label_dashes,
    label_widths,
    legend_above,
    picture,
    spread_evenly,
    volume_title,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.recording.trips import WARM_UP_S

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SAMPLE_S: Final = 1.0
"""Sampling period of spacings, which change slowly."""
MIN_STEADY_S: Final = 10.0
"""Minimum duration of steady traffic for enough samples."""
STANDING_MPS: Final = 0.5
"""Speed below which a vehicle has no time headway."""


@frozen(eq=False)
class Quantity:
    """A quantity with its histogram bins and the way in which it is shown."""

    name: str
    unit: str
    edges: Floats
    """Edges of the bins; the last bin also contains all larger values."""
    exceedance: bool
    """Whether to show the share of driving time with larger values; otherwise the share of vehicles
    with smaller values is shown."""


def _centred(step: float, last: float) -> Floats:
    """Return edges of bins whose centres are multiples of a step."""
    return np.asarray(np.arange(-0.5, last / step + 1.0) * step, dtype=np.float64)


SPACING: Final = Quantity("spacing", "m", _centred(0.5, 90.0), exceedance=False)
"""Distance between the front bumpers of successive vehicles in a lane."""
HEADWAY: Final = Quantity("time headway", "s", _centred(0.05, 6.0), exceedance=False)
"""Spacing divided by the speed of the following vehicle."""
DECELERATION: Final = Quantity("deceleration", "m/s²", np.linspace(0.0, 10.0, 201), exceedance=True)
JERK: Final = Quantity("jerk", "m/s³", np.linspace(0.0, 20.0, 201), exceedance=True)
"""Difference quotient of the longitudinal acceleration."""
LATERAL: Final = Quantity(
    "lateral acceleration", "m/s²", np.linspace(0.0, 5.0, 201), exceedance=True
)
"""Second difference quotient of the lateral position, without instantaneous lane changes."""


@frozen
class Counts:
    """A histogram for each quantity."""

    of: dict[str, Floats] = field(factory=dict)

    def __add__(self, other: Counts) -> Counts:
        """Return the sum of both histograms of each quantity."""
        names = dict.fromkeys([*self.of, *other.of])
        return Counts(
            {name: np.asarray(self.of.get(name, 0.0) + other.of.get(name, 0.0)) for name in names}
        )

    def cumulative(self, quantity: Quantity) -> Floats:
        """Return the share of values below each edge except the first and the last."""
        counts = self.of[quantity.name]
        return np.asarray(np.cumsum(counts)[:-1] / max(1.0, counts.sum()))

    def exceedance(self, quantity: Quantity) -> Floats:
        """Return the share of values at or above each edge but the last."""
        counts = self.of[quantity.name]
        return np.asarray(np.cumsum(counts[::-1])[::-1] / max(1.0, counts.sum()))


def count(tracks: Tracks, scenario: Scenario) -> Counts:
    """Return the histograms of a run."""
    steady = _steady(tracks, scenario)
    spacing_m, headway_s = _spacings(tracks, scenario, steady)
    same = (np.diff(tracks.vehicle) == 0) & steady[1:] & steady[:-1]
    dt_s = np.where(same, np.diff(tracks.t_s), 1.0)
    jerk = np.abs(np.diff(tracks.accel_mps2) / dt_s)[same]
    lateral_mps = np.diff(tracks.y_m) / dt_s
    jumps = np.abs(lateral_mps) > JUMP_MPS
    both = same[1:] & same[:-1] & ~jumps[1:] & ~jumps[:-1]
    lateral_mps2 = np.abs(np.diff(lateral_mps) / dt_s[1:])[both]
    values = {
        SPACING: spacing_m,
        HEADWAY: headway_s,
        DECELERATION: np.maximum(0.0, -tracks.accel_mps2[steady]),
        JERK: jerk,
        LATERAL: lateral_mps2,
    }
    return Counts(
        {quantity.name: _histogram(found, quantity.edges) for quantity, found in values.items()}
    )


def _steady(tracks: Tracks, scenario: Scenario) -> Bools:
    if scenario.demand.duration_s < WARM_UP_S + MIN_STEADY_S:
        return np.ones(len(tracks.t_s), dtype=np.bool_)
    return (tracks.t_s >= WARM_UP_S) & (tracks.t_s <= scenario.demand.duration_s)


def _spacings(tracks: Tracks, scenario: Scenario, steady: Bools) -> tuple[Floats, Floats]:
    """Return spacings [m] and time headways [s] of all vehicles that follow another vehicle."""
    sample = np.rint(tracks.t_s / SAMPLE_S)
    chosen = steady & (np.abs(tracks.t_s - sample * SAMPLE_S) < 0.5 * scenario.runtime.tick_s)
    lane = np.clip(tracks.y_m // scenario.road.lane_width_m, 0, scenario.road.lanes - 1)
    sample, lane, s_m, speed_mps = (
        values[chosen] for values in (sample, lane, tracks.s_m, tracks.speed_mps)
    )
    order = np.lexsort((s_m, lane, sample))
    sample, lane, s_m, speed_mps = (values[order] for values in (sample, lane, s_m, speed_mps))
    follows = (np.diff(sample) == 0) & (np.diff(lane) == 0)
    spacing_m, behind_mps = np.diff(s_m)[follows], speed_mps[:-1][follows]
    moving = behind_mps > STANDING_MPS
    return spacing_m, spacing_m[moving] / behind_mps[moving]


def _histogram(values: Floats, edges: Floats) -> Floats:
    last = 0.5 * (edges[-2] + edges[-1])
    return np.histogram(np.clip(values, edges[0], last), edges)[0].astype(np.float64)


Counted = Mapping[tuple[str, float], Counts]
"""Histograms for each label and volume."""

MIN_SHARE = 1e-5
"""Lower limit of the exceedance scale."""
SHOWN_SHARE = 1.3
"""Upper limit of the axis, as a multiple of the limit of the quantity."""


def draw_spacings(counted: Counted, scenarios: Sequence[Scenario], out: Path, dpi: int) -> None:
    """Draw spacings and time headways: a row per quantity, a column per volume.

    Dashed lines show the nominal values in the scenarios.
    """
    _draw(counted, (SPACING, HEADWAY), scenarios, out, dpi)


def draw_comfort(counted: Counted, scenarios: Sequence[Scenario], out: Path, dpi: int) -> None:
    """Draw decelerations, jerks and lateral accelerations in the same layout.

    Dashed lines show the limits in the scenarios.
    """
    _draw(counted, (DECELERATION, JERK, LATERAL), scenarios, out, dpi)


def _draw(
    counted: Counted,
    quantities: Sequence[Quantity],
    scenarios: Sequence[Scenario],
    out: Path,
    dpi: int,
) -> None:
    labels = list(dict.fromkeys(label for label, _ in counted))
    volumes = spread_evenly(sorted({volume for _, volume in counted}))
    colours, dashes, widths = label_colours(labels), label_dashes(labels), label_widths(labels)
    single = len(volumes) == 1
    # With one volume, put the quantities side by side, because one column would be too tall.
    size_in = (3.2 * len(quantities), 3.0)
    if not single:
        size_in = (1.0 + 2.1 * len(volumes), 0.6 + 1.95 * len(quantities))
    with picture(*size_in, out, dpi) as figure:
        shared: Literal["none", "row"] = "none" if single else "row"
        rows, columns = (1, len(quantities)) if single else (len(quantities), len(volumes))
        panels = figure.subplots(rows, columns, sharex=shared, sharey=shared, squeeze=False)
        keys = [(quantity, volume) for quantity in quantities for volume in volumes]
        for axes, (quantity, volume) in zip(panels.flat, keys, strict=True):
            for label in labels:
                if (label, volume) in counted:
                    style = {"color": colours[label], "linestyle": dashes[label], "label": label}
                    style["linewidth"] = widths[label]
                    _draw_one(axes, counted[label, volume], quantity, style)
            _explain_missing(axes, counted, quantity, volume, labels)
            values = {_set_value(quantity, scenario) for scenario in scenarios}
            for value in sorted(values):
                axes.axvline(value, zorder=1, **REFERENCE)
            if quantity.exceedance:
                axes.set_xlim(0.0, min(1.05 * quantity.edges[-1], SHOWN_SHARE * max(values)))
            axes.set_xlabel(f"{quantity.name} ({quantity.unit})")
            if volume == volumes[0]:
                share = "time with more" if quantity.exceedance else "samples with less"
                axes.set_ylabel(f"share of {share}")
            if quantity is quantities[0] and not single:
                axes.set_title(volume_title(volume))
        if len(labels) > 1:
            legend_above(figure)


def _draw_one(axes: Axes, counts: Counts, quantity: Quantity, style: dict[str, Any]) -> None:
    if quantity.exceedance:
        axes.set_yscale("log")
        axes.set_ylim(MIN_SHARE, 1.3)
    else:
        axes.set(ylim=(0.0, 1.03), xlim=(0.0, quantity.edges[-2]))
    if not _has_values(counts, quantity):
        axes.plot([], [], **style)  # only in the legend
    elif quantity.exceedance:
        shares = counts.exceedance(quantity)
        axes.plot(quantity.edges[:-1][shares > 0.0], shares[shares > 0.0], **style)
    else:
        axes.plot(quantity.edges[1:-1], counts.cumulative(quantity), **style)


def _has_values(counts: Counts, quantity: Quantity) -> bool:
    """Return whether a curve can be drawn; an exceedance needs values above the first bin."""
    first = 1 if quantity.exceedance else 0
    return bool(counts.of[quantity.name][first:].any())


def _explain_missing(
    axes: Axes, counted: Counted, quantity: Quantity, volume: float, labels: Sequence[str]
) -> None:
    """Write the labels without a curve into a panel, with the reason."""
    recorded = [label for label in labels if (label, volume) in counted]
    missing = [one for one in recorded if not _has_values(counted[one, volume], quantity)]
    why = "no values above 0" if quantity.exceedance else "no vehicle follows another"
    if not recorded:
        explain_empty_axes(axes, "no trajectories")
    elif len(missing) == len(recorded):
        explain_empty_axes(axes, why)
    elif missing:
        text = f"{why}:\n" + "\n".join(missing)
        place: dict[str, Any] = {"xycoords": "axes fraction", "ha": "right", "va": "top"}
        place["bbox"] = {"fc": "white", "ec": "none", "pad": 1.0}  # keeps it legible on lines
        axes.annotate(text, (0.97, 0.97), **place, **SMALL_TEXT)


def _set_value(quantity: Quantity, scenario: Scenario) -> float:
    """Return the upper limit of a quantity, or its nominal value in formations."""
    vehicle, formation = scenario.vehicle, scenario.formation
    return {
        SPACING.name: formation.gap_m,
        HEADWAY.name: formation.gap_m / formation.speed_mps,
        DECELERATION.name: -vehicle.min_accel_mps2,
        JERK.name: vehicle.max_jerk_mps3,
        LATERAL.name: vehicle.max_lateral_accel_mps2,
    }[quantity.name]
