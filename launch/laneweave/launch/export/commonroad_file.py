"""A run as a CommonRoad scenario (Althoff et al., IV 2017): lanelets, and vehicles as obstacles."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Final

import numpy as np
from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile
from commonroad.geometry.shape import Rectangle
from commonroad.planning.planning_problem import PlanningProblemSet
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork, LaneletType, LineMarking
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Location, Scenario, ScenarioID
from commonroad.scenario.state import CustomState, InitialState
from commonroad.scenario.trajectory import Trajectory
from lxml import etree

from laneweave.launch.export.recording import Recording
from laneweave.launch.export.road_parts import RoadPart, road_parts
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.files import write_atomically
from laneweave.protocol.scenario.fields import Scenario as Road
from laneweave.protocol.wire.messages import CAR

COMMONROAD_FILE: Final = "commonroad.xml"
FIRST_OBSTACLE: Final = 1000
"""Number of the first vehicle; on roads with more lanelets, a multiple of it: the numbers of
lanelets are smaller."""


def write_commonroad(recording: Recording, path: Path) -> list[Path]:
    """Write a run as a CommonRoad scenario without a planning problem; return the file.

    Time steps are the ticks of the run, counted from the first one. Positions are those of the
    centres of bodies. Vehicles are numbered from `FIRST_OBSTACLE` in the order of their names in
    the recording; vehicles that are present at a single tick are left out.

    Raises:
        BadInputError: no vehicle is present at two ticks.
        OSError: the file cannot be written.
    """
    tick_s = recording.scenario.runtime.tick_s
    scenario = Scenario(tick_s, ScenarioID(country_id="ZAM", map_name="Laneweave", map_id=1))
    lanelets = _lanelets(recording.scenario)
    scenario.add_objects(lanelets)
    first = FIRST_OBSTACLE * (1 + len(lanelets.lanelets) // FIRST_OBSTACLE)
    order = np.argsort(recording.vehicle, kind="stable")
    bounds = np.searchsorted(recording.vehicle[order], np.arange(len(recording.names) + 1))
    steps = np.rint((recording.t_s - recording.t_s[0]) / tick_s).astype(np.int64)
    for number in range(len(recording.names)):
        rows = order[bounds[number] : bounds[number + 1]]
        if len(rows) > 1:
            scenario.add_objects(_obstacle(recording, number, first + number, rows, steps))
    if not scenario.dynamic_obstacles:
        raise BadInputError("--from, --to", "one tick", "at least two ticks")
    writer = CommonRoadFileWriter(
        scenario,
        PlanningProblemSet(),
        author="laneweave",
        affiliation="laneweave",
        source=f"simulated road, seed {recording.scenario.seed}",
        tags=set(),
        location=Location(),
    )

    def write(part: Path) -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints where it writes
            try:
                writer.write_to_file(str(part), OverwriteExistingFile.ALWAYS)
            except etree.SerialisationError as error:
                raise OSError(str(error)) from error

    write_atomically(path, write)
    return [path]


def _lanelets(road: Road) -> LaneletNetwork:
    """Return one lanelet for each part of a lane."""
    parts, width_m = road_parts(road), road.road.lane_width_m
    following: dict[int | None, int] = {part.behind: part.number for part in parts}

    def line(part: RoadPart, border: float) -> np.ndarray:
        return np.array([[part.from_m, border * width_m], [part.to_m, border * width_m]])

    def lanelet(part: RoadPart) -> Lanelet:
        (right, left), (to_right, to_left) = part.beside, part.may_cross
        ahead = following.get(part.number)
        return Lanelet(
            line(part, part.lane + 1.0),
            line(part, part.lane + 0.5),
            line(part, part.lane),
            lanelet_id=part.number,
            predecessor=[] if part.behind is None else [part.behind],
            successor=[] if ahead is None else [ahead],
            adjacent_left=left,
            adjacent_left_same_direction=None if left is None else True,
            adjacent_right=right,
            adjacent_right_same_direction=None if right is None else True,
            line_marking_left_vertices=_marking(dashed=to_left),
            line_marking_right_vertices=_marking(dashed=to_right),
            lanelet_type={LaneletType.HIGHWAY},
        )

    return LaneletNetwork.create_from_lanelet_list([lanelet(part) for part in parts])


def _marking(*, dashed: bool) -> LineMarking:
    return LineMarking.DASHED if dashed else LineMarking.SOLID


def _obstacle(
    recording: Recording, number: int, identifier: int, rows: np.ndarray, steps: np.ndarray
) -> DynamicObstacle:
    """Return a vehicle with its trajectory."""
    shape = Rectangle(*recording.size_m(number))
    positions = np.stack([recording.centres_m[rows], recording.y_m[rows]], axis=1)
    states = [
        {
            "time_step": int(steps[row]),
            "position": position,
            "orientation": float(recording.heading_rad[row]),
            "velocity": float(recording.speed_mps[row]),
            "acceleration": float(recording.accel_mps2[row]),
        }
        for row, position in zip(rows.tolist(), positions, strict=True)
    ]
    initial = InitialState(**states[0], yaw_rate=0.0, slip_angle=0.0)
    later = [CustomState(**state) for state in states[1:]]
    kind = ObstacleType.CAR if recording.types[number] == CAR else ObstacleType.TRUCK
    trajectory = Trajectory(later[0].time_step, later)
    prediction = TrajectoryPrediction(trajectory, shape)
    return DynamicObstacle(identifier, kind, shape, initial, prediction)
