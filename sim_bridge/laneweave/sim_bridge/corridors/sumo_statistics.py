"""Reads SUMO's own statistics of a run: trips, collisions, teleports, emissions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

from attrs import frozen

TRIPS_FILE = "tripinfo.xml"
STATISTICS_FILE = "statistics.xml"


@frozen
class SumoTrip:
    """The trip of a vehicle that has arrived."""

    depart_s: float
    duration_s: float
    """From its departure to its arrival."""
    arrival_s: float
    fuel_g: float | None = None
    """None: emissions were not computed."""


@frozen
class SumoStatistics:
    """The statistics of a run."""

    trips: Mapping[str, SumoTrip]
    """Trips of vehicles that have arrived, by name."""
    collisions: int
    teleports: int
    emergency_brakings: int


def read_statistics(folder: Path) -> SumoStatistics:
    """Read the statistics in a folder.

    Raises:
        OSError: a file cannot be read.
    """
    trips = {}
    for _, element in ET.iterparse(folder / TRIPS_FILE):  # noqa: S314 (SUMO has written it)
        if element.tag == "tripinfo":
            # Vehicles that have been taken out of SUMO have not arrived.
            if float(element.get("arrival", "-1")) >= 0.0 and not element.get("vaporized"):
                trips[element.get("id", "")] = _trip(element)
            element.clear()
    found = ET.parse(folder / STATISTICS_FILE).getroot()  # noqa: S314 (SUMO has written it)
    safety, teleports = found.find("safety"), found.find("teleports")
    return SumoStatistics(
        trips,
        collisions=_count(safety, "collisions"),
        teleports=_count(teleports, "total"),
        emergency_brakings=_count(safety, "emergencyBraking"),
    )


def _trip(element: ET.Element) -> SumoTrip:
    def number(name: str) -> float:
        return float(element.get(name, "0"))

    emissions = element.find("emissions")
    fuel_g = None if emissions is None else float(emissions.get("fuel_abs", "0")) / 1000.0
    return SumoTrip(
        number("depart"),
        number("duration"),
        number("arrival"),
        fuel_g,
    )


def _count(element: ET.Element | None, name: str) -> int:
    return 0 if element is None else int(element.get(name, "0"))
