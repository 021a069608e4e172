"""Small motorway interchanges as SUMO simulations.

An exit, and behind it an on-ramp (`EXIT_FIRST`):

    start (400 m, 3 lanes) -> main1 (700 m, 3) -> main2 (250 m, 4: lane 0 leads to the exit)
    -> main3 (160 m, 3) -> main4 (250 m, 4: lane 0 comes from the ramp, and ends)
    -> main5 (600 m, 3)

An on-ramp, and behind it an exit in the same lane (`RAMP_FIRST`):

    main1 (400 m, 2 lanes) -> main2 (300 m, 3: lane 0 comes from the ramp, and ends)
    -> main3 (300 m, 2) -> main4 (262 m, 3: lane 0 leads to the exit) -> main5 (200 m, 2)

The main road is straight, to the east; the exit and the ramp are beside it. The files are written
without netconvert, like those of `sim_bridge.sumo.network`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from attrs import frozen

from laneweave.launch.cli.corridor_command import corridor_tables
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.corridors.sumo_corridor import read_corridor
from laneweave.sim_bridge.corridors.sumo_simulation import WHOLE
from support.sharing import made_once

LANE_M = 3.2
CORRIDOR = "main1:main5"
LONGEST_CORRIDOR = "start:main5"
MAIN_SPEED_MPS, RAMP_SPEED_MPS = 27.78, 22.22


@frozen
class _Edge:
    name: str
    origin: str
    destination: str
    from_m: float
    to_m: float
    lanes: Sequence[float]
    """Centre lines of its lanes, from the right [m]."""
    speed_mps: float = MAIN_SPEED_MPS


def _centres(first: int, count: int, shift_m: float = 0.0) -> tuple[float, ...]:
    return tuple((lane + 0.5) * LANE_M + shift_m for lane in range(first, first + count))


@frozen
class Network:
    """Edges, and links between their lanes: (edge, lane, next edge, its lane)."""

    edges: tuple[_Edge, ...]
    links: tuple[tuple[str, int, str, int], ...]


_EDGES = (
    _Edge("start", "Z", "A", -400.0, 0.0, _centres(1, 3)),
    _Edge("main1", "A", "B", 0.0, 700.0, _centres(1, 3)),
    _Edge("main2", "B", "C", 700.0, 950.0, _centres(0, 4)),
    _Edge("main3", "C", "D", 950.0, 1110.0, _centres(1, 3)),
    _Edge("main4", "D", "E", 1110.0, 1360.0, _centres(0, 4)),
    _Edge("main5", "E", "F", 1360.0, 1960.0, _centres(1, 3)),
    _Edge("off", "C", "G", 950.0, 1250.0, _centres(0, 1, -20.0), RAMP_SPEED_MPS),
    _Edge("before", "H", "I", 510.0, 810.0, _centres(0, 1, -40.0), RAMP_SPEED_MPS),
    _Edge("on", "I", "D", 810.0, 1110.0, _centres(0, 1, -40.0), RAMP_SPEED_MPS),
)
_LINKS = (
    *(("start", lane, "main1", lane) for lane in range(3)),
    *(("main1", lane, "main2", lane + 1) for lane in range(3)),
    *(("main2", lane + 1, "main3", lane) for lane in range(3)),
    ("main2", 0, "off", 0),
    *(("main3", lane, "main4", lane + 1) for lane in range(3)),
    ("on", 0, "main4", 0),
    *(("main4", lane + 1, "main5", lane) for lane in range(3)),
    ("before", 0, "on", 0),
)
EXIT_FIRST = Network(_EDGES, _LINKS)
RAMP_FIRST = Network(
    (
        _Edge("main1", "A", "B", 0.0, 400.0, _centres(1, 2)),
        _Edge("main2", "B", "C", 400.0, 700.0, _centres(0, 3)),
        _Edge("main3", "C", "D", 700.0, 1000.0, _centres(1, 2)),
        _Edge("main4", "D", "E", 1000.0, 1262.0, _centres(0, 3)),
        _Edge("main5", "E", "F", 1262.0, 1462.0, _centres(1, 2)),
        _Edge("off", "E", "G", 1262.0, 1562.0, _centres(0, 1, -20.0), RAMP_SPEED_MPS),
        _Edge("before", "H", "I", -200.0, 100.0, _centres(0, 1, -40.0), RAMP_SPEED_MPS),
        _Edge("on", "I", "B", 100.0, 400.0, _centres(0, 1, -40.0), RAMP_SPEED_MPS),
    ),
    (
        *(("main1", lane, "main2", lane + 1) for lane in range(2)),
        *(("main2", lane + 1, "main3", lane) for lane in range(2)),
        *(("main3", lane, "main4", lane + 1) for lane in range(2)),
        *(("main4", lane + 1, "main5", lane) for lane in range(2)),
        ("main4", 0, "off", 0),
        ("on", 0, "main2", 0),
        ("before", 0, "on", 0),
    ),
)

FORK = Network(
    (
        _Edge("start", "Z", "A", -400.0, 0.0, _centres(0, 3)),
        _Edge("main1", "A", "B", 0.0, 900.0, _centres(0, 3)),
        _Edge("right", "B", "C", 900.0, 1200.0, _centres(0, 1, -20.0)),
        _Edge("ahead", "B", "D", 900.0, 1200.0, _centres(0, 2)),
        _Edge("left", "B", "E", 900.0, 1200.0, _centres(2, 1, 20.0)),
    ),
    (
        *(("start", lane, "main1", lane) for lane in range(3)),
        ("main1", 0, "right", 0),
        *(("main1", lane, "ahead", lane) for lane in range(2)),
        ("main1", 2, "left", 0),
    ),
)
"""An edge whose lanes lead to different edges."""
POCKET = Network(
    (
        _Edge("main1", "A", "B", 0.0, 800.0, _centres(0, 2)),
        _Edge("main2", "B", "C", 800.0, 930.0, _centres(0, 3)),
        _Edge("ahead", "C", "D", 930.0, 1200.0, _centres(0, 2)),
        _Edge("left", "C", "E", 930.0, 1200.0, _centres(2, 1, 20.0)),
    ),
    (
        *(("main1", lane, "main2", lane) for lane in range(2)),
        *(("main2", lane, "ahead", lane) for lane in range(2)),
        ("main2", 2, "left", 0),
    ),
)
"""A turn pocket, 130 m long, before a fork."""


def write_interchange(
    folder: Path,
    vehicles: Sequence[str] = (),
    *,
    types: str = "",
    network: Network = EXIT_FIRST,
) -> Path:
    """Write the files of the simulation, and return its configuration.

    Args:
        folder: their folder.
        vehicles: XML elements of vehicles, in order of departure.
        types: XML elements of types; the type `car` always exists.
        network: the road.
    """
    (folder / "small.net.xml").write_text("\n".join(_network(network)), encoding="utf-8")
    routes = ["<routes>", '<vType id="car" sigma="0"/>', types, *vehicles, "</routes>"]
    (folder / "small.rou.xml").write_text("\n".join(routes), encoding="utf-8")
    config = folder / "small.sumocfg"
    config.write_text(
        "<configuration><input>"
        '<net-file value="small.net.xml"/><route-files value="small.rou.xml"/>'
        '</input><time><begin value="0"/><end value="300"/><step-length value="0.5"/></time>'
        "</configuration>",
        encoding="utf-8",
    )
    return config


ROUTES = {
    "main": "main1 main2 main3 main4 main5",
    "exit": "main1 main2 off",
    "ramp": "before on main4 main5",
    "inside": "main3 main4 main5",
    "upstream": "start main1 main2 main3 main4 main5",
    "upstream exit": "start main1 main2 off",
    "late exit": "main1 main2 main3 main4 off",
    "early ramp": "before on main2 main3 main4 main5",
    **{turn: f"main1 {turn}" for turn in ("right", "ahead", "left")},
    **{f"upstream {turn}": f"start main1 {turn}" for turn in ("right", "ahead", "left")},
    **{f"pocket {turn}": f"main1 main2 {turn}" for turn in ("ahead", "left")},
}
"""Edges of routes; `late exit` and `early ramp` are for `RAMP_FIRST`, turns for `FORK`."""


def vehicle(name: str, depart_s: float, route: str, kind: str = "car") -> str:
    """Return the XML element of a vehicle; `route` is one of `ROUTES`."""
    edges = ROUTES[route]
    return (
        f'<vehicle id="{name}" type="{kind}" depart="{depart_s:.10g}" departSpeed="max">'
        f'<route edges="{edges}"/></vehicle>'
    )


def stream(duration_s: int) -> list[str]:
    """Return a mixed stream of vehicles: one per second on the main road, some by the ramp."""
    found = []
    for second in range(duration_s):
        kind = "truck" if second % 7 == 3 else "car"
        found.append(vehicle(f"m#{second}", second, "exit" if second % 9 == 4 else "main", kind))
        if second % 6 == 0:
            found.append(vehicle(f"r.{second}", second, "ramp"))
    return found


TRUCKS = '<vType id="truck" vClass="truck" length="7.1" accel="1.3" decel="4" sigma="0"/>'


DRIVEN_S = 15
"""Duration of the stream of `driven_interchange`."""


def scenario_of(config: Path, corridor: str = CORRIDOR) -> Scenario:
    """Return the scenario of the corridor of a simulation, for the whole of its demand."""
    return parse_scenario(corridor_tables(read_corridor(config, corridor), config, WHOLE))


def driven_interchange(factory: pytest.TempPathFactory) -> tuple[Scenario, Path]:
    """Return the scenario and the folder of a run in one process, which tests share."""

    def drive(folder: Path) -> None:
        (folder / "files").mkdir(parents=True)
        config = write_interchange(folder / "files", stream(DRIVEN_S), types=TRUCKS)
        outcome = SimulatedRun(scenario_of(config), folder / "run", show_progress=False).run()
        assert not outcome.problems

    folder = made_once(factory, "interchange", drive)
    return scenario_of(folder / "files" / "small.sumocfg"), folder / "run"


def _network(network: Network) -> Iterator[str]:
    edges, links = network.edges, network.links
    yield '<net version="1.20">'
    bounds = f"{min(edge.from_m for edge in edges)},-60,{max(edge.to_m for edge in edges)},20"
    yield f'<location netOffset="0,0" convBoundary="{bounds}" origBoundary="{bounds}"'
    yield ' projParameter="!"/>'
    for edge in edges:
        yield f'<edge id="{edge.name}" from="{edge.origin}" to="{edge.destination}" priority="1">'
        for index, y_m in enumerate(edge.lanes):
            yield (
                f'<lane id="{edge.name}_{index}" index="{index}" speed="{edge.speed_mps}"'
                f' length="{edge.to_m - edge.from_m}" width="{LANE_M}"'
                f' shape="{edge.from_m},{y_m} {edge.to_m},{y_m}"/>'
            )
        yield "</edge>"
    nodes = {edge.origin: edge.from_m for edge in edges}
    nodes |= {edge.destination: edge.to_m for edge in edges}
    for node, x_m in nodes.items():
        coming = [edge for edge in edges if edge.destination == node]
        names = " ".join(
            f"{edge.name}_{lane}" for edge in coming for lane in range(len(edge.lanes))
        )
        count = sum(before in {edge.name for edge in coming} for before, *_ in links)
        yield (
            f'<junction id="{node}" type="{"priority" if count else "dead_end"}" x="{x_m}" y="20"'
            f' incLanes="{names}" intLanes="" shape="{x_m},-60 {x_m},20">'
        )
        for number in range(count):
            none = "0" * count
            yield f'<request index="{number}" response="{none}" foes="{none}" cont="0"/>'
        yield "</junction>"
    for before, from_lane, after, to_lane in links:
        yield (
            f'<connection from="{before}" to="{after}" fromLane="{from_lane}" toLane="{to_lane}"'
            ' dir="s" state="M"/>'
        )
    yield "</net>"
