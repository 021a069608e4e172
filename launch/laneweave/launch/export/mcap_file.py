"""A run as an MCAP file with Foxglove's schemas, for Foxglove and other robotics tools.

    /road       foxglove.SceneUpdate   the borders of the lanes, once
    /vehicles   foxglove.SceneUpdate   the bodies, in the colour of the preferred lane, each tick
    /speeds     foxglove.PointCloud    fronts with speed and acceleration, each tick
    /traffic    JSON                   number of vehicles, mean and lowest speed, each tick
    /events     foxglove.Log           the events of the run

Times are road times; x is along the road, y to the left from its right edge (frame `road`).
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import foxglove
import numpy as np
from foxglove.channels import LogChannel, PointCloudChannel, SceneUpdateChannel
from foxglove.messages import (
    Color,
    CubePrimitive,
    LinePrimitive,
    LinePrimitiveLineType,
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    Point3,
    PointCloud,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    Timestamp,
    Vector3,
)

from laneweave.launch.drawing.colours import NEUTRAL, lane_colours
from laneweave.launch.export.recording import Recording
from laneweave.launch.export.road_parts import road_parts
from laneweave.launch.recordings.events import read_events
from laneweave.protocol.files import write_atomically

MCAP_FILE: Final = "run.mcap"
FRAME: Final = "road"
HEIGHT_M: Final = 1.5
"""Height of the bodies, which recordings do not contain."""
_NS_PER_S: Final = 1_000_000_000
_POINT: Final = ("x", "y", "z", "speed", "acceleration")
_FIELDS: Final = [
    PackedElementField(name=name, offset=4 * place, type=PackedElementFieldNumericType.Float32)
    for place, name in enumerate(_POINT)
]
_ORIGIN: Final = Pose(
    position=Vector3(x=0.0, y=0.0, z=0.0), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
)
_NUMBER: Final = {"type": "number"}
_TRAFFIC: Final = {
    "type": "object",
    "title": "laneweave.Traffic",
    "properties": {"vehicles": _NUMBER, "mean_speed_mps": _NUMBER, "min_speed_mps": _NUMBER},
}


def write_mcap(
    recording: Recording, path: Path, from_s: float | None, to_s: float | None
) -> list[Path]:
    """Write a run as an MCAP file; return the file.

    Args:
        recording: the run.
        path: the file.
        from_s: road time of the first events; None: all.
        to_s: road time of the last ones.

    Raises:
        BadInputError: the events cannot be read.
        OSError: the file cannot be written.
    """
    first_s, last_s = -math.inf if from_s is None else from_s, math.inf if to_s is None else to_s
    events = [one for one in read_events(recording.folder) if first_s <= one["t_s"] <= last_s]

    def write(part: Path) -> None:
        with part.open("wb", buffering=0) as file:
            _write(recording, events, _Sink(file))

    write_atomically(path, write)
    return [path]


class _Sink(io.RawIOBase):
    """A file that keeps its first write error, and discards all later bytes.

    If it raised the error, the library would print a line for each message, and hide the error.
    """

    def __init__(self, file: io.RawIOBase) -> None:
        """Write to an open file from its beginning on."""
        self._file = file
        self._error: OSError | None = None
        self._position = self._end = 0

    def check(self) -> None:
        """Raise the error, if there was one."""
        if self._error is not None:
            raise self._error

    def write(self, data: Any) -> int:  # noqa: ANN401 (any buffer)
        """Write all bytes, unless there was an error; return their number."""
        rest = memoryview(data)
        self._position += len(rest)
        self._end = max(self._end, self._position)
        try:
            while rest and self._error is None:
                rest = rest[self._file.write(rest) or 0 :]
        except OSError as error:
            self._error = error
        return len(data)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a position; return it."""
        from_byte = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._end}
        self._position = from_byte[whence] + offset
        if self._error is None:
            self._file.seek(self._position)
        return self._position


def _write(recording: Recording, events: Sequence[Mapping[str, Any]], sink: _Sink) -> None:
    context = foxglove.Context()
    with foxglove.open_mcap(cast("BinaryIO", sink), context=context):
        begin_s = float(min([recording.t_s[0], *(float(event["t_s"]) for event in events)]))
        road = SceneUpdateChannel("/road", context=context)
        road.log(_road(recording, begin_s), log_time=_ns(begin_s))
        log = LogChannel("/events", context=context)
        for event in events:
            t_s = float(event["t_s"])
            text = json.dumps({name: value for name, value in event.items() if name != "t_s"})
            name = str(event.get("name", event.get("role", "")))
            entry = Log(timestamp=_timestamp(t_s), level=LogLevel.Info, message=text, name=name)
            log.log(entry, log_time=_ns(t_s))
        vehicles = SceneUpdateChannel("/vehicles", context=context)
        speeds = PointCloudChannel("/speeds", context=context)
        traffic = foxglove.Channel("/traffic", schema=_TRAFFIC, context=context)
        colours, sizes = _colours(recording), _sizes(recording)
        for t_s, rows in recording.ticks():
            sink.check()
            own = slice(rows.start, rows.stop)
            vehicles.log(_bodies(recording, t_s, own, colours, sizes), log_time=_ns(t_s))
            speeds.log(_speeds(recording, t_s, own), log_time=_ns(t_s))
            speed_mps = recording.speed_mps[own]
            traffic.log(
                {
                    "vehicles": len(rows),
                    "mean_speed_mps": round(float(speed_mps.mean()), 3),
                    "min_speed_mps": round(float(speed_mps.min()), 3),
                },
                log_time=_ns(t_s),
            )
    sink.check()


def _ns(t_s: float) -> int:
    return max(round(t_s * _NS_PER_S), 0)


def _timestamp(t_s: float) -> Timestamp:
    return Timestamp(*divmod(_ns(t_s), _NS_PER_S))


def _colour(text: str) -> Color:
    red, green, blue = (int(text[place : place + 2], 16) / 255.0 for place in (1, 3, 5))
    return Color(r=red, g=green, b=blue, a=1.0)


def _colours(recording: Recording) -> list[Color]:
    """Return the colour of each vehicle."""
    lanes = [_colour(text) for text in lane_colours(recording.scenario.road.lanes)]
    neutral = _colour(NEUTRAL)
    return [
        lanes[lane] if 0 <= lane < len(lanes) else neutral for lane in recording.preferred_lanes
    ]


def _sizes(recording: Recording) -> list[Vector3]:
    """Return the size of each vehicle's body."""
    sizes_m = map(recording.size_m, range(len(recording.names)))
    return [Vector3(x=length_m, y=width_m, z=HEIGHT_M) for length_m, width_m in sizes_m]


def _road(recording: Recording, t_s: float) -> SceneUpdate:
    width_m, white = recording.scenario.road.lane_width_m, Color(r=1.0, g=1.0, b=1.0, a=1.0)
    borders = {
        (border, part.from_m, part.to_m)
        for part in road_parts(recording.scenario)
        for border in (part.lane, part.lane + 1)
    }
    lines = [
        LinePrimitive(
            type=LinePrimitiveLineType.LineStrip,
            pose=_ORIGIN,
            thickness=0.15,
            color=white,
            points=[Point3(x=x_m, y=border * width_m, z=0.0) for x_m in (from_m, to_m)],
        )
        for border, from_m, to_m in sorted(borders)
    ]
    entity = SceneEntity(timestamp=_timestamp(t_s), frame_id=FRAME, id="road", lines=lines)
    return SceneUpdate(entities=[entity])


def _bodies(
    recording: Recording, t_s: float, rows: slice, colours: list[Color], sizes: list[Vector3]
) -> SceneUpdate:
    half_rad = 0.5 * recording.heading_rad[rows]
    cubes = [
        CubePrimitive(
            pose=Pose(
                position=Vector3(x=x_m, y=y_m, z=0.5 * HEIGHT_M),
                orientation=Quaternion(x=0.0, y=0.0, z=sine, w=cosine),
            ),
            size=sizes[number],
            color=colours[number],
        )
        for number, x_m, y_m, sine, cosine in zip(
            recording.vehicle[rows].tolist(),
            recording.centres_m[rows].tolist(),
            recording.y_m[rows].tolist(),
            np.sin(half_rad).tolist(),
            np.cos(half_rad).tolist(),
            strict=True,
        )
    ]
    entity = SceneEntity(timestamp=_timestamp(t_s), frame_id=FRAME, id="vehicles", cubes=cubes)
    return SceneUpdate(entities=[entity])


def _speeds(recording: Recording, t_s: float, rows: slice) -> PointCloud:
    columns = (
        recording.s_m[rows],
        recording.front_y_m[rows],
        np.full(rows.stop - rows.start, HEIGHT_M),
        recording.speed_mps[rows],
        recording.accel_mps2[rows],
    )
    return PointCloud(
        timestamp=_timestamp(t_s),
        frame_id=FRAME,
        pose=_ORIGIN,
        point_stride=4 * len(_POINT),
        fields=_FIELDS,
        data=np.stack(columns, axis=1).astype("<f4").tobytes(),
    )
