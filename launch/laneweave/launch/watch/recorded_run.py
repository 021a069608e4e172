"""Frames of a recorded run, made on request.

The files of a run contain only the current cell or move of each vehicle; owned cells and later
moves are not recorded.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from attrs import frozen
from numpy.typing import NDArray

from laneweave.launch.drawing.colours import trip_lane
from laneweave.launch.formation_columns import Formations
from laneweave.launch.recordings.events import read_events
from laneweave.launch.recordings.files import EVENTS_FILE, reading
from laneweave.launch.recordings.formations import closed_formations
from laneweave.launch.recordings.runs import single_run
from laneweave.launch.recordings.trajectories import NO_LATTICE, Tracks, read_tracks, read_trips
from laneweave.launch.run_methods import FORMATION
from laneweave.launch.watch.frames import (
    CLOSED_PART,
    MOVING,
    EventFeed,
    Row,
    compact,
    part_row,
    plan_row,
    scene_of,
)
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import LanePosition
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.wire.events import (
    ENTERED,
    FORMATIONS_JOINED,
    LEADER,
    LEFT,
    PART_CLOSED,
    PART_OPENED,
)
from laneweave.protocol.wire.messages import CAR
from laneweave.protocol.wire.obstacle_messages import PASSING

STEP_S = 0.2
"""Road time between two frames; the page interpolates."""
STILL_M = 0.25
"""Lateral distance from the centre of the cell above which a vehicle counts as moving."""


@frozen
class _Moment:
    """The state of a run after one of its events."""

    t_s: float
    leader: tuple[str, int] | None = None
    plan: list[Any] | None = None
    news: tuple[list[Any], ...] = ()
    entered: int = 0
    left: int = 0
    joined: tuple[tuple[int, ...], ...] = ()
    """Groups of blocks whose formations plan together."""
    closed: Mapping[LanePosition, float] = MappingProxyType({})
    """End of each part that is closed for a time, by lane and beginning."""


class RecordedFrames:
    """`FrameSource` of a finished run."""

    def __init__(self, folder: Path) -> None:
        """Read the folder of a run.

        Raises:
            BadInputError: the folder does not hold a finished run with trajectories.
        """
        run = single_run(folder)
        self._tracks = read_tracks(folder)
        self._trips = read_trips(folder)
        with reading(folder, EVENTS_FILE):
            self._moments = list(_moments(folder))
        self._formations = closed_formations(folder, run.scenario).by_number
        self._run = run
        self._lane_ends = LaneEnds(run.scenario)
        tick_s = run.scenario.runtime.tick_s
        stride = max(1, round(STEP_S / tick_s))
        self._step_s = stride * tick_s
        self._numbers, self._rows = _frames_of(self._tracks, tick_s, stride)
        self.first = 0
        # An additional last frame shows no vehicles.
        self.last = int(self._numbers[-1]) + 1 if len(self._numbers) else 0
        self._demands_s = np.sort([float(trip["demanded_s"]) for trip in self._trips.values()])
        self._times_s = [moment.t_s for moment in self._moments]
        self.scene = scene_of(run.scenario, "recorded", run.title, self._step_s)
        self.scene["has_formations"] &= run.method == FORMATION

    def frames(self, begin: int, end: int) -> list[str]:
        """Return the available frames from `begin` to `end`, both included."""
        numbers = range(max(begin, self.first), min(end, self.last) + 1)
        return [compact(self.frame(number)) for number in numbers]

    def frame(self, number: int) -> dict[str, Any]:
        """Return one frame; see the module `frames`."""
        t_s = number * self._step_s
        moment = self._moments[max(0, bisect_right(self._times_s, t_s + 1e-6) - 1)]
        rows = list(self._vehicles(number, t_s))
        demanded = int(np.searchsorted(self._demands_s, t_s, side="right"))
        present = {row.formation for row in rows}
        shown = Formations(one for one in self._formations.values() if one.number in present)
        return {
            "n": number,
            "run": 1,
            "t": round(t_s, 3),
            "w": None,
            "status": "recorded",
            "since": None,
            "findings": [],
            "leader": moment.leader,
            "candidates": [],
            "counts": [demanded, moment.entered, len(rows), moment.left],
            "plan": moment.plan,
            "news": moment.news,
            "formations": [[one.number, one.rear, one.front] for one in shown.listed],
            "joined": shown.joined(moment.joined, self._run.scenario.lattice),
            "vehicles": [row.compact() for row in rows],
            "parts": [
                part_row(lane, from_m, to_m, CLOSED_PART)
                for (lane, from_m), to_m in moment.closed.items()
            ],
            "others": [],
        }

    def _vehicles(self, number: int, t_s: float) -> Iterator[Row]:
        tracks, scenario = self._tracks, self._run.scenario
        width_m = scenario.road.lane_width_m
        first = np.searchsorted(self._numbers, number)
        last = np.searchsorted(self._numbers, number, side="right")
        for place, vehicle in self._rows[first:last]:
            name = tracks.names[vehicle]
            trip = self._trips.get(name, {})
            column, lane = int(tracks.reserved_column[place]), int(tracks.reserved_lane[place])
            cell: Cell | None = None
            if column == NO_LATTICE:
                lane = int(tracks.lane[place])
            else:
                cell = column, lane
            if cell is not None and self._lane_ends.has_passed(cell, t_s):
                cell = None
            y_m = float(tracks.y_m[place])
            formation = self._formations.get(trip.get("formation", -1))
            moving = abs(y_m - (lane + 0.5) * width_m) > STILL_M
            if cell is not None:
                ahead_m = scenario.lattice.cell_s_m(column, t_s) - float(tracks.s_m[place])
                moving |= abs(ahead_m) > 0.5 * scenario.formation.gap_m
            yield Row(
                name=name,
                s_m=float(tracks.s_m[place]),
                y_m=y_m,
                speed_mps=float(tracks.speed_mps[place]),
                preferred_lane=trip_lane(scenario, trip),
                formation=formation.number if formation and formation.closed_s <= t_s else -1,
                hold=cell,
                target=None,
                flags=MOVING * moving,
                vehicle_type=str(trip.get("vehicle_type", CAR)),
            )


def _frames_of(
    tracks: Tracks, tick_s: float, stride: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sampled rows: frame numbers (ascending), and pairs of (row, vehicle)."""
    ticks = np.rint(tracks.t_s / tick_s).astype(np.int64)
    rows = np.flatnonzero(ticks % stride == 0)
    numbers = ticks[rows] // stride
    order = np.argsort(numbers, kind="stable")
    pairs = np.column_stack([rows, tracks.vehicle[rows]])
    return numbers[order], pairs[order]


def _moments(folder: Path) -> Iterator[_Moment]:
    """Yield the initial state and the state after each event, in chronological order."""
    moment, feed = _Moment(float("-inf")), EventFeed()
    yield moment
    for event in sorted(read_events(folder), key=itemgetter("t_s")):
        data = dict(event)
        t_s, kind, role = float(data.pop("t_s")), str(data.pop("kind")), data.pop("role", "")
        feed.add(t_s, str(data.pop("name", role)), kind, data)
        leader, joined = moment.leader, moment.joined
        if kind == LEADER:
            leader = str(data.get("coordinator")), int(data.get("term", 0))
        if kind == FORMATIONS_JOINED and role == "coordinator":
            joined = (*joined, tuple(map(int, data["formations"])))
        plan = plan_row(t_s, kind, data) or moment.plan
        entered, left = moment.entered + (kind == ENTERED), moment.left + (kind == LEFT)
        closed = moment.closed
        # Where vehicles of other systems are is not recorded.
        if kind in (PART_CLOSED, PART_OPENED) and data.get("cause") != PASSING:
            at = int(data["lane"]), float(data["from_m"])
            rest = {each: to_m for each, to_m in closed.items() if each != at}
            closed = rest | ({at: float(data["to_m"])} if kind == PART_CLOSED else {})
        moment = _Moment(t_s, leader, plan, tuple(feed.rows), entered, left, joined, closed)
        yield moment
