"""The driven relative path map (paper, Section 3.3) of a formation, and its figure.

The map has a row per vehicle and a column per time point at intervals of T_F. The first time point
and T_F are those of the driven plan; if the recording lacks these, the map begins with the first
move and uses the scenario's T_F. The cell of a moving vehicle is the target of its move, which it
reaches by the end of the slot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from attrs import frozen

from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.launch.drawing.colours import lane_colours, text_colour, vehicle_colour
from laneweave.launch.drawing.figures import INK, write
from laneweave.launch.formation_columns import FormationColumns
from laneweave.launch.recordings.events import read_events
from laneweave.launch.recordings.files import EVENTS_FILE, reading
from laneweave.launch.recordings.formations import recorded_formations
from laneweave.launch.recordings.runs import Run
from laneweave.launch.recordings.trajectories import NO_LATTICE, Floats, Tracks, read_trips
from laneweave.launch.report.style import SMALL_TEXT, picture
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import ANY_LANE, sections_for
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.events import FORMATIONS_JOINED, PLAN_MADE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE_PT = 8.5
_MAX_NAME = 9
_MAX_LISTED = 8


@frozen
class DrivenMap:
    """The driven relative path map of a formation."""

    formation: int
    is_formation: bool
    """Whether the vehicles are a formation; otherwise they are those that entered in `columns`."""
    columns: tuple[int, int]
    """Rearmost and foremost column."""
    path_map: RelativePathMap
    """Path map with columns relative to the formation's rearmost column."""
    preferred_lanes: tuple[int, ...]
    """Preferred lane of the vehicle in each row, or `ANY_LANE`."""
    arrived: tuple[tuple[bool, ...], ...]
    """Whether the vehicle may leave the road in the lane of each cell."""
    start_s: float
    """Road time of the first time point."""
    slot_s: float
    lanes: int

    @property
    def name(self) -> str:
        """Name of the formation in figures."""
        if self.is_formation:
            return f"formation {self.formation}"
        return f"columns {self.columns[0]} to {self.columns[1]}"

    @property
    def vehicles(self) -> str:
        """Description of the vehicles."""
        if self.is_formation:
            return "a formation's vehicles"
        return f"the vehicles that entered in {self.name}"

    @property
    def colours(self) -> str:
        """Meaning of the colours of the figure."""
        if all(lane == ANY_LANE for lane in self.preferred_lanes):
            return (
                "Cells have the colour of their lane, strong if the lane is open from there to the "
                "end of the road"
            )
        return (
            "The box before a name shows the preferred lane (0: rightmost); cells have the colour "
            "of their lane, strong if it is the preferred one"
        )


def driven_map(run: Run, tracks: Tracks, formation: int | None) -> DrivenMap | None:
    """Return the path map of a formation, by default the one with the most moves, or None.

    Raises:
        BadInputError: the run has no such formation, or a file of it cannot be read.
    """
    columns = recorded_formations(run.folder, run.scenario.lattice).by_number
    trips = read_trips(run.folder)
    members: dict[int, list[tuple[int, int]]] = {}
    for number, name in enumerate(tracks.names):
        # A run that was killed may have saved a vehicle's first positions and not yet its trip.
        trip = trips.get(name)
        if trip is not None and trip["formation"] is not None:
            members.setdefault(trip["formation"], []).append((number, trip["preferred_lane"]))
    if formation is None:
        if not members:
            return None
        moves = np.bincount(tracks.vehicle[tracks.changed], minlength=len(tracks.names))
        formation = max(members, key=lambda one: sum(moves[number] for number, _ in members[one]))
    if formation not in members:
        near = sorted(sorted(members, key=lambda one: abs(one - formation))[:_MAX_LISTED])
        known = ", ".join(map(str, near)) if members else "none: it has no formations"
        if len(members) > len(near):
            known += f" and {len(members) - len(near)} others"
        raise BadInputError("--formation", formation, f"a formation of {run.folder}: {known}")
    return _map_of(columns[formation], members[formation], tracks, run)


def _map_of(
    formation: FormationColumns, members: list[tuple[int, int]], tracks: Tracks, run: Run
) -> DrivenMap | None:
    parts = [tracks.rows(number) for number, _ in members]
    if any((tracks.reserved_column[part] == NO_LATTICE).any() for part in parts):
        return None
    changes_s = [float(t_s) for part in parts for t_s in tracks.t_s[part][tracks.changed[part]]]
    tick_s = run.scenario.runtime.tick_s
    entered_s = max(float(tracks.t_s[part.start]) for part in parts)
    last_s = max(changes_s, default=entered_s)
    start_s, slot_s = _driven_slots(run, formation.number, entered_s, changes_s)
    steps = max(0, int(np.ceil((last_s - start_s + 0.5 * tick_s) / slot_s)))
    # Moves begin at a tick; their target is recorded from that tick on.
    times_s = start_s - 0.5 * tick_s + slot_s * np.arange(steps + 1, dtype=np.float64)
    cells: list[tuple[Cell, ...]] = []
    for part in parts:
        # Row of the vehicle at or before each time.
        places = np.searchsorted(tracks.t_s[part], times_s, side="right") - 1
        places = np.maximum(places, 0)
        columns = tracks.reserved_column[part][places] - formation.rear
        lanes = tracks.reserved_lane[part][places]
        cells.append(tuple(zip(columns.tolist(), lanes.tolist(), strict=True)))
    # Order of the paper's table: from front to rear, then from right to left.
    order = sorted(range(len(cells)), key=lambda row: (-cells[row][0][0], cells[row][0][1]))
    return DrivenMap(
        formation.number,
        run.scenario.formation.traits.has_formations,
        (formation.rear, formation.front),
        RelativePathMap(
            tuple(tracks.names[members[row][0]] for row in order),
            tuple(cells[row] for row in order),
        ),
        tuple(members[row][1] for row in order),
        tuple(
            _arrived(run.scenario, members[row][1], cells[row], formation.rear, times_s)
            for row in order
        ),
        start_s,
        slot_s,
        run.scenario.road.lanes,
    )


def _arrived(
    scenario: Scenario, preferred_lane: int, cells: Sequence[Cell], rear: int, times_s: Floats
) -> tuple[bool, ...]:
    """Return whether each cell is in a section of a lane by which the vehicle may leave."""
    lattice, sections = scenario.lattice, scenario.geometry.sections
    allowed = [sections[number] for number in sections_for(sections, preferred_lane)]
    places = [
        (lane, lattice.cell_s_m(rear + column, t_s))
        for (column, lane), t_s in zip(cells, times_s.tolist(), strict=True)
    ]
    return tuple(
        any(one.lane == lane and one.from_m <= s_m for one in allowed) for lane, s_m in places
    )


def _driven_slots(
    run: Run, formation: int, entered_s: float, changes_s: list[float]
) -> tuple[float, float]:
    """Return the road time of a formation's first slot and the slot length.

    Both are from the last plan under which the formation moved, if there is one.
    """
    tick_s, slot_s = run.scenario.runtime.tick_s, run.scenario.timing.cycles_s[0]
    last_s = max(changes_s, default=math.inf) + 0.5 * tick_s
    together, found = {formation}, None
    with reading(run.folder, EVENTS_FILE):
        for event in read_events(run.folder, FORMATIONS_JOINED, PLAN_MADE):
            if event.get("role") != "coordinator":
                continue
            if event["kind"] == FORMATIONS_JOINED and formation in event["formations"]:
                together.update(event["formations"])
            if event["kind"] == PLAN_MADE and event["formation"] in together and "t0_s" in event:
                slots = float(event["t0_s"]), float(event["slot_s"])
                found = slots if slots[0] <= last_s and slots[1] > 0.0 else found
    if found is not None:
        return found
    # The first move may be late by at most the slack of a slot.
    slack_s = run.scenario.formation.slack_s
    return min(changes_s, default=entered_s + slack_s + tick_s) - slack_s, slot_s


def draw_path_map(driven: DrivenMap, out: Path, dpi: int) -> None:
    """Draw the table; cells have the colour of their lane, strong if the vehicle has arrived."""
    path_map = driven.path_map
    rows, points = len(path_map.rows), path_map.steps + 1
    with picture(2.3 + 1.12 * points, 0.8 + 0.36 * (rows + 1), out, dpi) as figure:
        axes = figure.subplots()
        axes.set_xlim(-1.3, points)
        axes.set_ylim(rows + 0.05, -1.0)
        axes.set_axis_off()
        for point in range(points):
            _write(axes, point, -0.62, "start" if point == 0 else f"slot {point}")
            t_s = driven.start_s + point * driven.slot_s
            _write(axes, point, -0.25, f"{t_s:.1f} s", **SMALL_TEXT)
        for row in range(rows):
            _draw_row(axes, row, driven)
        axes.set_title(
            f"{driven.name}: {rows} vehicles, {path_map.steps} slots, cost {path_map.cost()}",
            fontsize=9.5,
        )


def _draw_row(axes: Axes, row: int, driven: DrivenMap) -> None:
    """Draw a vehicle's row: its preferred lane, its name, its cells."""
    from matplotlib.patches import FancyBboxPatch, Rectangle  # noqa: PLC0415 - lazily

    colours, arrived = lane_colours(driven.lanes), driven.arrived[row]
    name, cells = driven.path_map.ids[row], driven.path_map.rows[row]
    style: dict[str, Any] = {"boxstyle": "round,pad=0,rounding_size=0.1", "ec": INK, "lw": 0.5}
    preferred = driven.preferred_lanes[row]
    if preferred != ANY_LANE:
        colour = vehicle_colour(driven.lanes, preferred)
        axes.add_patch(FancyBboxPatch((-1.25, row + 0.2), 0.3, 0.6, fc=colour, **style))
        own: dict[str, Any] = {"color": text_colour(colour), "ha": "center"}
        write(axes, (-1.1, row + 0.5), str(preferred), _SIZE_PT - 1.0, **own)
    shown = name if len(name) <= _MAX_NAME else name[: _MAX_NAME - 1] + "…"
    write(axes, (-0.85, row + 0.5), shown, _SIZE_PT)
    for point, (cell, before) in enumerate(zip(cells, (cells[0], *cells), strict=False)):
        colour, alpha = colours[cell[1] % len(colours)], 0.62 if arrived[point] else 0.16
        corner = (point + 0.03, row + 0.06)
        axes.add_patch(Rectangle(corner, 0.94, 0.88, facecolor=colour, alpha=alpha, linewidth=0.0))
        weight = "normal" if cell == before else "bold"
        _write(axes, point, row + 0.5, str(cell), fontweight=weight)


def _write(axes: Axes, point: int, y: float, text: str, **style: Any) -> None:  # noqa: ANN401
    """Write text into the centre of a time point's column."""
    write(axes, (point + 0.5, y), text, _SIZE_PT, ha="center", **style)
