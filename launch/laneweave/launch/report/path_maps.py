"""The relative path map (paper, Section 3.3) of a formation as it was driven, and its figure.

One row per vehicle, one column per fixed time point, T_F apart. The first one is the start of the
plan that was driven, T_F is that plan's; recordings that do not say them begin with the first move,
and have one T_F. A vehicle's cell is the one that it holds or, while it moves, the one that it
moves to: at the end of each slot that is where it is.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.parquet as pq
from attrs import frozen

from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.launch.drawing.colours import lane_colours
from laneweave.launch.drawing.figures import FAINT_INK, INK, new_figure, save
from laneweave.launch.observe.column_owners import (
    JOINED,
    PLANNED,
    FormationColumns,
    read_events,
    recorded_formations,
)
from laneweave.launch.recordings.runs import Run
from laneweave.launch.recordings.trajectories import OFF_LATTICE, Floats, Ints, Tracks
from laneweave.protocol.errors import BadInputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST_NAME = 9
_MOST_NAMED = 8


@frozen
class DrivenMap:
    """A formation's relative path map as it was driven."""

    formation: int
    rolling: bool
    """There were no formations: these vehicles entered in the columns of one block."""
    path_map: RelativePathMap
    """Columns count from the formation's rearmost one."""
    preferred_lanes: tuple[int, ...]
    """Of the vehicles, in the order of rows."""
    start_s: float
    """Road time of the first time point."""
    slot_s: float
    lanes: int

    @property
    def name(self) -> str:
        """What it is called in figures."""
        return f"{'block' if self.rolling else 'formation'} {self.formation}"

    @property
    def whose(self) -> str:
        """Whose cells it shows."""
        if self.rolling:
            return "the vehicles that entered in the columns of a block"
        return "a formation's vehicles"


def driven_map(run: Run, tracks: Tracks, formation: int | None) -> DrivenMap | None:
    """Return the path map of a formation.

    Args:
        run: the run.
        tracks: its trajectories.
        formation: number of the formation; None: the one whose vehicles move most.

    Returns:
        None if the run has no formations.

    Raises:
        BadInputError: the run has no such formation.
        OSError, ValueError, KeyError, TypeError: a file of the run cannot be read.
    """
    columns = recorded_formations(run.folder, run.scenario.lattice).by_number
    trips = pq.read_table(
        run.folder / "trips.parquet", columns=["vehicle", "preferred_lane", "formation"]
    ).to_pylist()
    numbers = {name: number for number, name in enumerate(tracks.names)}
    members: dict[int, list[tuple[int, int]]] = {}
    for trip in trips:
        if trip["formation"] is not None and trip["vehicle"] in numbers:
            member = (numbers[trip["vehicle"]], int(trip["preferred_lane"]))
            members.setdefault(int(trip["formation"]), []).append(member)
    if formation is None:
        if not members:
            return None
        moves = _moves(tracks)
        formation = max(members, key=lambda one: sum(moves[number] for number, _ in members[one]))
    if formation not in members:
        near = sorted(sorted(members, key=lambda one: abs(one - formation))[:_MOST_NAMED])
        known = ", ".join(map(str, near)) if members else "none: it has no formations"
        if len(members) > len(near):
            known += f" and {len(members) - len(near)} others"
        raise BadInputError("--formation", formation, f"a formation of {run.folder}: {known}")
    return _map_of(columns[formation], members[formation], tracks, run)


def _moves(tracks: Tracks) -> Ints:
    """Return how often each vehicle goes to another cell."""
    vehicle = tracks.vehicle
    moved = (np.diff(tracks.column) != 0) | (np.diff(tracks.lane) != 0)
    moved &= np.diff(vehicle) == 0
    return np.bincount(vehicle[1:][moved], minlength=len(tracks.names))


def _map_of(
    formation: FormationColumns, members: list[tuple[int, int]], tracks: Tracks, run: Run
) -> DrivenMap | None:
    parts = [tracks.rows(number) for number, _ in members]
    if any((tracks.column[part] == OFF_LATTICE).any() for part in parts):
        return None
    changes_s = [t_s for part in parts for t_s in _change_times(tracks, part)]
    tick_s = run.scenario.runtime.tick_s
    entered_s = max(float(tracks.t_s[part.start]) for part in parts)
    last_s = max(changes_s, default=entered_s)
    start_s, slot_s = _driven_slots(run, formation.number, entered_s, changes_s)
    steps = max(0, int(np.ceil((last_s - start_s + 0.5 * tick_s) / slot_s)))
    # Moves begin with a tick, and show their target from that tick on.
    times_s = start_s - 0.5 * tick_s + slot_s * np.arange(steps + 1, dtype=np.float64)
    rows = [
        tuple(
            (int(tracks.column[part][place]) - formation.rear, int(tracks.lane[part][place]))
            for place in _places(tracks, part, times_s)
        )
        for part in parts
    ]
    # As in the paper's table: from the front backwards, and from the right.
    order = sorted(range(len(rows)), key=lambda row: (-rows[row][0][0], rows[row][0][1]))
    return DrivenMap(
        formation.number,
        run.scenario.formation.rolling,
        RelativePathMap(
            tuple(tracks.names[members[row][0]] for row in order),
            tuple(rows[row] for row in order),
        ),
        tuple(members[row][1] for row in order),
        start_s,
        slot_s,
        run.scenario.road.lanes,
    )


def _driven_slots(
    run: Run, formation: int, entered_s: float, changes_s: list[float]
) -> tuple[float, float]:
    """Return when the slots of a formation begin (road time), and how long each is.

    They are those of the last of its plans of which a move was driven, if any was.

    Args:
        run: the run.
        formation: number of the formation.
        entered_s: when its last vehicle entered.
        changes_s: times at which its vehicles began to move to other cells.
    """
    tick_s, slot_s = run.scenario.runtime.tick_s, run.scenario.cycles_s[0]
    last_s = max(changes_s, default=math.inf) + 0.5 * tick_s
    together, found = {formation}, None
    for event in read_events(run.folder, JOINED, PLANNED):
        if event.get("role") != "coordinator":
            continue
        if event["kind"] == JOINED and formation in event["formations"]:
            together.update(event["formations"])
        if event["kind"] == PLANNED and event["formation"] in together and "t0_s" in event:
            slots = float(event["t0_s"]), float(event["slot_s"])
            found = slots if slots[0] <= last_s and slots[1] > 0.0 else found
    if found is not None:
        return found
    # The first one to move may be late already, by no more than the slack of a slot.
    slack_s = run.scenario.formation.slack_s
    return min(changes_s, default=entered_s + slack_s + tick_s) - slack_s, slot_s


def _change_times(tracks: Tracks, part: slice) -> list[float]:
    column, lane = tracks.column[part], tracks.lane[part]
    changed = (np.diff(column) != 0) | (np.diff(lane) != 0)
    return [float(t_s) for t_s in tracks.t_s[part][1:][changed]]


def _places(tracks: Tracks, part: slice, times_s: Floats) -> Ints:
    """Return the vehicle's row at each time, the nearest one before it."""
    t_s = tracks.t_s[part]
    return np.clip(np.searchsorted(t_s, times_s, side="right") - 1, 0, len(t_s) - 1)


def draw_path_map(driven: DrivenMap, out: Path, dpi: int) -> None:
    """Draw the table; cells have the colour of their lane, strong where it is the preferred one."""
    path_map = driven.path_map
    rows, points = len(path_map.rows), path_map.steps + 1
    figure = new_figure(2.3 + 1.12 * points, 0.8 + 0.36 * (rows + 1))
    axes = figure.subplots()
    axes.set_xlim(-1.3, points)
    axes.set_ylim(rows + 0.05, -1.0)
    axes.set_axis_off()
    colours = lane_colours(driven.lanes)
    for point in range(points):
        name = "start" if point == 0 else f"slot {point}"
        t_s = driven.start_s + point * driven.slot_s
        axes.text(point + 0.5, -0.62, name, ha="center", va="center", fontsize=8.5, color=INK)
        axes.text(
            point + 0.5,
            -0.25,
            f"{t_s:.1f} s",
            ha="center",
            va="center",
            fontsize=7,
            color=FAINT_INK,
        )
    for row, (name, cells) in enumerate(zip(path_map.ids, path_map.rows, strict=True)):
        _draw_row(axes, row, name, cells, driven.preferred_lanes[row], colours)
    axes.set_title(
        f"{driven.name}: {rows} vehicles, {path_map.cost()} steps in all "
        f"within {path_map.steps} slots",
        fontsize=9.5,
        color=INK,
    )
    save(figure, out, dpi)


def _draw_row(
    axes: Axes,
    row: int,
    name: str,
    cells: tuple[tuple[int, int], ...],
    preferred: int,
    colours: tuple[str, ...],
) -> None:
    """Draw a vehicle's row: its name with the colour of its lane, then its cells."""
    from matplotlib.patches import FancyBboxPatch, Rectangle  # noqa: PLC0415 - lazily

    style = "round,pad=0,rounding_size=0.1"
    colour = colours[preferred % len(colours)]
    axes.add_patch(
        FancyBboxPatch((-1.25, row + 0.2), 0.3, 0.6, boxstyle=style, fc=colour, ec=INK, lw=0.5)
    )
    shown = name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 1] + "…"
    # Names come from files; a dollar sign must not begin a formula.
    axes.text(-0.85, row + 0.5, shown, va="center", fontsize=8.5, color=INK, parse_math=False)
    before = None
    for point, (column, lane) in enumerate(cells):
        arrived = lane == preferred
        axes.add_patch(
            Rectangle(
                (point + 0.03, row + 0.06),
                0.94,
                0.88,
                facecolor=colours[lane % len(colours)],
                alpha=0.62 if arrived else 0.16,
                linewidth=0.0,
            )
        )
        moved = before is not None and before != (column, lane)
        axes.text(
            point + 0.5,
            row + 0.5,
            f"({column}, {lane})",
            ha="center",
            va="center",
            fontsize=8.5,
            color=INK,
            fontweight="bold" if moved else "normal",
        )
        before = (column, lane)
