"""SUMO's floating car data (FCD), which SUMO's own scripts plot, and the road as its network."""

from __future__ import annotations

import gzip
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from laneweave.launch.export.recording import Recording
from laneweave.protocol.files import write_atomically
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.sim_bridge.sumo.network import NETWORK_FILE, write_network
from laneweave.sim_bridge.sumo.road_edges import ROAD, single_edge

FCD_FILE = "fcd.xml"


def write_fcd(recording: Recording, path: Path) -> list[Path]:
    """Write positions of all vehicles at all ticks; return the files.

    x and y are those of the middle of the front bumper, with x along the road and y to the left
    from its right edge; angles are clockwise from north, as in SUMO, and the road leads to the
    east. All vehicles are on one edge; lanes that are closed or do not exist belong to it.

    Args:
        recording: the run.
        path: the file; compressed if its name ends with `.gz`. The network is beside it.
    """
    network = path.parent / NETWORK_FILE
    with temporary_folder("export") as folder:
        write_network(recording.scenario, folder, sumo_drives=False)
        write_atomically(network, lambda part: shutil.copyfile(folder / NETWORK_FILE, part))

    def write(part: Path) -> None:
        if path.suffix == ".gz":
            with gzip.open(part, "wt", encoding="utf-8") as file:
                file.writelines(_lines(recording))
        else:
            with part.open("w", encoding="utf-8") as file:
                file.writelines(_lines(recording))

    write_atomically(path, write)
    return [path, network]


def _lines(recording: Recording) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>\n\n<fcd-export>\n'
    for t_s, rows in recording.ticks():
        lines = "".join(_vehicle(row) for row in _columns(recording, rows))
        yield f'    <timestep time="{t_s:.2f}">\n{lines}    </timestep>\n'
    yield "</fcd-export>\n"


Row = tuple[str, str, float, float, float, float, float, int, float]


def _columns(recording: Recording, rows: range) -> zip[Row]:
    """Return name, type, x, y, angle, speed, position, lane and acceleration of each vehicle."""
    own = slice(rows.start, rows.stop)
    heading = recording.heading_rad[own]
    front_y_m = recording.y_m[own] + 0.5 * recording.lengths_m[own] * np.sin(heading)
    edge = single_edge(recording.scenario).road[0]
    numbers = recording.vehicle[own].tolist()
    return zip(
        (quoteattr(recording.names[number]) for number in numbers),
        (quoteattr(recording.types[number]) for number in numbers),
        recording.s_m[own].tolist(),
        front_y_m.tolist(),
        (90.0 - np.degrees(heading)).tolist(),
        recording.speed_mps[own].tolist(),
        (recording.s_m[own] - edge.from_m).tolist(),
        recording.lane[own].tolist(),
        recording.accel_mps2[own].tolist(),
        strict=True,
    )


def _vehicle(row: Row) -> str:
    name, kind, x_m, y_m, angle, speed_mps, pos_m, lane, accel_mps2 = row
    angle = math.fmod(angle + 360.0, 360.0)
    return (
        f'        <vehicle id={name} x="{x_m:.2f}" y="{y_m:.2f}" angle="{angle:.2f}" type={kind}'
        f' speed="{speed_mps:.2f}" pos="{pos_m:.2f}" lane="{ROAD}_{lane}" slope="0.00"'
        f' acceleration="{accel_mps2:.2f}"/>\n'
    )
