"""Formations of a recorded run."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq

from laneweave.launch.formation_columns import FormationColumns, Formations
from laneweave.launch.recordings.events import read_events
from laneweave.launch.recordings.files import EVENTS_FILE, TRIPS_FILE, reading
from laneweave.protocol.lattice import Lattice
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.events import FORMATION_CLOSED


def closed_formations(folder: Path, scenario: Scenario) -> Formations:
    """Return the formations of a recorded run; none in the rolling operation."""
    if not scenario.formation.traits.has_formations:
        return Formations()
    return recorded_formations(folder, scenario.lattice)


def recorded_formations(folder: Path, lattice: Lattice) -> Formations:
    """Return the formations of a recorded run that contained vehicles.

    In the rolling operation, and in recordings without `formation-closed` events, each block of the
    lattice counts as a formation.

    Raises:
        BadInputError: a file of the run cannot be read.
    """
    found: dict[int, FormationColumns] = {}
    with reading(folder, EVENTS_FILE):
        for event in read_events(folder, FORMATION_CLOSED):
            if event.get("role") == "bridge":
                rear, front = event["columns"]
                number = int(event["formation"])
                found[number] = FormationColumns(number, int(rear), int(front), float(event["t_s"]))
    with reading(folder, TRIPS_FILE):
        trips = pq.read_table(folder / TRIPS_FILE, columns=["formation"])
    numbers: set[int] = set(trips["formation"].drop_null().to_pylist())  # type: ignore[arg-type]
    for number in numbers:
        columns = lattice.block_range(number)
        found.setdefault(number, FormationColumns(number, columns[0], columns[-1]))
    return Formations(found.values())
