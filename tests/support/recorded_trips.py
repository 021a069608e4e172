"""Tables of trips, as a run writes them."""

from __future__ import annotations

from collections.abc import Iterable

import pyarrow as pa

from laneweave.sim_bridge.recording.columns import TRIPS, Metadata
from laneweave.sim_bridge.recording.trips import Trip


def trips_table(trips: Iterable[Trip], last_arrival_s: float, metadata: Metadata) -> pa.Table:
    """Return the table of trips; `last_arrival_s` is the road time of the last arrival."""
    rows = [trip.row(last_arrival_s) for trip in trips]
    return pa.Table.from_pylist(rows, schema=TRIPS.arrow_schema(metadata))
