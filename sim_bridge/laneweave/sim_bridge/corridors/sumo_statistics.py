"""Reads SUMO's own statistics of a run: trips, collisions, teleports, emissions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

from attrs import frozen

TRIPS_FILE = "tripinfo.xml"
STATISTICS_FILE = "statistics.xml"
COLLISIONS_FILE = "collisions.xml"
CONFLICTS_FILE = "ssm.xml"
"""Output of SUMO's device for surrogate safety measures."""
AGAIN = "laneweave."
"""Beginning of the names of vehicles that SUMO has begun to drive, and begins again elsewhere."""
CONFLICT_S = 1.5
"""Time to collision below which two vehicles are in conflict (Hayward 1972)."""


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
    trips, taken_out = dict[str, SumoTrip](), dict[str, SumoTrip]()
    for _, element in ET.iterparse(folder / TRIPS_FILE):  # noqa: S314 (SUMO has written it)
        if element.tag == "tripinfo":
            name, trip = element.get("id", "").removeprefix(AGAIN), _trip(element)
            if element.get("vaporized"):
                taken_out[name] = trip
            elif trip.arrival_s >= 0.0:
                trips[name] = trip
            element.clear()
    found = ET.parse(folder / STATISTICS_FILE).getroot()  # noqa: S314 (SUMO has written it)
    safety, teleports = found.find("safety"), found.find("teleports")
    return SumoStatistics(
        trips,
        collisions=_collisions(folder / COLLISIONS_FILE, taken_out),
        teleports=_count(teleports, "total"),
        emergency_brakings=_count(safety, "emergencyBraking"),
        conflicts=tuple(
            {
                (*sorted((one.vehicle, one.other)), one.at_s): one
                for one in _conflicts(folder / CONFLICTS_FILE)
            }.values()
        ),
    )


def _collisions(file: Path, taken_out: Mapping[str, SumoTrip]) -> int:
    """Return the number of collisions of vehicles that were not being taken out.

    Args:
        file: SUMO's list of collisions.
        taken_out: vehicles that were taken out, by name.
    """

    def is_out(name: str | None, at_s: float) -> bool:
        trip = taken_out.get((name or "").removeprefix(AGAIN))
        if trip is None:
            return False
        # It lasts for one step, at whose beginning SUMO notes collisions.
        return trip.depart_s - trip.duration_s <= at_s <= trip.arrival_s

    found = 0
    for _, element in ET.iterparse(file):  # noqa: S314 (SUMO has written it)
        if element.tag == "collision":
            at_s, pair = float(element.get("time", "nan")), map(element.get, ("collider", "victim"))
            found += not any(is_out(name, at_s) for name in pair)
            element.clear()
    return found


def _conflicts(file: Path) -> Iterator[Conflict]:
    """Yield the conflicts in the output of SUMO's device."""
    for _, element in ET.iterparse(file):  # noqa: S314 (SUMO has written it)
        if element.tag != "conflict":
            continue
        least = element.find("minTTC")
        if least is not None and least.get("value", "NA") != "NA":
            yield Conflict(
                element.get("ego", "").removeprefix(AGAIN),
                element.get("foe", "").removeprefix(AGAIN),
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
        fuel_g,
    )


def _count(element: ET.Element | None, name: str) -> int:
    return 0 if element is None else int(element.get(name, "0"))
