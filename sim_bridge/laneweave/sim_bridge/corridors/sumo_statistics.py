"""Reads SUMO's own statistics of a run: trips, collisions, teleports, emissions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
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
    duration_s: float
    """From its departure to its arrival."""
    arrival_s: float
    arrival_edge: str = ""
    """Edge on which it has arrived."""
    fuel_g: float | None = None
    """None: emissions were not computed."""


@frozen
class Conflict:
    """Two vehicles with a short time to collision."""

    vehicle: str
    other: str
    least_ttc_s: float
    """Least time to collision."""
    at_s: float
    """When it was reached."""


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
    trips = dict[str, SumoTrip]()
    for _, element in ET.iterparse(folder / TRIPS_FILE):  # noqa: S314 (SUMO has written it)
        if element.tag == "tripinfo":
            trip = _trip(element)
            if trip.arrival_s >= 0.0:
                trips[element.get("id", "")] = trip
            element.clear()
    found = ET.parse(folder / STATISTICS_FILE).getroot()  # noqa: S314 (SUMO has written it)
    safety, teleports = found.find("safety"), found.find("teleports")
    return SumoStatistics(
        trips,
        collisions=_collisions(folder / COLLISIONS_FILE),
        teleports=_count(teleports, "total"),
        emergency_brakings=_count(safety, "emergencyBraking"),
        conflicts=tuple(
            {
                (*sorted((one.vehicle, one.other)), one.at_s): one
                for one in _conflicts(folder / CONFLICTS_FILE)
            }.values()
        ),
    )


def _collisions(file: Path) -> int:
    found = ET.iterparse(file)  # noqa: S314 (SUMO has written it)
    return sum(element.tag == "collision" for _, element in found)


def _conflicts(file: Path) -> Iterator[Conflict]:
    """Yield the conflicts in the output of SUMO's device."""
    for _, element in ET.iterparse(file):  # noqa: S314 (SUMO has written it)
        if element.tag != "conflict":
            continue
        least = element.find("minTTC")
        if least is not None and least.get("value", "NA") != "NA":
            yield Conflict(
                element.get("ego", ""),
                element.get("foe", ""),
                float(least.get("value", "nan")),
                float(least.get("time", "nan")),
            )
        element.clear()


def _trip(element: ET.Element) -> SumoTrip:
    def number(name: str) -> float:
        return float(element.get(name, "0"))

    emissions = element.find("emissions")
    fuel_g = None if emissions is None else float(emissions.get("fuel_abs", "0")) / 1000.0
    return SumoTrip(
        number("depart"),
        number("duration"),
        float(element.get("arrival", "-1")),
        element.get("arrivalLane", "").rpartition("_")[0],
        fuel_g,
    )


def _count(element: ET.Element | None, name: str) -> int:
    return 0 if element is None else int(element.get(name, "0"))
