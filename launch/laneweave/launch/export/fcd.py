"""Trajectories as SUMO's floating car data (FCD), and the road as a SUMO network."""

from __future__ import annotations

import gzip
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
        path: the file, `NAME.xml` or, compressed, `NAME.xml.gz`. The network is beside it:
            `NAME.road.net.xml`.

    Raises:
        OSError: a file cannot be written.
    """

    def write(part: Path) -> None:
        if path.suffix == ".gz":
            with gzip.open(part, "wt", encoding="utf-8") as file:
                file.writelines(_lines(recording))
        else:
            with part.open("w", encoding="utf-8") as file:
                file.writelines(_lines(recording))

    name = path.name.removesuffix(".gz").removesuffix(".xml")
    network = path.with_name(f"{name}.{NETWORK_FILE}")
    write_atomically(path, write)
    with temporary_folder("export") as folder:
        write_network(recording.scenario, folder, sumo_drives=False)
        write_atomically(network, lambda part: shutil.copyfile(folder / NETWORK_FILE, part))
    return [path, network]


def _lines(recording: Recording) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>\n\n<fcd-export>\n'
    edge = single_edge(recording.scenario).road[0]
    names = [quoteattr(name) for name in recording.names]
    types = [quoteattr(name) for name in recording.types]
    angles = 90.0 - np.degrees(recording.heading_rad)
    for t_s, rows in recording.ticks():
        yield f'    <timestep time="{t_s:.3f}">\n'
        for row in rows:
            number, s_m, y_m = recording.vehicle[row], recording.s_m[row], recording.front_y_m[row]
            yield (
                f'        <vehicle id={names[number]} x="{s_m:.2f}" y="{y_m:.2f}"'
                f' angle="{angles[row]:.2f}" type={types[number]}'
                f' speed="{recording.speed_mps[row]:.2f}" pos="{s_m - edge.from_m:.2f}"'
                f' lane="{ROAD}_{recording.lane[row]}" slope="0.00"'
                f' acceleration="{recording.accel_mps2[row]:.2f}"/>\n'
            )
        yield "    </timestep>\n"
    yield "</fcd-export>\n"
