"""Trips: one row per demanded vehicle in `trips.parquet`, and statistics of trips."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from contextlib import closing
from itertools import islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from attrs import define

from laneweave.protocol.config.scenario_files import to_tables
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.summary import TravelTime, TripTimes
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.recording.columns import SCENARIO_KEY, TRIPS, Metadata
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.growing_parquet import GrowingParquet
from laneweave.sim_bridge.recording.statistics import finite, percentiles_of
from laneweave.sim_bridge.road.demand import Arrival

ROWS_PER_GROUP = 500
"""Number of rows that are written together."""
WARM_UP_S = 60.0
"""Road time from which drawn vehicles that enter are counted; until then the road fills up."""


@define
class Trip:
    """The trip of one vehicle."""

    arrival: Arrival
    entered_s: float | None = None
    left_s: float | None = None
    formation: int | None = None
    final_lane: int | None = None
    exit: str | None = None
    """Name of the exit by which the vehicle has left, `END_OF_ROAD` at the end of the road."""
    at_destination: bool | None = None
    """None: it has not left."""
    entrance: str = MAIN_ENTRANCE
    free_flow_s: float = 0.0
    """Time at v_F from the entrance to the destination."""

    def is_final(self, last_arrival_s: float) -> bool:
        """Return whether later arrivals do not change the row of the trip."""
        left, entered_s = self.left_s is not None, self.entered_s
        return left and (entered_s is None or entered_s <= last_arrival_s)

    def row(self, last_arrival_s: float) -> dict[str, Any]:
        """Return the row of the trip; travel time includes waiting at the entrance."""
        demanded_s, entered_s, left_s = self.arrival.t_s, self.entered_s, self.left_s
        # The comparison with SUMO alone counts all vehicles of the user's demand, too.
        entered_in_time = entered_s is not None and (
            bool(self.arrival.sumo_id) or WARM_UP_S <= entered_s <= last_arrival_s
        )
        return {
            "vehicle": self.arrival.vehicle,
            "arrival_lane": self.arrival.lane,
            "preferred_lane": self.arrival.preferred_lane,
            "final_lane": self.final_lane,
            "on_preferred_lane": self.at_destination,
            "demanded_s": demanded_s,
            "entered_s": entered_s,
            "left_s": left_s,
            "travel_time_s": None if left_s is None else left_s - demanded_s,
            "entry_delay_s": None if entered_s is None else entered_s - demanded_s,
            "formation": self.formation,
            "counted": left_s is not None and entered_in_time,
            "entrance": self.entrance,
            "destination": self.arrival.destination,
            "exit": self.exit,
            "free_flow_s": self.free_flow_s,
            "vehicle_type": self.arrival.vehicle_type,
            "sumo_id": self.arrival.sumo_id or None,
        }


def metadata_of(scenario: Scenario) -> Metadata:
    """Return the metadata of a run's Parquet files."""
    return {SCENARIO_KEY: json.dumps(to_tables(scenario)).encode()}


class Trips:
    """Writer of trips, in order of arrival; stores only those that it has not written yet."""

    def __init__(self, path: Path, metadata: Metadata, disk: Disk | None = None) -> None:
        """Open the file."""
        self._path = path
        self._metadata = metadata
        self._file = GrowingParquet(path, TRIPS.arrow_schema(metadata), disk)
        self._trips: dict[Name, Trip] = {}
        """Trips that are not written yet, in order of arrival."""
        self._last_arrival_s = -math.inf

    def __getitem__(self, vehicle: Name) -> Trip:
        """Return the trip of a vehicle that is waiting or on the road."""
        return self._trips[vehicle]

    def add(self, trip: Trip) -> None:
        """Add the trip of a vehicle that arrives; write a row group if enough trips are final."""
        self._trips[Name(trip.arrival.vehicle)] = trip
        self._last_arrival_s = max(self._last_arrival_s, trip.arrival.t_s)
        first = islice(self._trips.values(), ROWS_PER_GROUP)
        final = list(takewhile(lambda trip: trip.is_final(self._last_arrival_s), first))
        if len(final) == ROWS_PER_GROUP:
            self._write(final)
            for one in final:
                del self._trips[Name(one.arrival.vehicle)]

    def save(self) -> None:
        """Write the remaining trips as a provisional row group."""
        self._write(self._trips.values(), provisional=True)

    def close(self) -> None:
        """Write the remaining trips, and close the file."""
        with closing(self._file):
            self._write(self._trips.values())

    def table(self) -> pa.Table:
        """Return all trips, read from the file."""
        return pq.read_table(self._path)

    def _write(self, trips: Iterable[Trip], *, provisional: bool = False) -> None:
        """Write trips as one row group."""
        rows = [trip.row(self._last_arrival_s) for trip in trips]
        batch = pa.RecordBatch.from_pylist(rows, self._file.schema)
        self._file.append(batch, provisional=provisional)


def travel_time(trips: pa.Table) -> TravelTime:
    """Return statistics of the counted vehicles' travel times."""
    counted = trips.filter(pc.field("counted"))
    times_s = counted["travel_time_s"].to_numpy()
    return TravelTime(
        mean=finite(float(np.mean(times_s))) if len(times_s) else None,
        **percentiles_of(times_s, 50, 95, largest=True),
        n=len(times_s),
        by_destination=_by(counted, "destination"),
        by_entrance=_by(counted, "entrance"),
        by_type=_by(counted, "vehicle_type"),
    )


def _by(counted: pa.Table, column: str) -> dict[str, TripTimes]:
    """Return the times of counted trips by the values of a column."""
    travel_s, free_s = (counted[name].to_numpy() for name in ("travel_time_s", "free_flow_s"))
    values = np.array(counted[column].to_pylist(), dtype=object)
    found = {}
    for value in sorted(set(values)):
        chosen = values == value
        found[value] = TripTimes(
            n=int(chosen.sum()),
            mean=round(float(travel_s[chosen].mean()), 3),
            delay=round(float((travel_s - free_s)[chosen].mean()), 3),
        )
    return found


def throughput(trips: pa.Table, lanes: int) -> float | None:
    """Return the flow at the end of the road [vehicles/(lane h)]; None if undefined.

    The flow is measured between the departures of the first and the last counted vehicle.
    """
    counted_s = trips.filter(pc.field("counted"))["left_s"].to_numpy()
    if not len(counted_s) or counted_s.max() <= counted_s.min():
        return None
    left_s = trips["left_s"].drop_null().to_numpy()
    passed = int(np.sum((counted_s.min() < left_s) & (left_s <= counted_s.max())))
    return finite(3600.0 * passed / float(np.ptp(counted_s)) / lanes)
