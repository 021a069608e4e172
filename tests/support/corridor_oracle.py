"""An oracle for runs on corridors: it reads recordings and SUMO's output, and no bridge code."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pyarrow.parquet as pq

Size = tuple[float, float]
"""Length and width [m]."""
TOLERANCE_M = 0.05
"""By how much bodies may overlap in the oracle, which ignores their headings."""


def problems(run: Path, corridor: str, routes: Path, sizes: Mapping[str, Size]) -> list[str]:
    """Return what is wrong in a recorded run; empty: nothing.

    Args:
        run: folder of the run.
        corridor: FIRST_EDGE:LAST_EDGE.
        routes: SUMO's file of routes, whose vehicles have routes of their own.
        sizes: sizes of the types of vehicles in this file.
    """
    vehicles = {
        one.attrib["id"]: one
        for one in ET.parse(routes).iter("vehicle")  # noqa: S314
    }
    size = {name: sizes[one.attrib["type"]] for name, one in vehicles.items()}
    ways = {
        name: one.find("route").attrib["edges"].split()  # type: ignore[union-attr]
        for name, one in vehicles.items()
    }
    return [*_overlaps(run, size), *_without_agents(run), *_wrong_ends(run, corridor, ways)]


def _overlaps(run: Path, sizes: Mapping[str, Size]) -> Iterator[str]:
    """Yield the pairs of bodies whose rectangles overlap at a tick."""
    trips = pq.read_table(run / "trips.parquet").to_pylist()
    size = {one["vehicle"]: sizes[one["sumo_id"]] for one in trips}
    longest_m = max(length_m for length_m, _ in sizes.values())
    rows = pq.read_table(run / "trajectories.parquet", columns=["t_s", "vehicle", "s_m", "y_m"])
    ticks: dict[float, list[tuple[float, float, str]]] = defaultdict(list)
    for row in rows.to_pylist():
        ticks[row["t_s"]].append((row["s_m"], row["y_m"], row["vehicle"]))
    found = set[tuple[str, str]]()
    for bodies in ticks.values():
        bodies.sort()
        for number, (s_m, y_m, one) in enumerate(bodies):
            for ahead_m, beside_m, other in bodies[number + 1 :]:
                if ahead_m - longest_m >= s_m:
                    break
                half_m = 0.5 * (size[one][1] + size[other][1])
                if (
                    ahead_m - size[other][0] < s_m - TOLERANCE_M
                    and abs(y_m - beside_m) < half_m - TOLERANCE_M
                ):
                    found.add((one, other))
    for pair in sorted(found):
        yield f"bodies overlap: {pair}"


def _without_agents(run: Path) -> Iterator[str]:
    wrong = {"agent-missing", "agent-silent", "caretaker-took-over"}
    for line in (run / "events.jsonl").read_text(encoding="utf-8").splitlines():
        event = json.loads(line)
        if event["kind"] in wrong:
            yield f"{event['kind']}: {event.get('vehicle')} at {event['t_s']:.1f} s"


def _wrong_ends(run: Path, corridor: str, routes: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield the vehicles that SUMO does not report at the ends of their routes."""
    ends = {
        one.attrib["id"]: one.attrib["arrivalLane"].rpartition("_")[0]
        for one in ET.parse(run / "tripinfo.xml").iter("tripinfo")  # noqa: S314
    }
    first, last = corridor.split(":")
    for name, route in routes.items():
        crosses = first in route or last in route
        if crosses and ends.get(name) != route[-1]:
            yield f"{name} has arrived on {ends.get(name) or 'no edge'}, not on {route[-1]}"
