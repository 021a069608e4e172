"""Figures of a plan in the relative coordinate system: one panel per time point, or an animation.

This module needs matplotlib; import it only to draw.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import attrs
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.launch.drawing.colours import text_colour
from laneweave.launch.drawing.figures import DPI, FAINT_INK, INK, new_figure, save, write
from laneweave.protocol.errors import BadInputError

Position = tuple[float, float]
"""Column and lane; fractional while a vehicle moves between cells."""

SUFFIXES: Final = (".png", ".gif")
MAX_PANELS: Final = 120
"""Maximum number of time points drawn."""
FRAMES_PER_STEP: Final = 10
MAX_MOVING_FRAMES: Final = 300
"""Limit on frames, which are all in memory at once; long plans have fewer frames per step."""
FRAMES_PER_S: Final = 12
HELD_FRAMES: Final = (4, 18)
"""Additional frames that show the start and the end."""

_PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442")
"""The palette of Okabe and Ito, which is safe for colour-blind readers."""
_SHADES = ((0.0, 0.0), (0.45, 0.0), (0.5, 1.0))
"""Shades of the palette (plain, darker, lighter): fraction and brightness of added grey."""
_CELL, _BORDER, _BLOCKED = "#f1f2f4", "#d3d6db", "#a3a9b1"
_LANE_HEIGHT, _BODY_LENGTH, _BODY_WIDTH, _OUTLINE = 0.8, 0.68, 0.46, 0.9
"""In cell lengths; the outline as a fraction of a cell."""
_MAX_PANEL_COLUMNS, _MAX_WIDTH_IN, _MIN_WIDTH_IN = 4, 12.0, 5.6
_MIN_CELL_IN, _MAX_CELL_IN = 0.34, 0.62
_LEFT_IN, _BETWEEN_IN, _TITLE_IN = 0.32, 0.5, 0.64
_MAX_PIXELS, _MAX_FRAME_PIXELS, _MAX_SIDE_PIXELS = 3e7, 8e5, 3e4
_MAX_LABEL_LENGTH = 6
_CAPTION = (
    "front to the right, left lane on top; outlines are targets in the colours of their teams"
)


def check_drawing(out: Path, option: str = "--draw") -> None:
    """Check that a drawing can be written.

    Args:
        out: the file.
        option: command-line option for error messages.

    Raises:
        BadInputError: the suffix is unknown, or the file cannot be written.
    """
    if out.suffix.lower() not in SUFFIXES:
        raise BadInputError(option, str(out), "a file that ends with " + " or ".join(SUFFIXES))
    try:
        if not out.parent.is_dir():
            raise BadInputError(option, str(out), "a file in a folder that exists")
        existed = out.exists()
        with out.open("ab"):
            pass
        if not existed:
            out.unlink()
    except OSError as error:
        allowed = f"a file that can be written ({error.strerror})"
        raise BadInputError(option, str(out), allowed) from error


def draw_plan(request: PlanRequest, response: PlanResponse, out: Path) -> None:
    """Write a figure or an animation, depending on the suffix of `out`."""
    (write_gif if out.suffix.lower() == ".gif" else write_png)(request, response, out)


def write_png(request: PlanRequest, response: PlanResponse, out: Path) -> None:
    """Write a figure with one panel per time point."""
    figure = plan_figure(request, response)
    save(figure, out, _limited_dpi(figure, DPI, _MAX_PIXELS))


def write_gif(request: PlanRequest, response: PlanResponse, out: Path, dpi: int = 100) -> None:
    """Write a looping animation of the plan."""
    figure, (axes,), cell_in = _new_panels(request, response, 1)
    vehicles = _Vehicles.draw(axes, request, cell_in)
    _label_time(axes, 0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # keep the position of the panel
    writer = PillowWriter(fps=FRAMES_PER_S)
    with writer.saving(figure, str(out), _limited_dpi(figure, dpi, _MAX_FRAME_PIXELS)):
        for time in _frame_times(_steps(response)):
            vehicles.move(_positions(request, response, time))
            _label_time(axes, math.floor(time))
            writer.grab_frame()


def plan_figure(request: PlanRequest, response: PlanResponse) -> Figure:
    """Return a figure with one panel per time point and arrows for the next moves.

    Without a plan there is one panel with the start cells.
    """
    count = min(_steps(response) + 1, MAX_PANELS)
    figure, panels, cell_in = _new_panels(request, response, count)
    for time, axes in enumerate(panels):
        _label_time(axes, time)
        positions = _positions(request, response, time)
        _Vehicles.draw(axes, request, cell_in).move(positions)
        _draw_moves(axes, positions, _positions(request, response, time + 1))
    return figure


def team_colours(request: PlanRequest) -> dict[frozenset[int], str]:
    """Return a colour for each set of eligible targets."""
    teams = dict.fromkeys(request.choices())
    return {choice: _colour(number) for number, choice in enumerate(teams)}


def _new_panels(
    request: PlanRequest, response: PlanResponse, count: int
) -> tuple[Figure, list[Axes], float]:
    """Return a figure with a title, `count` lattices without vehicles, and a cell's length [in]."""
    grid = request.grid
    fitting = int(_MAX_WIDTH_IN / (grid.columns * _MIN_CELL_IN + _LEFT_IN))
    rows = math.ceil(count / max(1, min(_MAX_PANEL_COLUMNS, fitting)))
    panel_columns = math.ceil(count / rows)
    available_in = (_MAX_WIDTH_IN / panel_columns - _LEFT_IN) / grid.columns
    cell_in = max(_MIN_CELL_IN, min(_MAX_CELL_IN, available_in))
    width_in = max(_MIN_WIDTH_IN, panel_columns * (grid.columns * cell_in + _LEFT_IN))
    panel_in = grid.lanes * _LANE_HEIGHT * cell_in + _BETWEEN_IN
    figure = new_figure(width_in, rows * panel_in + _TITLE_IN)
    figure.suptitle(_title(response), fontsize=11, color=INK)
    figure.supxlabel(_CAPTION, fontsize=7, color=FAINT_INK)
    panels = list(figure.subplots(rows, panel_columns, squeeze=False).flat)
    for axes in panels[count:]:
        axes.remove()
    panels[0].set_ylabel("lane", fontsize=7, labelpad=1, color=FAINT_INK)
    panels[0].set_xlabel("column", fontsize=7, labelpad=1, color=FAINT_INK)
    for axes in panels[:count]:
        axes.set_xlim(-0.5, grid.columns - 0.5)
        axes.set_ylim(-0.5 * _LANE_HEIGHT, (grid.lanes - 0.5) * _LANE_HEIGHT)
        axes.set_aspect("equal")
        _draw_lattice(axes, request)
    return figure, panels[:count], cell_in


@attrs.frozen
class _Vehicles:
    """The movable vehicles of a panel."""

    bodies: list[FancyBboxPatch]
    labels: list[Text]

    @classmethod
    def draw(cls, axes: Axes, request: PlanRequest, cell_in: float) -> _Vehicles:
        """Draw the vehicles in their start cells, labelled with names that fit."""
        names = [short_name(vehicle.id) for vehicle in request.vehicles]
        cell_pt, longest = 72 * cell_in, max(map(len, names))
        size_pt = min(11.0, 0.3 * cell_pt, _BODY_LENGTH * cell_pt / (0.75 * longest))
        colours = team_colours(request)
        style = f"round,pad=0,rounding_size={0.3 * _BODY_WIDTH}"
        drawn = cls([], [])
        for vehicle, name, choice in zip(request.vehicles, names, request.choices(), strict=True):
            body = FancyBboxPatch((0, 0), _BODY_LENGTH, _BODY_WIDTH, boxstyle=style, zorder=3)
            body.set(fc=colours[choice], ec=INK, lw=0.6, label=vehicle.id)
            axes.add_patch(body)
            drawn.bodies.append(body)
            label = write(axes, (0, 0), name, size_pt, color=text_colour(colours[choice]), zorder=5)
            label.set(ha="center", va="center_baseline")
            drawn.labels.append(label)
        drawn.move([vehicle.cell for vehicle in request.vehicles])
        return drawn

    def move(self, positions: Sequence[Position]) -> None:
        """Move each vehicle to its position."""
        for body, label, position in zip(self.bodies, self.labels, positions, strict=True):
            x, y = _point(position)
            body.set_x(x - _BODY_LENGTH / 2)
            body.set_y(y - _BODY_WIDTH / 2)
            label.set_position((x, y))


def _steps(response: PlanResponse) -> int:
    return len(response.paths[0]) - 1 if response.paths else 0


def _positions(request: PlanRequest, response: PlanResponse, time: float) -> list[Position]:
    """Return the positions of the vehicles at a time [steps]; they are constant after the end."""
    if not response.paths:
        return [vehicle.cell for vehicle in request.vehicles]
    step = min(math.floor(time), _steps(response))
    share = time - math.floor(time)
    here = [path[step] for path in response.paths]
    next_step = min(step + 1, _steps(response))
    there = [path[next_step] for path in response.paths]
    return [
        (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]))
        for a, b in zip(here, there, strict=True)
    ]


def _frame_times(steps: int) -> Iterator[float]:
    """Yield the time [steps] of each frame; vehicles accelerate and brake smoothly."""
    if steps == 0:
        yield 0.0
        return
    count = min(steps * FRAMES_PER_STEP, MAX_MOVING_FRAMES)
    yield from [0.0] * HELD_FRAMES[0]
    for number in range(count + 1):
        whole, rest = divmod(number * steps, count)
        share = rest / count
        yield whole + share * share * (3 - 2 * share)
    yield from [float(steps)] * HELD_FRAMES[1]


def _title(response: PlanResponse) -> str:
    bound = "" if response.lower_bound is None else f", lower bound {response.lower_bound}"
    if not response.paths:
        why = "there is no plan" if response.status == "infeasible" else "no plan was found"
        return f"{response.status}: {why}{bound}"
    steps = _steps(response)
    title = f"{response.status}, cost {response.cost}{bound}, {steps} steps"
    return title if steps < MAX_PANELS else f"{title}, the first {MAX_PANELS - 1} drawn"


def _label_time(axes: Axes, steps: int) -> None:
    axes.set_title(f"step {steps}", fontsize=8, pad=3.5, color=INK)


def _draw_lattice(axes: Axes, request: PlanRequest) -> None:
    """Draw cells, blocked cells and targets."""
    grid = request.grid
    axes.set_facecolor(_CELL)
    columns = [column - 0.5 for column in range(1, grid.columns)]
    axes.vlines(columns, *axes.get_ylim(), colors=_BORDER, linewidth=0.6, zorder=1)
    lanes = [(lane - 0.5) * _LANE_HEIGHT for lane in range(1, grid.lanes)]
    axes.hlines(lanes, *axes.get_xlim(), colors=_BORDER, linewidth=0.6, zorder=1)
    tick_spacing = math.ceil(grid.columns / 20)
    axes.set_xticks(
        range(0, grid.columns, tick_spacing), labels=map(str, range(0, grid.columns, tick_spacing))
    )
    axes.set_yticks(
        [lane * _LANE_HEIGHT for lane in range(grid.lanes)], labels=map(str, range(grid.lanes))
    )
    axes.tick_params(length=0, pad=2, labelsize=6, labelcolor=FAINT_INK)
    axes.spines[:].set(color=_BLOCKED, linewidth=0.8)
    for cell in sorted(grid.blocked):
        blocked = _rectangle(cell, 1.0, facecolor="#e1e3e7", edgecolor=_BLOCKED, hatch="////")
        axes.add_patch(blocked).set(label="blocked", linewidth=0.0, zorder=1.5)
    colours = team_colours(request)
    for number, target in enumerate(request.targets):
        _draw_target(axes, target, [colours[team] for team in colours if number in team])


def _draw_target(axes: Axes, cell: Position, colours: Sequence[str]) -> None:
    """Outline a target, with alternating dashes if several teams may take it."""
    for number, colour in enumerate(colours or [_BLOCKED]):
        outline = _rectangle(cell, _OUTLINE, facecolor="none", edgecolor=colour)
        outline.set(label="target", linewidth=1.8, zorder=2, capstyle="butt")
        if len(colours) > 1:
            dash, rest = 3.0, 3.0 * (len(colours) - 1)
            outline.set_linestyle((dash * number, (dash, rest)))
        axes.add_patch(outline)


def _draw_moves(axes: Axes, here: Sequence[Position], there: Sequence[Position]) -> None:
    """Draw an arrow for each move, clear of the vehicles' names."""
    for a, b in zip(here, there, strict=True):
        if a == b:
            continue
        (x, y), (to_x, to_y) = _point(a), _point(b)
        ends = [(x + share * (to_x - x), y + share * (to_y - y)) for share in (0.34, 0.74)]
        arrow = FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=8, shrinkA=0, shrinkB=0)
        arrow.set(color=INK, linewidth=1.2, zorder=4)
        arrow.set_path_effects([withStroke(linewidth=2.6, foreground="white")])
        axes.add_patch(arrow)


def _point(position: Position) -> tuple[float, float]:
    return position[0], position[1] * _LANE_HEIGHT


def _rectangle(
    cell: Position, share: float, *, facecolor: str, edgecolor: str, hatch: str | None = None
) -> Rectangle:
    x, y = _point(cell)
    width, height = share, share * _LANE_HEIGHT
    corner = (x - width / 2, y - height / 2)
    return Rectangle(corner, width, height, facecolor=facecolor, edgecolor=edgecolor, hatch=hatch)


def short_name(name: str) -> str:
    """Shorten a long name to its end, where names usually differ."""
    plain = "".join(char if char.isprintable() else "?" for char in name)
    return plain if len(plain) <= _MAX_LABEL_LENGTH else "…" + plain[1 - _MAX_LABEL_LENGTH :]


def _colour(team: int) -> str:
    """Return one of 21 colours."""
    shade, number = divmod(team, len(_PALETTE))
    strength, grey = _SHADES[shade % len(_SHADES)]
    parts = to_rgb(_PALETTE[number])
    mixed = [(1 - strength) * part + strength * grey for part in parts]
    return to_hex((mixed[0], mixed[1], mixed[2]))


def _limited_dpi(figure: Figure, dpi: float, max_pixels: float) -> float:
    """Return a resolution that limits the number of pixels of large figures."""
    width_in, height_in = map(float, figure.get_size_inches())
    by_area = math.sqrt(max_pixels / (width_in * height_in))
    return min(dpi, by_area, _MAX_SIDE_PIXELS / max(width_in, height_in))
