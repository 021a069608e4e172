"""Writes a SUMO simulation of a motorway: `python benchmarks/interchanges.py DIR`.

By default: 8 km, three lanes, three interchanges, each with an exit and, 500 m behind it, a ramp
into the same lane; 5,000 veh/h at the start, of which 600 leave by each exit, and 600 from each
ramp. `python benchmarks/corridors.py DIR/motorway.sumocfg` drives it; docs/CORRIDORS.md has the
results.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from random import Random

import sumo

NETCONVERT = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
LANES, LENGTH_M, INTERCHANGES = 3, 8000.0, 3
FIRST_M, BETWEEN_M = 800.0, 500.0
"""Lengths of the main road before the first exit lane, and between an exit and its ramp."""
SPEED_MPS, SIDE_SPEED_MPS, SIDE_M = 29.0, 25.0, 350.0
SIDE_VEH_PER_H = 600.0
SHORTEST = 0.2
"""Minimum headway as a share of the mean."""
TYPE = '<vType id="car" length="4.5" width="1.8" accel="2.6" decel="4.5"/>'


def main_edges(extra_m: float) -> Iterator[tuple[float, bool]]:
    """Yield length of the main edges, and whether they have a lane 0 beside the others."""
    yield FIRST_M, False
    after_m = (LENGTH_M - FIRST_M) / INTERCHANGES - BETWEEN_M - 2.0 * extra_m
    for _ in range(INTERCHANGES):
        yield from ((extra_m, True), (BETWEEN_M, False), (extra_m, True), (after_m, False))


def write_network(folder: Path, extra_m: float) -> None:
    """Write the network with netconvert."""
    nodes, edges, connections = ['<node id="n0" x="0" y="0"/>'], list[str](), list[str]()

    def edge(name: str, begin: str, end: str, lanes: int, speed_mps: float) -> None:
        text = f'<edge id="{name}" from="{begin}" to="{end}" numLanes="{lanes}" '
        edges.append(f'{text}priority="9" speed="{speed_mps}"/>')

    def connect(before: str, after: str, lanes: Sequence[tuple[int, int]]) -> None:
        connections.extend(
            f'<connection from="{before}" to="{after}" fromLane="{a}" toLane="{b}"/>'
            for a, b in lanes
        )

    x_m, parts = 0.0, [*main_edges(extra_m)]
    for number, (length_m, extra) in enumerate(parts):
        x_m += length_m
        nodes.append(f'<node id="n{number + 1}" x="{x_m}" y="0" type="priority"/>')
        edge(f"e{number}", f"n{number}", f"n{number + 1}", LANES + extra, SPEED_MPS)
        interchange, part = divmod(number - 1, 4)
        if part == 0:  # the edge before an exit
            nodes.append(f'<node id="x{interchange}" x="{x_m + SIDE_M}" y="-60"/>')
            out = f"off{interchange}"
            edge(out, f"n{number + 1}", f"x{interchange}", 1, SIDE_SPEED_MPS)
            connect(f"e{number}", out, [(0, 0)])
        if part == 2:  # the edge behind a ramp
            nodes.append(f'<node id="r{interchange}" x="{x_m - extra_m - SIDE_M}" y="-100"/>')
            edge(f"on{interchange}", f"r{interchange}", f"n{number}", 1, SIDE_SPEED_MPS)
            connect(f"on{interchange}", f"e{number}", [(0, 0)])
    for (before, (_, had)), (after, (_, has)) in pairwise(enumerate(parts)):
        pairs = [(lane + had, lane + has) for lane in range(LANES)]
        connect(f"e{before}", f"e{after}", pairs)
    files = {"nodes": nodes, "edges": edges, "connections": connections}
    for root, elements in files.items():
        text = "\n".join([f"<{root}>", *elements, f"</{root}>"])
        (folder / f"{root}.xml").write_text(text, encoding="utf-8")
    command = [str(NETCONVERT), "-n", "nodes.xml", "-e", "edges.xml", "-x", "connections.xml"]
    subprocess.run([*command, "-o", "motorway.net.xml"], cwd=folder, check=True)  # noqa: S603


def vehicles(
    duration_s: float, volume_veh_per_h: float, rng: Random
) -> Iterator[tuple[float, str]]:
    """Yield (departure [s], XML element)."""
    edges = [f"e{number}" for number in range(1 + 4 * INTERCHANGES)]
    through = volume_veh_per_h - INTERCHANGES * SIDE_VEH_PER_H
    flows = [("main", through, edges)]
    for number in range(INTERCHANGES):
        flows += [
            (f"off{number}", SIDE_VEH_PER_H, [*edges[: 2 + 4 * number], f"off{number}"]),
            (f"on{number}", SIDE_VEH_PER_H, [f"on{number}", *edges[3 + 4 * number :]]),
        ]
    for name, per_h, route in flows:
        mean_s = 3600.0 / per_h
        t_s = rng.uniform(0.0, mean_s)
        while t_s < duration_s:
            departure = f'depart="{t_s:.2f}" departPos="base" departLane="best" departSpeed="max"'
            own = f'<route edges="{" ".join(route)}"/>'
            yield t_s, f'<vehicle id="{name}.{t_s:.2f}" type="car" {departure}>{own}</vehicle>'
            t_s += SHORTEST * mean_s + rng.expovariate(1.0 / ((1.0 - SHORTEST) * mean_s))


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--duration", type=float, default=600.0, help="of the demand [s]")
    parser.add_argument("--volume", type=float, default=5000.0, help="at the start [veh/h]")
    parser.add_argument("--lane", type=float, default=250.0, help="length of lane 0 [m]")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    write_network(args.folder, args.lane)
    found = sorted(vehicles(args.duration, args.volume, Random(args.seed)))  # noqa: S311
    routes = "\n".join(["<routes>", TYPE, *(text for _, text in found), "</routes>"])
    (args.folder / "motorway.rou.xml").write_text(routes, encoding="utf-8")
    (args.folder / "motorway.sumocfg").write_text(
        '<configuration><input><net-file value="motorway.net.xml"/>'
        '<route-files value="motorway.rou.xml"/></input>'
        f'<time><begin value="0"/><end value="{args.duration:g}"/><step-length value="0.5"/>'
        "</time></configuration>",
        encoding="utf-8",
    )
    sys.stdout.write(f"{len(found)} vehicles; corridor e0:e{4 * INTERCHANGES}\n")


if __name__ == "__main__":
    main()
