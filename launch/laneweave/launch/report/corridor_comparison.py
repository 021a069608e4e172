"""A run on a corridor beside the same simulation driven by SUMO alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

from attrs import frozen

from laneweave.launch.report.page import Section, render_page
from laneweave.launch.report.tables import Table
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.files import write_atomically
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.summary import HARD_BRAKE_MPS2, read_summary
from laneweave.sim_bridge.corridors.corridor_setup import CorridorArrival
from laneweave.sim_bridge.corridors.sumo_statistics import (
    CONFLICT_S,
    SumoStatistics,
    read_statistics,
)
from laneweave.sim_bridge.road_sources import corridor_setup

ALONE_FOLDER = "sumo-alone"
PAGE_FILE = "comparison.html"
METHODS = ("laneweave", "SUMO alone")
_ROUTES = {MAIN_ENTRANCE: "start of the corridor", END_OF_ROAD: "end of the corridor"}


@frozen
class RouteTimes:
    """Vehicles with the same entrance and destination."""

    entrance: str
    destination: str
    vehicles: int
    arrived: tuple[int, ...]
    """Number that has arrived where the route ends, for each method."""
    elsewhere: tuple[int, ...]
    """Number that has arrived on another edge, for each method."""
    mean_s: tuple[float | None, ...]
    """Mean trip with the delay before departure [s], for each method."""
    fuel_g: tuple[float | None, ...]
    """Mean fuel, for each method."""


def compare(
    scenario: Scenario, folder: Path, progress: Callable[[float], None] = lambda _: None
) -> Sequence[RouteTimes]:
    """Run SUMO alone, and write the page that compares it with the run in a folder.

    Raises:
        CommandFailedError: SUMO rejects a file.
    """
    alone = folder / ALONE_FOLDER
    alone.mkdir(exist_ok=True)
    with temporary_folder("sumo") as temporary:
        setup = corridor_setup(scenario)
        setup.drive_alone(temporary, alone, progress)
    found = read_statistics(folder), read_statistics(alone)
    routes = _by_route(setup.arrivals, found)
    tables = [_times_table(routes), _events_table(found), _shortfalls_table(folder, routes)]
    lead = f"Corridor {scenario.sumo.corridor} of {scenario.sumo.config}, seed {scenario.seed}."
    page = render_page("laneweave and SUMO alone", lead, [Section("Trips", tables)])
    write_atomically(folder / PAGE_FILE, page)
    return routes


def _by_route(
    arrivals: Sequence[CorridorArrival], found: Sequence[SumoStatistics]
) -> list[RouteTimes]:
    """Return the times of all pairs of entrance and destination, the most frequent first."""
    groups: dict[tuple[str, str], list[CorridorArrival]] = {}
    for one in arrivals:
        groups.setdefault((one.origin.entrance, one.origin.destination), []).append(one)
    routes = []
    for (entrance, destination), own in sorted(groups.items(), key=lambda item: -len(item[1])):
        ended = [
            [
                (each.trips[one.origin.vehicle.name], one.origin.vehicle)
                for one in own
                if one.origin.vehicle.name in each.trips
            ]
            for each in found
        ]
        trips = [
            [
                (trip, vehicle.depart_s)
                for trip, vehicle in each
                if trip.arrival_edge == vehicle.route[-1]
            ]
            for each in ended
        ]
        routes.append(
            RouteTimes(
                entrance,
                destination,
                len(own),
                tuple(map(len, trips)),
                tuple(len(all_) - len(right) for all_, right in zip(ended, trips, strict=True)),
                # SUMO sees a vehicle of laneweave when it enters, with a delay of 0.
                tuple(_mean([trip.arrival_s - s for trip, s in each]) for each in trips),
                tuple(_mean([trip.fuel_g or 0.0 for trip, _ in each]) for each in trips),
            )
        )
    return routes


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None


def _times_table(routes: Sequence[RouteTimes]) -> Table:
    """Return the table of trips by entrance and destination."""
    headings = ["from", "to", "vehicles"]
    for what in ("arrived", "arrived elsewhere", "trip and delay [s]", "fuel [g]"):
        headings += [f"{what}, {method}" for method in METHODS]
    rows = [
        [
            _ROUTES.get(one.entrance, one.entrance),
            _ROUTES.get(one.destination, one.destination),
            f"{one.vehicles}",
            *(f"{count}" for count in (*one.arrived, *one.elsewhere)),
            *map(_shown, one.mean_s),
            *map(_shown, one.fuel_g),
        ]
        for one in routes
    ]
    caption = (
        "Mean trip from departure to arrival, with the delay before departure, of the vehicles "
        "that have arrived where their routes end"
    )
    return Table(headings, rows, caption, 2)


def _shortfalls_table(folder: Path, routes: Sequence[RouteTimes]) -> Table:
    """Return the table of vehicles that were not driven as they should, or not at all."""
    summary = read_summary(folder)
    if summary is None:
        raise CommandFailedError(f"{folder} has no summary of a run")
    vehicles, safety = summary.vehicles, summary.safety
    rows = [
        ["missed exits", f"{vehicles.missed_exits}", "-"],
        ["arrived elsewhere", *(f"{sum(each)}" for each in zip(*_elsewhere(routes), strict=True))],
        ["stopped at the end of a lane", f"{vehicles.stopped_at_lane_end}", "-"],
        [f"braked with more than {HARD_BRAKE_MPS2:g} m/s2", f"{safety.hard_brakes}", "-"],
    ]
    rows += [
        [f"left out: {reason}", f"{count}", f"{count}"]
        for reason, count in sorted((vehicles.left_out or {}).items())
    ]
    return Table(["vehicles that", *METHODS], rows, "Shortfalls in the corridor")


def _elsewhere(routes: Sequence[RouteTimes]) -> Sequence[Sequence[int]]:
    return [one.elsewhere for one in routes] or [(0, 0)]


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _events_table(found: Sequence[SumoStatistics]) -> Table:
    """Return the table of what SUMO reports: conflicts in the corridor, the rest everywhere.

    SUMO does not know how hard vehicles brake that it does not drive.
    """
    brakings = ["-", f"{found[1].emergency_brakings}"]
    rows = [
        [method, f"{one.collisions}", f"{one.teleports}", f"{len(one.conflicts)}", braking]
        for method, one, braking in zip(METHODS, found, brakings, strict=True)
    ]
    conflicts = f"times to collision < {CONFLICT_S:g} s in the corridor"
    headings = ["method", "collisions", "teleports", conflicts, "emergency brakings"]
    return Table(headings, rows, "Events in the network, as SUMO reports them")
