"""Simulation of a plan on the road with the vehicles' controllers, and figures of it.

Step k begins at k T_F. Each vehicle follows its path with the reference and the tracker of
`agents.driving` and a simulated body (`sim_bridge.bodies.plant`), and holds its start cell at time
0. There is no noise, no other traffic and no gap control, so that the motions show exactly what the
conflict kinds of the plan allow.

The upper panels of a figure show the road in the geodetic coordinate system after each step, with
the path of each vehicle since the start. The lower panels show the positions over time: along the
road relative to the moving formation, and across it. An animation shows only the road.

This module needs matplotlib and OSQP; import it only to draw.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import attrs
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from numpy.typing import NDArray

from laneweave.agents.driving.reference import Reference
from laneweave.agents.driving.tracker import Tracker
from laneweave.agents.driving.trajectory import check_moves
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.launch.drawing.figures import DPI, FAINT_INK, INK, new_figure, save
from laneweave.launch.drawing.plan import short_name, team_colours
from laneweave.launch.drawing.road_picture import (
    ASPHALT,
    draw_body,
    draw_lanes,
    draw_position_axis,
    write_time,
)
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import cell_state, commanded_state
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, corners, pose_of
from laneweave.sim_bridge.bodies.plant import Plant

MAX_INSTANTS: Final = 8
"""Maximum number of instants at which the road is drawn."""
MAX_FRAMES: Final = 240
GIF_DPI: Final = 90
_HELD_FRAMES: Final = 8
"""Additional frames that show the start and the end."""

_WIDTH_IN, _LANE_IN, _ROAD_GAP_IN, _TIMES_IN = 11.0, 0.24, 0.24, 2.3
_MARGIN_M = 10.0
_CAPTION = (
    "; front to the right, left lane on top, lanes drawn wider than they are; colours: vehicles "
    "with the same targets"
)


@attrs.frozen(eq=False)
class Drive:
    """Motions of all vehicles from the start to the end of a plan.

    states: (vehicles, ticks + 1, 6): s [m], v [m/s], a [m/s2], y [m], v_y [m/s], a_y [m/s2] on the
        road; s is the front bumper's position, 0 where the rear column is at time 0; y is the
        body centre's distance from the right road edge.
    slot_ticks: ticks per step.
    overlaps: first tick at which the bodies of a pair of vehicles overlapped, for each such pair.
    min_gap_m: shortest gap between bodies in the same lane; infinite: there was no gap.
    """

    scenario: Scenario
    states: NDArray[np.float64]
    slot_ticks: int
    overlaps: dict[tuple[str, str], int]
    min_gap_m: float

    @property
    def ticks(self) -> int:
        """Duration [ticks]."""
        return int(self.states.shape[1]) - 1

    @property
    def steps(self) -> int:
        """Number of steps in the plan."""
        return self.ticks // self.slot_ticks

    def time_s(self, tick: int) -> float:
        """Return the time at a tick."""
        return tick * self.scenario.runtime.tick_s


def scenario_in_mode(scenario: Scenario, mode: int) -> Scenario:
    """Return the scenario in a relative motion mode.

    Raises:
        BadInputError: a move of this mode cannot be driven within the vehicles' limits.
    """
    scenario = attrs.evolve(scenario, formation=attrs.evolve(scenario.formation, mode=mode))
    check_moves(scenario)
    return scenario


def drive_plan(scenario: Scenario, names: Sequence[str], paths: Sequence[Sequence[Cell]]) -> Drive:
    """Simulate a plan.

    Args:
        scenario: v_F, d_F, T_F, lane width, vehicles and tracking; see `scenario_in_mode`.
        names: names of the vehicles.
        paths: cells of each vehicle at all time points; with one time point, all vehicles hold.
    """
    slot_ticks = round(scenario.timing.cycles_s[0] / scenario.runtime.tick_s)
    ticks = slot_ticks * (len(paths[0]) - 1)
    states = np.array([_drive_vehicle(scenario, path, slot_ticks, ticks) for path in paths])
    overlaps: dict[tuple[str, str], int] = {}
    min_gap_m = np.inf
    size_m = scenario.vehicle.length_m, scenario.vehicle.width_m
    for tick, now in enumerate(states.swapaxes(0, 1)):
        poses = {name: pose_of(state) for name, state in zip(names, now.tolist(), strict=True)}
        bodies = Bodies(poses, *size_m)
        overlaps = dict.fromkeys(bodies.overlapping_pairs(), tick) | overlaps
        min_gap_m = min(min_gap_m, bodies.min_gaps().gap_m)
    return Drive(scenario, states, slot_ticks, dict(sorted(overlaps.items())), float(min_gap_m))


def _drive_vehicle(
    scenario: Scenario, path: Sequence[Cell], slot_ticks: int, ticks: int
) -> NDArray[np.float64]:
    """Simulate one vehicle; return its states (ticks + 1, 6)."""
    own = scenario, scenario.vehicle
    reference, tracker = Reference.hold(*own, path[0]), Tracker(*own)
    start = cell_state(scenario.lattice, path[0], 0.0)
    plant = Plant(start, scenario.vehicle, scenario.runtime.tick_s)
    states, speed_mps = [start], scenario.formation.speed_mps
    for tick in range(ticks):
        step, since = divmod(tick, slot_ticks)
        if since == 0 and path[step] != path[step + 1]:
            reference = Reference.move(*own, path[step], path[step + 1], tick)
        state = commanded_state(plant.state, plant.setpoint, scenario.vehicle, speed_mps)
        jerk_s, jerk_y = tracker.solve(state, reference.window(tick)).jerk[0].tolist()
        states.append(plant.step(jerk_s, jerk_y))
    return np.array(states)


def draw_road(request: PlanRequest, response: PlanResponse, scenario: Scenario, out: Path) -> None:
    """Simulate a plan and draw a figure or an animation, depending on the suffix of `out`.

    Without a plan, the start is drawn. `scenario` defines the road, speeds and vehicles.
    """
    picture = _Picture.of(request, response, scenario)
    if out.suffix.lower() == ".gif":
        _write_gif(picture, out)
    else:
        save(road_figure(picture), out, DPI)


@attrs.frozen(eq=False)
class _Picture:
    """The simulated plan, with labels and colours of the vehicles."""

    drive: Drive
    labels: list[str]
    colours: list[str]
    lanes: int
    title: str

    @classmethod
    def of(cls, request: PlanRequest, response: PlanResponse, scenario: Scenario) -> _Picture:
        names = [vehicle.id for vehicle in request.vehicles]
        paths = response.paths or tuple((vehicle.cell,) for vehicle in request.vehicles)
        drive = drive_plan(scenario, names, paths)
        colours = team_colours(request)
        return cls(
            drive,
            [short_name(name) for name in names],
            [colours[choice] for choice in request.choices()],
            request.grid.lanes,
            _title(response, drive),
        )

    @property
    def extent_m(self) -> tuple[float, float]:
        """Start and end [m] of the stretch of road that is drawn."""
        along_m = self.drive.states[:, :, 0]
        length_m = self.drive.scenario.vehicle.length_m
        return float(along_m.min()) - length_m - _MARGIN_M, float(along_m.max()) + _MARGIN_M


def road_figure(picture: _Picture) -> Figure:
    """Return a figure of the road at successive instants and of positions over time."""
    drive, steps = picture.drive, picture.drive.steps
    count = min(steps, MAX_INSTANTS - 1) + 1
    instants = {
        round(number * steps / max(1, count - 1)) * drive.slot_ticks for number in range(count)
    }
    if count < MAX_INSTANTS:
        instants |= set(list(drive.overlaps.values())[: MAX_INSTANTS - count])
    count = len(instants)
    road_in = picture.lanes * _LANE_IN
    figure = new_figure(_WIDTH_IN, 0.9 + count * (road_in + _ROAD_GAP_IN) + 0.4 + _TIMES_IN)
    figure.suptitle(picture.title, fontsize=10, color=INK)
    heights_in = [count * (road_in + _ROAD_GAP_IN) + 0.4, _TIMES_IN]
    roads, times = figure.subfigures(2, 1, squeeze=False, height_ratios=heights_in)[:, 0]
    panels = list(roads.subplots(count, sharex=True, squeeze=False)[:, 0])
    for axes, tick in zip(panels, sorted(instants), strict=True):
        _draw_road(axes, picture)
        _draw_instant(axes, picture, tick)
    draw_position_axis(panels[-1], _CAPTION)
    along, across = times.subplots(1, 2)
    moved_m = drive.scenario.formation.speed_mps * drive.time_s(1) * np.arange(drive.ticks + 1)
    _draw_over_time(along, picture, drive.states[:, :, 0] - moved_m, "s $-$ v$_F$ t (m)")
    _draw_over_time(across, picture, drive.states[:, :, 3], "lateral position y (m)")
    for lane in range(picture.lanes + 1):
        border_m = lane * drive.scenario.road.lane_width_m
        across.axhline(border_m, color=FAINT_INK, linewidth=0.5, dashes=(5, 5))
    across.set_xlabel(f"{across.get_xlabel()}; dashed: lane borders")
    return figure


def _draw_instant(axes: Axes, picture: _Picture, tick: int) -> None:
    """Draw the vehicles at a tick, with each vehicle's path since the start."""
    write_time(axes, f"{picture.drive.time_s(tick):.1f} s")
    for number, colour in enumerate(picture.colours):
        along_m, _, _, across_m, _, _ = picture.drive.states[number, : tick + 1].T
        axes.plot(along_m, across_m, color=colour, linewidth=1.0, alpha=0.55, zorder=2)
        _Body.draw(axes, picture, number).move(picture.drive, number, tick)


def _draw_road(axes: Axes, picture: _Picture) -> None:
    """Draw the lanes of the stretch that is driven."""
    lane_width_m = picture.drive.scenario.road.lane_width_m
    draw_lanes(axes, picture.lanes, lane_width_m, picture.extent_m)


@attrs.frozen(eq=False)
class _Body:
    """A vehicle in a drawing of the road."""

    shape: Polygon
    label: Annotation

    @classmethod
    def draw(cls, axes: Axes, picture: _Picture, number: int) -> _Body:
        shape = draw_body(axes, np.zeros((4, 2)), picture.colours[number])
        label = axes.annotate(
            picture.labels[number],
            (0.0, 0.0),
            xytext=(3, 0),
            textcoords="offset points",
            fontsize=7,
            color=INK,
            va="center_baseline",
            parse_math=False,
            path_effects=[withStroke(linewidth=3.5, foreground=ASPHALT)],
            zorder=4,
        )
        return cls(shape, label)

    def move(self, drive: Drive, number: int, tick: int) -> None:
        state, vehicle = drive.states[number, tick].tolist(), drive.scenario.vehicle
        self.shape.set_xy(corners(pose_of(state), vehicle.length_m, vehicle.width_m))
        self.label.xy = (state[0], state[3])


def _draw_over_time(
    axes: Axes, picture: _Picture, values: NDArray[np.float64], meaning: str
) -> None:
    """Draw values (vehicles, ticks + 1) over time, with names at both ends of each line."""
    drive = picture.drive
    times_s = drive.scenario.runtime.tick_s * np.arange(drive.ticks + 1)
    ticks = range(0, drive.ticks + 1, drive.slot_ticks * math.ceil(max(1, drive.steps) / 10))
    axes.set_xticks([drive.time_s(tick) for tick in ticks])
    axes.grid(axis="x", color=ASPHALT, linewidth=0.8)
    axes.set_xlabel("time (s), a line for each step", fontsize=8, color=INK)
    axes.set_ylabel(meaning, fontsize=8, color=INK)
    axes.tick_params(length=2, labelsize=7, labelcolor=FAINT_INK)
    axes.spines[["top", "right"]].set_visible(False)
    for line, colour in zip(values, picture.colours, strict=True):
        axes.plot(times_s, line, color=colour, linewidth=1.6)
    axes.set_xlim(-0.02 * times_s[-1], 1.02 * times_s[-1] or 1.0)
    _label_vehicles(axes, picture.labels, times_s[0], values[:, 0].tolist(), (1, 3), "bottom")
    if len(times_s) > 1:
        _label_vehicles(axes, picture.labels, times_s[-1], values[:, -1].tolist(), (6, 0), "center")


def _label_vehicles(
    axes: Axes,
    labels: Sequence[str],
    time_s: float,
    positions: Sequence[float],
    offset_pt: tuple[float, float],
    alignment: str,
) -> None:
    """Write names beside positions; vehicles at the same position share a label."""
    names: dict[int, list[str]] = {}
    for name, position in zip(labels, positions, strict=True):
        names.setdefault(round(position), []).append(name)
    where = {round(position): position for position in positions}
    for key, together in names.items():
        axes.annotate(
            ", ".join(together),
            (time_s, where[key]),
            xytext=offset_pt,
            textcoords="offset points",
            fontsize=7,
            color=INK,
            va=alignment,
            parse_math=False,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
            annotation_clip=False,
        )


def _plain(name: str) -> str:
    """Return a name in which a dollar sign does not start a formula."""
    return name.replace("$", r"\$")


def _title(response: PlanResponse, drive: Drive) -> str:
    """Return the title, with the smallest gap between bodies."""
    formation, slot_s = drive.scenario.formation, drive.scenario.timing.cycles_s[0]
    if not response.paths:
        return f"{response.status}: the start"
    title = (
        f"{response.status}, cost {response.cost}, {response.steps} steps of {slot_s:g} s at "
        f"v$_F$ = {formation.speed_mps:g} m/s, d$_F$ = {formation.gap_m:g} m"
    )
    if drive.overlaps:
        pairs = ", ".join(
            f"{_plain(one)} and {_plain(other)} at {drive.time_s(tick):.1f} s"
            for (one, other), tick in drive.overlaps.items()
        )
        return f"{title}\nThe plan's conflict kinds allow that bodies overlap: {pairs}"
    if math.isfinite(drive.min_gap_m):
        return f"{title}; shortest gap between bodies {drive.min_gap_m:.1f} m"
    return title


def _write_gif(picture: _Picture, out: Path) -> None:
    """Write a looping animation of the road."""
    drive = picture.drive
    figure = new_figure(_WIDTH_IN, 0.8 + 1.6 * picture.lanes * _LANE_IN)
    figure.suptitle(picture.title, fontsize=9, color=INK)
    axes = figure.subplots()
    _draw_road(axes, picture)
    draw_position_axis(axes, _CAPTION)
    bodies = [_Body.draw(axes, picture, number) for number in range(len(picture.labels))]
    frame_ticks = max(1, math.ceil(drive.ticks / MAX_FRAMES))
    ticks = [*range(0, drive.ticks, frame_ticks), drive.ticks]
    writer = PillowWriter(fps=max(1, round(1.0 / (frame_ticks * drive.scenario.runtime.tick_s))))
    with writer.saving(figure, str(out), GIF_DPI):
        for tick in [0] * _HELD_FRAMES + ticks + [ticks[-1]] * _HELD_FRAMES:
            for number, body in enumerate(bodies):
                body.move(drive, number, tick)
            write_time(axes, f"{drive.time_s(tick):.1f} s")
            writer.grab_frame()
