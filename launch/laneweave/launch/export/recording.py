"""The trajectories of a run, tick by tick, with the bodies of its vehicles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from attrs import frozen

from laneweave.launch.recordings.runs import single_run
from laneweave.launch.recordings.trajectories import Floats, Ints, read_trajectories, read_trips
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import CAR
from laneweave.sim_bridge.bodies.overlaps_and_gaps import TURNING_MPS

_COLUMNS = ("s_m", "y_m", "speed_mps", "lateral_speed_mps", "accel_mps2")


def trajectories_within(
    folder: Path, from_s: float | None, to_s: float | None, columns: Sequence[str] | None = None
) -> pa.Table:
    """Return the trajectories of a part of a run; see `Recording.read` and `read_trajectories`.

    Raises:
        BadInputError: the part is not valid or without vehicles, or the run cannot be read.
    """
    _check_period(from_s, to_s)
    table = within(read_trajectories(folder, columns), from_s, to_s)
    if not table.num_rows and (from_s, to_s) != (None, None):
        value = f"{from_s or 0.0:g} to {'the end' if to_s is None else f'{to_s:g}'}"
        raise BadInputError("--from, --to", value, "a time in which vehicles were on the road")
    return table


def _check_period(from_s: float | None, to_s: float | None) -> None:
    for name, value in (("--from", from_s), ("--to", to_s)):
        if value is not None and not math.isfinite(value):
            raise BadInputError(name, value, "a road time in s")
    if from_s is not None and to_s is not None and from_s > to_s:
        raise BadInputError("--from", f"{from_s:g}", f"at most --to = {to_s:g}")


def within(table: pa.Table, from_s: float | None, to_s: float | None) -> pa.Table:
    """Return the rows between two road times (`t_s`); None: all that are earlier or later."""
    if from_s is not None:
        table = table.filter(pc.greater_equal(table["t_s"], pa.scalar(from_s)))
    if to_s is not None:
        table = table.filter(pc.less_equal(table["t_s"], pa.scalar(to_s)))
    return table


@frozen
class Recording:
    """All rows of a run in the order of time; arrays of shape (rows,)."""

    folder: Path
    scenario: Scenario
    names: tuple[str, ...]
    """Names of the vehicles."""
    types: tuple[str, ...]
    """Type of each vehicle."""
    preferred_lanes: tuple[int, ...]
    """Preferred lane of each vehicle, or `ANY_LANE`."""
    vehicle: Ints
    """Index of each row's vehicle."""
    t_s: Floats
    s_m: Floats
    """Distance of the front bumper along the road."""
    y_m: Floats
    """Distance of the body's centre from the right edge of the road."""
    speed_mps: Floats
    heading_rad: Floats
    """Direction of the body: 0 along the road, positive to the left."""
    accel_mps2: Floats
    lane: Ints

    @classmethod
    def read(cls, folder: Path, from_s: float | None = None, to_s: float | None = None) -> Self:
        """Return the recording in a run's folder.

        Args:
            folder: the run's folder.
            from_s: road time of the first tick; None: the beginning of the run.
            to_s: road time of the last tick; None: its end.

        Raises:
            BadInputError: the folder has no readable run, or there are no vehicles in this time.
        """
        scenario = single_run(folder).scenario
        table = trajectories_within(folder, from_s, to_s, ["t_s", "vehicle", *_COLUMNS, "lane"])
        if not table.num_rows:
            raise BadInputError("RUN", str(folder), "a run with vehicles on the road")
        codes = table["vehicle"].combine_chunks().dictionary_encode()
        names = tuple(str(name) for name in codes.dictionary)
        recorded = read_trips(folder)
        trips = [recorded.get(name, {}) for name in names]
        found = {name: np.nan_to_num(table[name].to_numpy()).astype(float) for name in _COLUMNS}
        ahead_mps = np.maximum(found["speed_mps"], 0.0)
        turned = np.minimum(ahead_mps / TURNING_MPS, 1.0)
        return cls(
            folder=folder,
            scenario=scenario,
            names=names,
            types=tuple(str(trip.get("vehicle_type", CAR)) for trip in trips),
            preferred_lanes=tuple(int(trip.get("preferred_lane", ANY_LANE)) for trip in trips),
            vehicle=codes.indices.to_numpy().astype(np.int64),
            t_s=table["t_s"].to_numpy(),
            s_m=found["s_m"],
            y_m=found["y_m"],
            speed_mps=found["speed_mps"],
            heading_rad=turned * np.arctan2(found["lateral_speed_mps"], ahead_mps),
            accel_mps2=found["accel_mps2"],
            lane=table["lane"].to_numpy().astype(np.int64),
        )

    def ticks(self) -> Iterator[tuple[float, range]]:
        """Yield the road time and the rows of each tick."""
        begins = np.flatnonzero(np.diff(self.t_s, prepend=-np.inf)).tolist()
        for first, end in zip(begins, [*begins[1:], len(self.t_s)], strict=True):
            yield float(self.t_s[first]), range(first, end)

    def size_m(self, number: int) -> tuple[float, float]:
        """Return length and width of a vehicle."""
        return self.scenario.types[self.types[number]].limits.size_m

    @cached_property
    def lengths_m(self) -> Floats:
        """Length of each row's vehicle."""
        return np.array([self.size_m(number)[0] for number in range(len(self.names))])[self.vehicle]

    @cached_property
    def front_y_m(self) -> Floats:
        """Distance of the middle of each front bumper from the right edge of the road."""
        return self.y_m + 0.5 * self.lengths_m * np.sin(self.heading_rad)

    @cached_property
    def centres_m(self) -> Floats:
        """Distance of each body's centre along the road."""
        return self.s_m - 0.5 * self.lengths_m * np.cos(self.heading_rad)
