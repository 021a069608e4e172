"""Corridors drawn at random, written with netconvert.

A drawn network is a main road of two to four lanes with on-ramps, exits, both or neither, in any
order, with any lengths: several interchanges one after another, ramps of two lanes, lanes that end
like a zipper, and exits whose lanes are open from the start of the network on. The corridor may
begin and end on any of its main edges, also on those with the lane of a ramp. Vehicles depart on
the first edge, upstream of it or on a ramp, anywhere on their edges.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from random import Random

import sumo
from attrs import define, field, frozen

from support import corridor_oracle

NETCONVERT = Path(sumo.SUMO_HOME) / "bin" / "netconvert"
DEMAND_S = 60
KINDS = (
    "plain",
    "ramp",
    "exit",
    "ramp-exit",
    "exit-ramp",
    "weaving",
    "exit-exit",
    "ramp-ramp",
    "exit-ramp-exit-ramp",
    "ramp-weaving-ramp",
    "drop",
    "drop-ramp",
    "drop-ramp-exit-ramp",
    "wide",
    "exit-wide-exit",
    "zipper",
    "zipper-exit-ramp",
)
"""Parts of the main road, in order.

`drop`: an exit whose lane is open from the start on; `wide`: a ramp of two lanes; `zipper`: a lane
that is open from the start on merges with the next one.
"""
CAR, TRUCK = (4.5, 1.8), (7.1, 2.4)
"""(length, width) [m] of the drawn types."""


@frozen
class DrawnCorridor:
    """A simulation, and the corridor in it."""

    config: Path
    name: str
    """FIRST_EDGE:LAST_EDGE."""
    text: str
    """What it is, in a few words."""


@define
class _Main:
    """The main road while it is drawn."""

    rng: Random
    lanes: int
    speed_mps: float
    nodes: list[str] = field(factory=list)
    edges: list[str] = field(factory=list)
    connections: list[str] = field(factory=list)
    main: list[str] = field(factory=list)
    """Names of the main edges."""
    exits: list[tuple[str, int]] = field(factory=list)
    """Names of the exits' edges, and the numbers of the main edges before."""
    ramps: list[tuple[str, int]] = field(factory=list)
    """Names of the ramps' first edges, and the numbers of the main edges behind."""
    x_m: float = 0.0

    def node(self, x_m: float, y_m: float = 0.0, kind: str = "priority") -> str:
        name = f"n{len(self.nodes)}"
        self.nodes.append(f'<node id="{name}" x="{x_m:.2f}" y="{y_m:.2f}" type="{kind}"/>')
        return name

    def edge(self, name: str, begin: str, end: str, lanes: int, speed_mps: float = 0.0) -> str:
        self.edges.append(
            f'<edge id="{name}" from="{begin}" to="{end}" numLanes="{lanes}" priority="9" '
            f'speed="{speed_mps or self.speed_mps:.2f}"/>'
        )
        return name

    def connect(self, before: str, after: str, pairs: Sequence[tuple[int, int]]) -> None:
        self.connections += [
            f'<connection from="{before}" to="{after}" fromLane="{a}" toLane="{b}"/>'
            for a, b in pairs
        ]

    def extend(self, length_m: float, *, extra: int = 0, ends: str = "priority") -> str:
        """Add a main edge with `extra` lanes on the right; `ends`: type of the junction behind."""
        begin = self.node(self.x_m) if not self.nodes else f"n{self.last}"
        self.x_m += length_m
        end = self.node(self.x_m, kind=ends)
        self.last = int(end[1:])
        name = self.edge(f"e{len(self.main)}", begin, end, self.lanes + extra)
        self.main.append(name)
        return name

    last: int = 0


def draw_corridor(seed: int, folder: Path) -> DrawnCorridor:
    """Write the files of a drawn simulation."""
    rng = Random(seed)
    main = _Main(rng, rng.choice((2, 2, 3, 3, 4)), rng.choice((16.67, 22.22, 27.78)))
    kind = rng.choice(KINDS)
    _draw_road(main, kind)
    first, last = _draw_ends(main)
    left_hand = rng.random() < 0.1
    _netconvert(main, folder, left_hand=left_hand)
    vehicles = sorted(_draw_vehicles(main, first))
    types = (
        f'<vType id="car" length="{CAR[0]}" width="{CAR[1]}" accel="2.6" decel="4.5"/>'
        f'<vType id="truck" vClass="truck" length="{TRUCK[0]}" width="{TRUCK[1]}" accel="1.3"'
        ' decel="4" maxSpeed="36"/>'
    )
    routes = "\n".join(["<routes>", types, *(text for _, text in vehicles), "</routes>"])
    (folder / "drawn.rou.xml").write_text(routes, encoding="utf-8")
    config = folder / "drawn.sumocfg"
    step_s = rng.choice((0.2, 0.5, 1.0))
    config.write_text(
        '<configuration><input><net-file value="drawn.net.xml"/>'
        '<route-files value="drawn.rou.xml"/></input>'
        f'<time><begin value="0"/><end value="{DEMAND_S}"/><step-length value="{step_s}"/></time>'
        "</configuration>",
        encoding="utf-8",
    )
    name = f"{main.main[first]}:{main.main[last]}"
    text = f"{kind}, {main.lanes} lanes, {main.speed_mps} m/s, {name}, {len(vehicles)} vehicles"
    return DrawnCorridor(config, name, text + (", left-hand" if left_hand else ""))


def _draw_road(main: _Main, kind: str) -> None:
    """Draw the edges: a feature needs lanes that are long enough for the speed."""
    rng = main.rng
    per_mps = main.speed_mps / 27.78
    parts = kind.split("-")
    drop = int(parts[0] in ("drop", "zipper"))
    for _ in range(rng.choice((0, 0, 1, 2))):
        main.extend(rng.uniform(120.0, 400.0), extra=drop)
    ends = "zipper" if parts[0] == "zipper" else "priority"
    main.extend(rng.uniform(350.0, 700.0), extra=drop, ends=ends)
    for before, after in pairwise(main.main):
        main.connect(before, after, [(n, n) for n in range(main.lanes + drop)])
    for part in parts:
        if part != "plain":
            _draw_part(main, part, per_mps)
    for _ in range(rng.choice((0, 0, 1))):
        main.extend(rng.uniform(60.0, 300.0))
    for before, after in pairwise(main.main):
        if not any(f'from="{before}" to="{after}"' in one for one in main.connections):
            main.connect(before, after, [(n, n) for n in range(main.lanes)])


def _draw_part(main: _Main, part: str, per_mps: float) -> None:
    """Draw a ramp, exit or merge, and the main edge behind it."""
    rng, lanes = main.rng, range(main.lanes)
    if part == "wide":
        _draw_wide_ramp(main)
    if part in ("drop", "zipper", "wide"):
        extra = main.main[-1]
    else:
        if part in ("ramp", "weaving"):
            _draw_ramp(main)
        extra = main.extend(per_mps * rng.uniform(260.0, 480.0), extra=1)
        main.connect(main.main[-2], extra, [(n, n + 1) for n in lanes])
    if part in ("ramp", "weaving"):
        main.connect(main.ramps[-1][0].replace("far", "on"), extra, [(0, 0)])
    if part in ("exit", "weaving", "drop"):
        out = f"off{len(main.exits)}"
        end = main.node(main.x_m + 250.0, -60.0)
        main.edge(out, f"n{main.last}", end, 1, main.speed_mps * rng.choice((0.8, 1.0)))
        main.exits.append((out, len(main.main) - 1))
        main.connect(extra, out, [(0, 0)])
    after = main.extend(rng.uniform(320.0, 600.0))
    main.connect(extra, after, [(n + 1, n) for n in lanes])
    if part == "zipper":
        main.connect(extra, after, [(0, 0)])


def _draw_wide_ramp(main: _Main) -> None:
    """Draw an on-ramp of two lanes, which end one after the other, the right one first."""
    length_m = main.speed_mps * main.rng.uniform(10.0, 16.0)
    _draw_ramp(main, lanes=2)
    both = main.extend(length_m, extra=2)
    main.connect(main.main[-2], both, [(n, n + 2) for n in range(main.lanes)])
    main.connect(main.ramps[-1][0].replace("far", "on"), both, [(0, 0), (1, 1)])
    left = main.extend(length_m, extra=1)
    main.connect(both, left, [(n + 1, n) for n in range(main.lanes + 1)])


def _draw_ramp(main: _Main, lanes: int = 1) -> None:
    """Draw an on-ramp of one or two edges to the present end of the main road."""
    rng, number = main.rng, len(main.ramps)
    length_m, speed_mps = rng.uniform(150.0, 330.0), main.speed_mps * rng.choice((0.8, 1.0))
    middle = main.node(main.x_m - length_m, -0.3 * length_m)
    main.edge(f"on{number}", middle, f"n{main.last}", lanes, speed_mps)
    name = f"on{number}"
    if rng.random() < 0.5:
        far = main.node(main.x_m - length_m - rng.uniform(60.0, 250.0), -0.6 * length_m)
        name = main.edge(f"far{number}", far, middle, lanes, speed_mps)
    main.ramps.append((name, len(main.main)))


def _draw_ends(main: _Main) -> tuple[int, int]:
    """Return the numbers of the first and the last main edge of a corridor."""
    rng = main.rng
    special = {number for _, number in (*main.exits, *main.ramps)}
    firsts = [n for n in range(len(main.main)) if n <= min(special, default=len(main.main))]
    first = rng.choice((0, firsts[-1], rng.choice(firsts)))
    last_exit = max((number for _, number in main.exits), default=-1)
    last_ramp = max((number for _, number in main.ramps), default=-1)
    lasts = [
        n for n in range(first, len(main.main)) if n > last_exit and n >= max(last_ramp, first)
    ]
    return first, rng.choice((lasts[0], lasts[-1], rng.choice(lasts)))


def _draw_vehicles(main: _Main, first: int) -> Iterator[tuple[float, str]]:
    """Yield (departure, XML element)."""
    rng = main.rng
    trucks = rng.choice((0.0, 0.1, 0.25))
    to_exit = rng.uniform(0.05, 0.25)
    for lane in range(main.lanes):
        t_s = rng.uniform(0.0, 5.0)
        mean_s = 3600.0 / rng.uniform(300.0, 1300.0)
        while round(t_s, 2) < DEMAND_S:
            begin = rng.choice((0, 0, first))
            route = main.main[begin:]
            if main.exits and rng.random() < to_exit:
                out, number = rng.choice(main.exits)
                route = [*main.main[begin : number + 1], out]
            kind = "truck" if rng.random() < trucks else "car"
            at = rng.choice(("base", "base", "random", "last"))
            yield t_s, _vehicle(f"m{lane}#{t_s:.1f}", kind, t_s, route, at)
            t_s += 1.0 + rng.expovariate(1.0 / max(mean_s - 1.0, 0.5))
    for name, number in main.ramps:
        t_s, mean_s = rng.uniform(0.0, 9.0), 3600.0 / rng.uniform(100.0, 450.0)
        while round(t_s, 2) < DEMAND_S:
            edges = [name, *([name.replace("far", "on")] if name.startswith("far") else [])]
            if rng.random() < 0.2:
                edges = edges[-1:]
            later = [one for one in main.exits if one[1] >= number]
            route = [*edges, *main.main[number:]]
            if later and rng.random() < 0.2:
                out, until = rng.choice(later)
                route = [*edges, *main.main[number : until + 1], out]
            kind = "truck" if rng.random() < 0.5 * trucks else "car"
            at = rng.choice(("base", "base", "random", "last"))
            yield t_s, _vehicle(f"{name}.{t_s:.1f}", kind, t_s, route, at)
            t_s += 2.0 + rng.expovariate(1.0 / mean_s)


def _vehicle(name: str, kind: str, depart_s: float, route: Sequence[str], at: str) -> str:
    return (
        f'<vehicle id="{name}" type="{kind}" depart="{depart_s:.2f}" departPos="{at}"'
        f' departLane="best" departSpeed="max"><route edges="{" ".join(route)}"/></vehicle>'
    )


def _netconvert(main: _Main, folder: Path, *, left_hand: bool) -> None:
    files = {"nod": main.nodes, "edg": main.edges, "con": main.connections}
    roots = {"nod": "nodes", "edg": "edges", "con": "connections"}
    for suffix, elements in files.items():
        text = "\n".join([f"<{roots[suffix]}>", *elements, f"</{roots[suffix]}>"])
        (folder / f"drawn.{suffix}.xml").write_text(text, encoding="utf-8")
    command = [str(NETCONVERT), "-n", "drawn.nod.xml", "-e", "drawn.edg.xml"]
    command += ["-x", "drawn.con.xml", "-o", "drawn.net.xml", "--no-turnarounds", "true"]
    command += ["--lefthand", "true"] if left_hand else []
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=60)


def problems(drawn: DrawnCorridor, run: Path) -> list[str]:
    """Return what is wrong in a recorded run on a drawn corridor; empty: nothing."""
    routes = drawn.config.with_name("drawn.rou.xml")
    return corridor_oracle.problems(run, drawn.name, routes, {"car": CAR, "truck": TRUCK})
