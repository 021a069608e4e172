"""Reads SUMO's own statistics of a run: trips, collisions, teleports, emissions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

from attrs import frozen

TRIPS_FILE = "tripinfo.xml"
STATISTICS_FILE = "statistics.xml"
COLLISIONS_FILE = "collisions.xml"
CONFLICTS_FILE = "ssm.xml"
"""Output of SUMO's device for surrogate safety measures."""
CONFLICT_S = 1.5
"""Time to collision below which two vehicles are in conflict (Hayward 1972)."""
CONFLICT_RANGE_M = 30.0
"""Distance within which SUMO looks for vehicles that a vehicle may collide with."""


def output_options(results: Path | None, folder: Path, edges: Iterable[str]) -> Mapping[str, str]:
    """Return the options with which SUMO writes these statistics.

    Args:
        results: folder for the statistics; None: none are written.
        folder: folder for temporary files.
        edges: edges on which SUMO reports short times to collision.
    """
    if results is None:
        return {}
    # In a queue, the device keeps all pairs of vehicles, tick by tick: 20 GB in half an hour.
    names = folder / "conflicts.txt"
    names.write_text("".join(f"edge:{name}\n" for name in sorted(edges)), encoding="utf-8")
    return {
        "tripinfo-output": str(results / TRIPS_FILE),
        "statistic-output": str(results / STATISTICS_FILE),
        "collision-output": str(results / COLLISIONS_FILE),
        "device.emissions.probability": "1",
        "device.ssm.probability": "1",
        "device.ssm.file": str(results / CONFLICTS_FILE),
        "device.ssm.measures": "TTC",
        "device.ssm.thresholds": f"{CONFLICT_S:g}",
        "device.ssm.trajectories": "false",
        "device.ssm.range": f"{CONFLICT_RANGE_M:g}",
        "device.ssm.filter-edges.input-file": str(names),
    }


@frozen
class SumoTrip:
    """The trip of a vehicle that has arrived."""

    depart_s: float
    arrival_s: float
    arrival_edge: str = ""
    """Edge on which it has arrived."""
    fuel_g: float | None = None
    """None: emissions were not computed."""


class Conflict(NamedTuple):
    """Two vehicles with a short time to collision, their names sorted."""

    vehicles: tuple[str, ...]
    at_s: float
    """When the time was lowest."""
    min_ttc_s: float
    """Lowest time to collision."""


@frozen
class SumoStatistics:
    """The statistics of a run."""

    trips: Mapping[str, SumoTrip]
    """Trips of vehicles that have arrived, by name."""
    collisions: int
    teleports: int
    emergency_brakings: int
    conflicts: tuple[Conflict, ...] = ()
    """Conflicts of vehicles that SUMO displays, each of a pair once."""


def read_statistics(folder: Path) -> SumoStatistics:
    """Read the statistics in a folder.

    Raises:
        OSError: a file cannot be read.
    """
    found = ET.parse(folder / STATISTICS_FILE).getroot()  # noqa: S314 (SUMO has written it)
    conflicts = (_conflict(one) for one in _elements(folder / CONFLICTS_FILE, "conflict"))
    return SumoStatistics(
        {
            one.attrib["id"]: _trip(one)
            for one in _elements(folder / TRIPS_FILE, "tripinfo")
            if float(one.get("arrival", "-1")) >= 0.0
        },
        collisions=sum(1 for _ in _elements(folder / COLLISIONS_FILE, "collision")),
        teleports=_count(found.find("teleports"), "total"),
        emergency_brakings=_count(found.find("safety"), "emergencyBraking"),
        conflicts=tuple({one[:2]: one for one in conflicts if one is not None}.values()),
    )


def _elements(file: Path, tag: str) -> Iterator[ET.Element]:
    """Yield the elements with a tag; SUMO has written the file."""
    for _, element in ET.iterparse(file):  # noqa: S314
        if element.tag == tag:
            yield element
            element.clear()


def _conflict(element: ET.Element) -> Conflict | None:
    """Return a conflict in the output of SUMO's device; None: the two were never in conflict."""
    lowest = element.find("minTTC")
    if lowest is None or lowest.get("value", "NA") == "NA":
        return None
    vehicles = tuple(sorted((element.get("ego", ""), element.get("foe", ""))))
    return Conflict(vehicles, float(lowest.get("time", "nan")), float(lowest.get("value", "nan")))


def _trip(element: ET.Element) -> SumoTrip:
    emissions = element.find("emissions")
    return SumoTrip(
        float(element.get("depart", "0")),
        float(element.get("arrival", "-1")),
        element.get("arrivalLane", "").rpartition("_")[0],
        None if emissions is None else float(emissions.get("fuel_abs", "0")) / 1000.0,
    )


def _count(element: ET.Element | None, name: str) -> int:
    return 0 if element is None else int(element.get(name, "0"))
