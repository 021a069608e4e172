"""Two runs of the same demand, vehicle by vehicle: one over Zenoh, one simulated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from attrs import frozen

_ROUNDING_S = 1e-6


@frozen
class Agreement:
    """How far two runs agree."""

    vehicles: int
    """That left the road in both."""
    missing: int
    """That left it in one only."""
    other_lane: int
    """That left it on different lanes."""
    over_a_tick: int
    """Whose travel times differ by more than a tick."""
    worst_s: float
    """Greatest difference of travel times."""

    @property
    def holds(self) -> bool:
        """Whether there are vehicles, and all have the same lane and travel time within a tick."""
        return bool(self.vehicles) and not (self.missing or self.other_lane or self.over_a_tick)


def read_trips(folder: Path) -> list[dict[str, Any]]:
    """Return a run's trips, with what is compared.

    Raises:
        OSError, ValueError: there are none that can be read.
    """
    columns = ["vehicle", "final_lane", "travel_time_s"]
    return pq.read_table(folder / "trips.parquet", columns=columns).to_pylist()


def agreement(
    one: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]], tick_s: float
) -> Agreement:
    """Compare two runs.

    Args:
        one: trips of a run.
        other: trips of another run of the same demand.
        tick_s: travel times may differ by so much.
    """
    first, second = ({trip["vehicle"]: trip for trip in trips} for trips in (one, other))
    gone = [
        {name for name, trip in trips.items() if trip["travel_time_s"] is not None}
        for trips in (first, second)
    ]
    both = sorted(gone[0] & gone[1])
    apart_s = [abs(first[name]["travel_time_s"] - second[name]["travel_time_s"]) for name in both]
    return Agreement(
        vehicles=len(both),
        missing=len((gone[0] ^ gone[1]) | (first.keys() ^ second.keys())),
        other_lane=sum(first[name]["final_lane"] != second[name]["final_lane"] for name in both),
        over_a_tick=sum(apart > tick_s + _ROUNDING_S for apart in apart_s),
        worst_s=round(max(apart_s, default=0.0), 3),
    )
