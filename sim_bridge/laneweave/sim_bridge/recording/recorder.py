"""The recorder: files of trajectories, trips and events, and the world's part of the summary.

    trajectories.parquet   one row per vehicle and tick, written in row groups as the run goes on
    trips.parquet          one row per demanded vehicle, written at the end
    events.jsonl           one JSON object per line, flushed line by line

Both Parquet files contain the scenario as JSON in their metadata (key `SCENARIO_KEY`), so that
figures can be drawn from them alone.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from laneweave.protocol.config.loading import to_tables
from laneweave.protocol.scenario.tables import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import MinGaps
from laneweave.sim_bridge.road.demand import Arrival

SCENARIO_KEY = b"laneweave.scenario"
WARM_UP_S = 60.0
"""Vehicles that enter before this road time are not counted: the road is emptier for them."""
ROWS_PER_GROUP = 100_000
"""Rows of trajectories that are buffered before they are written."""
EMERGENCY_SHARE = 0.9
"""Braking harder than this share of the limit counts as an emergency brake."""

_TRAJECTORIES: list[pa.Field[Any]] = [
    pa.field("t_s", pa.float64(), nullable=False),
    pa.field("vehicle", pa.string(), nullable=False),
    pa.field("s_m", pa.float32(), nullable=False),
    pa.field("y_m", pa.float32(), nullable=False),
    pa.field("speed_mps", pa.float32(), nullable=False),
    pa.field("accel_mps2", pa.float32(), nullable=False),
    pa.field("column", pa.int32()),
    pa.field("lane", pa.int8(), nullable=False),
]

_TRIPS: list[pa.Field[Any]] = [
    pa.field("vehicle", pa.string(), nullable=False),
    pa.field("arrival_lane", pa.int8(), nullable=False),
    pa.field("preferred_lane", pa.int8(), nullable=False),
    pa.field("final_lane", pa.int8()),
    pa.field("on_preferred_lane", pa.bool_()),
    pa.field("demanded_s", pa.float64(), nullable=False),
    pa.field("entered_s", pa.float64()),
    pa.field("left_s", pa.float64()),
    pa.field("travel_time_s", pa.float64()),
    pa.field("entry_delay_s", pa.float64()),
    pa.field("formation", pa.int32()),
    pa.field("counted", pa.bool_(), nullable=False),
]

Sample = tuple[str, float, float, float, float, int | None, int]
"""(vehicle, s m, y m, speed m/s, acceleration m/s2, column or None off the lattice, lane).

s is the front bumper, y the body's centre from the right road edge; column and lane are the cell.
"""


@attrs.define
class _Trip:
    """The trip of one vehicle."""

    arrival: Arrival
    entered_s: float | None = None
    left_s: float | None = None
    formation: int | None = None
    final_lane: int | None = None

    @property
    def travel_time_s(self) -> float | None:
        """From the demanded arrival to the end of the road, waiting to enter included."""
        return None if self.left_s is None else self.left_s - self.arrival.t_s

    @property
    def entry_delay_s(self) -> float | None:
        """Time from the demanded arrival to the entry."""
        return None if self.entered_s is None else self.entered_s - self.arrival.t_s

    @property
    def on_preferred_lane(self) -> bool | None:
        """Whether it left the road on its preferred lane."""
        return None if self.final_lane is None else self.final_lane == self.arrival.preferred_lane

    def counted(self, last_arrival_s: float) -> bool:
        """Whether its travel time counts: it left, and entered in the counted period."""
        return (
            self.entered_s is not None
            and self.left_s is not None
            and WARM_UP_S <= self.entered_s <= last_arrival_s
        )


@attrs.define
class _Safety:
    """Extremes over the whole run and all vehicles."""

    overlaps: set[tuple[str, str]] = attrs.field(factory=set)
    collisions: set[tuple[str, str]] = attrs.field(factory=set)
    min_gap_m: float = math.inf
    min_headway_s: float = math.inf
    emergency_brakes: int = 0
    min_accel_mps2: float = math.inf
    max_accel_mps2: float = -math.inf
    max_jerk_mps3: float = -math.inf


class Recorder:
    """Writes a run's files and computes the world's part of its summary.

    Its files are complete when it is closed.
    """

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        """Open the files of a run.

        Args:
            folder: the run's folder; created if missing.
            scenario: of the run.
        """
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._scenario = scenario
        self._metadata: dict[bytes | str, bytes | str] = {
            SCENARIO_KEY: json.dumps(to_tables(scenario)).encode()
        }
        self._schema = pa.schema(_TRAJECTORIES, self._metadata)
        self._times: list[float] = []
        self._rows: list[Sample] = []
        """Buffered rows; `_times` has the time of each."""
        self._trips: dict[str, _Trip] = {}
        self._safety = _Safety()
        self._brake_accel = EMERGENCY_SHARE * scenario.vehicle.min_accel_mps2
        self._last_accels: dict[str, tuple[float, float]] = {}
        self._peak = 0
        self._closed = False
        self._events = (folder / "events.jsonl").open("w", encoding="utf-8", buffering=1)
        self._trajectories = pq.ParquetWriter(
            folder / "trajectories.parquet",
            self._schema,
            compression="zstd",
            use_dictionary=["t_s", "vehicle", "column", "lane"],  # type: ignore[arg-type]
            use_byte_stream_split=["s_m", "y_m", "speed_mps", "accel_mps2"],
        )

    def demanded(self, arrival: Arrival) -> None:
        """Record a vehicle that wants to enter; call it when the vehicle is due."""
        self._check_open()
        self._trips[arrival.vehicle] = _Trip(arrival)

    def entered(self, vehicle: str, t_s: float, formation: int | None = None) -> None:
        """Record that a demanded vehicle entered the road.

        Args:
            vehicle: its name.
            t_s: road time at which its front passed s = 0.
            formation: number of its formation, None if the method has none.
        """
        self._check_open()
        trip = self._trips[vehicle]
        trip.entered_s, trip.formation = t_s, formation

    def assign(self, vehicle: str, formation: int) -> None:
        """Record the formation of a vehicle that has entered."""
        self._trips[vehicle].formation = formation

    def left(self, vehicle: str, t_s: float, lane: int) -> None:
        """Record that a vehicle left the road.

        Args:
            vehicle: its name.
            t_s: road time at which its front passed the end of the road; between two ticks is fine.
            lane: the lane on which it left.
        """
        self._check_open()
        trip = self._trips[vehicle]
        trip.left_s, trip.final_lane = t_s, lane
        self._last_accels.pop(vehicle, None)

    def tick(self, t_s: float, samples: Iterable[Sample]) -> None:
        """Record where all vehicles on the road are at a road time, once per tick."""
        self._check_open()
        safety, last_accels, brake_accel = self._safety, self._last_accels, self._brake_accel
        max_jerk = safety.max_jerk_mps3
        rows = list(samples)
        for vehicle, _, _, _, accel, _, _ in rows:
            last = last_accels.get(vehicle)
            if last is not None and t_s > last[0]:
                jerk = abs(accel - last[1]) / (t_s - last[0])
                if jerk > max_jerk:
                    max_jerk = jerk
            if accel < brake_accel and (last is None or last[1] >= brake_accel):
                safety.emergency_brakes += 1
            last_accels[vehicle] = (t_s, accel)
        safety.max_jerk_mps3 = max_jerk
        if rows:
            accels = [sample[4] for sample in rows]
            safety.min_accel_mps2 = min(safety.min_accel_mps2, *accels)
            safety.max_accel_mps2 = max(safety.max_accel_mps2, *accels)
        self._times += [t_s] * len(rows)
        self._rows += rows
        self._peak = max(self._peak, len(rows))
        if len(self._rows) >= ROWS_PER_GROUP:
            self._write_rows()

    def safety(
        self,
        overlaps: Iterable[tuple[str, str]],
        collisions: Iterable[tuple[str, str]],
        gaps: MinGaps,
    ) -> None:
        """Record how close the vehicles are in one tick.

        Args:
            overlaps: pairs of `Bodies.overlapping_pairs`.
            collisions: pairs that SUMO reports.
            gaps: result of `Bodies.min_gaps`.
        """
        self._check_open()
        self._safety.overlaps.update(overlaps)
        self._safety.collisions.update(collisions)
        self._safety.min_gap_m = min(self._safety.min_gap_m, gaps.gap_m)
        self._safety.min_headway_s = min(self._safety.min_headway_s, gaps.headway_s)

    def event(self, t_s: float, kind: str, /, **data: Any) -> None:  # noqa: ANN401 - any JSON
        """Write a line to `events.jsonl` immediately.

        Args:
            t_s: road time.
            kind: kind of event.
            **data: its data; values unknown to JSON are written as text, and the keys `t_s` and
                `kind` are ignored.
        """
        self._check_open()
        own: dict[str, Any] = {"t_s": t_s, "kind": kind}
        self._events.write(json.dumps(own | data | own, default=str) + "\n")

    def summarise(self, method: str, simulated_s: float) -> dict[str, Any]:
        """Return the world's part of `summary.json`, at any time.

        Travel times and throughput are those of the counted vehicles; null if there are none, as in
        a short run. Throughput is the rate at which vehicles pass the end of the
        road between the first and the last counted one.

        Args:
            method: name of the control method.
            simulated_s: road time at the end.
        """
        scenario = self._scenario
        trips = self._trips.values()
        return {
            "schema": "laneweave.summary/1",
            "method": method,
            "seed": scenario.seed,
            "volume_veh_per_lane_h": scenario.demand.volume_veh_per_lane_h,
            "lanes": scenario.road.lanes,
            "road_m": scenario.road.length_m,
            "simulated_s": round(simulated_s, 6),
            "vehicles": {
                "demanded": len(trips),
                "entered": sum(trip.entered_s is not None for trip in trips),
                "left": sum(trip.left_s is not None for trip in trips),
                "on_preferred_lane": sum(bool(trip.on_preferred_lane) for trip in trips),
                "peak": self._peak,
            },
            "travel_time_s": self._travel_time(),
            "throughput_veh_per_lane_h": self._throughput(),
            "safety": {
                "overlaps": len(self._safety.overlaps),
                "sumo_collisions": len(self._safety.collisions),
                "min_gap_m": _finite(self._safety.min_gap_m),
                "min_headway_s": _finite(self._safety.min_headway_s),
                "emergency_brakes": self._safety.emergency_brakes,
                "max_accel_mps2": _finite(self._safety.max_accel_mps2),
                "min_accel_mps2": _finite(self._safety.min_accel_mps2),
                "max_jerk_mps3": _finite(self._safety.max_jerk_mps3),
            },
        }

    def close(self) -> None:
        """Write buffered rows and close all files; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._write_rows()
        finally:
            self._trajectories.close()
            self._events.close()
            self._write_trips()

    def _check_open(self) -> None:
        """Raise RuntimeError if the files are closed."""
        if self._closed:
            raise RuntimeError("the recorder is closed")

    @property
    def _last_arrival_s(self) -> float:
        """Road time of the last demanded arrival."""
        return max((trip.arrival.t_s for trip in self._trips.values()), default=-math.inf)

    def _travel_time(self) -> dict[str, float | None]:
        """Return mean, median, 95th percentile and maximum over the counted vehicles."""
        last_s = self._last_arrival_s
        times = [
            trip.travel_time_s
            for trip in self._trips.values()
            if trip.travel_time_s is not None and trip.counted(last_s)
        ]
        mean = float(np.mean(times)) if times else math.nan
        return {"mean": _finite(mean), **spread(np.array(times), 50, 95, largest=True)}

    def _throughput(self) -> float | None:
        """Return vehicles per lane and hour at the end of the road, None if undefined."""
        last_s = self._last_arrival_s
        trips = self._trips.values()
        counted = [t.left_s for t in trips if t.left_s is not None and t.counted(last_s)]
        if not counted or max(counted) <= min(counted):
            return None
        first_s, end_s = min(counted), max(counted)
        passed = sum(t.left_s is not None and first_s < t.left_s <= end_s for t in trips)
        return _finite(3600.0 * passed / (end_s - first_s) / self._scenario.road.lanes)

    def _write_rows(self) -> None:
        """Write the buffered rows as one row group."""
        if not self._rows:
            return
        columns = [self._times, *zip(*self._rows, strict=True)]
        self._times, self._rows = [], []
        arrays = [
            pa.array(column, field.type)
            for column, field in zip(columns, _TRAJECTORIES, strict=True)
        ]
        self._trajectories.write_batch(pa.RecordBatch.from_arrays(arrays, schema=self._schema))

    def _write_trips(self) -> None:
        """Write one row for each demanded vehicle."""
        last_s = self._last_arrival_s
        rows = [
            {
                "vehicle": trip.arrival.vehicle,
                "arrival_lane": trip.arrival.lane,
                "preferred_lane": trip.arrival.preferred_lane,
                "final_lane": trip.final_lane,
                "on_preferred_lane": trip.on_preferred_lane,
                "demanded_s": trip.arrival.t_s,
                "entered_s": trip.entered_s,
                "left_s": trip.left_s,
                "travel_time_s": trip.travel_time_s,
                "entry_delay_s": trip.entry_delay_s,
                "formation": trip.formation,
                "counted": trip.counted(last_s),
            }
            for trip in self._trips.values()
        ]
        table = pa.Table.from_pylist(rows, schema=pa.schema(_TRIPS, self._metadata))
        pq.write_table(table, self._folder / "trips.parquet", compression="zstd")


def _finite(value: float) -> float | None:
    """Return a number for JSON, rounded to a thousandth; None for infinities and NaN."""
    return round(value, 3) if math.isfinite(value) else None


def spread(
    values: NDArray[Any], *percentiles: int, largest: bool = False
) -> dict[str, float | None]:
    """Return percentiles by name, `max` too if it is wanted; None where there are no values."""
    ranks = {f"p{percentile}": percentile for percentile in percentiles}
    if largest:
        ranks["max"] = 100
    return {name: _percentile(values, rank) for name, rank in ranks.items()}


def _percentile(values: NDArray[Any], rank: int) -> float | None:
    with np.errstate(all="ignore"):
        value = float(np.percentile(values, rank)) if len(values) else math.nan
    return _finite(value)
