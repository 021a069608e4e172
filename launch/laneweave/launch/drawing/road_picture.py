"""The road in figures: lanes, bodies and times, for recorded runs and for driven plans."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from laneweave.launch.drawing.colours import CLOSED_FILL, CLOSED_HATCH, exit_in_words
from laneweave.launch.drawing.figures import INK
from laneweave.launch.drawing.road_scene import closed_parts, ramp_edges
from laneweave.protocol.scenario.fields import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Polygon
    from numpy.typing import ArrayLike

ASPHALT: Final = "#eeeff1"
_PAINT, _EDGE = "#ffffff", "#9aa0a8"
CLOSED: Final[Any] = {"fc": CLOSED_FILL, "ec": CLOSED_HATCH, "hatch": "/////", "lw": 1.0}
"""Style of closed parts of lanes."""


def draw_lanes(
    axes: Axes,
    lanes: int,
    lane_width_m: float,
    stretch_m: tuple[float, float],
    *,
    below_m: float = 0.5,
    above_m: float = 0.5,
) -> None:
    """Draw asphalt and lane markings of a stretch of road, with space below and above it."""
    width_m = lanes * lane_width_m
    axes.set_xlim(*stretch_m)
    axes.set_ylim(-below_m, width_m + above_m)
    axes.fill_between(stretch_m, 0.0, width_m, color=ASPHALT, linewidth=0.0, zorder=0)
    for border in range(lanes + 1):
        edge = border in (0, lanes)
        axes.axhline(
            border * lane_width_m,
            color=_EDGE if edge else _PAINT,
            linewidth=1.2 if edge else 1.6,
            linestyle="-" if edge else (0, (7, 6)),
            zorder=1,
        )
    axes.set_yticks([])
    axes.tick_params(axis="x", bottom=False, labelbottom=False)
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)


def draw_closed_part(
    axes: Axes, lane: int, from_m: float, to_m: float, lane_width_m: float
) -> None:
    """Draw a closed part of a lane with hatching."""
    from matplotlib.patches import Rectangle  # noqa: PLC0415 - lazily

    corner, length_m = (from_m, lane * lane_width_m), to_m - from_m
    axes.add_patch(Rectangle(corner, length_m, lane_width_m, zorder=1.5, **CLOSED))


def draw_closed_parts(axes: Axes, scenario: Scenario) -> None:
    """Draw closed parts with hatching, the stop lines before them, ramps and exits."""
    width_m = scenario.road.lane_width_m
    for part in closed_parts(scenario):
        draw_closed_part(axes, part.lane, part.from_m, part.to_m, width_m)
        if part.line_m is not None:
            lane_m = (part.lane * width_m, (part.lane + 1) * width_m)
            axes.plot([part.line_m] * 2, lane_m, color=INK, linewidth=1.6, zorder=2)
    for lane, from_m, to_m in ramp_edges(scenario):
        axes.plot([from_m, to_m], [lane * width_m] * 2, color=INK, linewidth=1.6, zorder=2)
    for one in scenario.exit:
        for lane in one.lanes:
            # Beside the road, where it hides no vehicle.
            below = lane < scenario.road.lanes / 2
            y_m = -0.4 if below else scenario.road.lanes * width_m + 0.35
            axes.text(
                one.at_m,
                y_m,
                f"{exit_in_words(one.name)} →",
                ha="right",
                va="top" if below else "bottom",
                fontsize=8,
                clip_on=True,
            )


def draw_position_axis(axes: Axes, note: str = "") -> None:
    """Label the positions below the lowest of several stretches, with a note."""
    axes.tick_params(axis="x", bottom=True, labelbottom=True, labelsize=8, length=3)
    axes.set_xlabel(f"position on the road (m){note}", fontsize=9, color=INK)


def draw_body(axes: Axes, corners_m: ArrayLike, colour: Any) -> Polygon:  # noqa: ANN401 (of matplotlib)
    """Draw the body of a vehicle with the given corners (4, 2)."""
    from matplotlib.patches import Polygon  # noqa: PLC0415 - lazily

    body = Polygon(corners_m, facecolor=colour, edgecolor=INK, linewidth=0.5, zorder=3)
    axes.add_patch(body)
    return body


def write_time(axes: Axes, text: str) -> None:
    """Write the time of a stretch to the left of it."""
    axes.set_ylabel(text, rotation=0, ha="right", va="center", fontsize=10, color=INK)
