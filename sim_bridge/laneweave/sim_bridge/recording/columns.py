"""The columns of a run's Parquet files: name, type, unit, frame and meaning of each.

A file stores unit, frame and meaning as the metadata of each column, and its schema's name and
number in the metadata of the file (key `SCHEMA_KEY`). docs/RESULT_FILES.md is generated from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pyarrow as pa
from attrs import frozen

Metadata = dict[bytes | str, bytes | str]
SCHEMA_KEY = b"laneweave.schema"
"""Key of the schema's name and number in the metadata of a Parquet file."""
SCENARIO_KEY = b"laneweave.scenario"
"""Key of the scenario, as JSON, in the metadata of trajectories and trips."""

ROAD = "road"
"""Frame of the road: s along the road from its start, y to the left from its right edge."""
LATTICE = "lattice"
"""Frame of the lattice, which moves at v_F: columns forwards, lanes from 0 (right) to the left."""


@frozen
class Column:
    """A column of a table."""

    name: str
    type: pa.DataType
    meaning: str
    unit: str = ""
    """Empty: a name, a number without a unit, or true or false."""
    frame: str = ""
    """Frame of a position or a speed: `ROAD` or `LATTICE`."""
    nullable: bool = False

    @property
    def field(self) -> pa.Field[Any]:
        """Field of a schema, with unit, frame and meaning as its metadata."""
        about = {"unit": self.unit, "frame": self.frame, "meaning": self.meaning}
        metadata: Metadata = {key: text for key, text in about.items() if text}
        return pa.field(self.name, self.type, nullable=self.nullable, metadata=metadata)


@frozen
class Table:
    """A table in a Parquet file."""

    schema: str
    """Name and number of the schema."""
    columns: tuple[Column, ...]

    def arrow_schema(self, metadata: Mapping[Any, bytes | str] | None = None) -> pa.Schema:
        """Return the schema; `metadata` are added to those of the file."""
        fields = [column.field for column in self.columns]
        return pa.schema(fields, {SCHEMA_KEY: self.schema, **(metadata or {})})

    @property
    def names(self) -> list[str]:
        """Names of the columns, in order."""
        return [column.name for column in self.columns]


_NO_LATTICE = "null: the method has no lattice"
_LANE = "0 is the rightmost lane"

TRAJECTORIES = Table(
    "laneweave.trajectories/2",
    (
        Column("t_s", pa.float64(), "road time", "s"),
        Column("vehicle", pa.string(), "name of the vehicle"),
        Column(
            "s_m",
            pa.float32(),
            "position of the front bumper, until it passes the end of the road",
            "m",
            ROAD,
        ),
        Column("y_m", pa.float32(), "position of the centre of the body", "m", ROAD),
        Column("speed_mps", pa.float32(), "speed along the road", "m/s", ROAD),
        Column(
            "lateral_speed_mps",
            pa.float32(),
            "speed across the road, positive to the left",
            "m/s",
            ROAD,
            nullable=True,
        ),
        Column("accel_mps2", pa.float32(), "acceleration along the road", "m/s2", ROAD),
        Column(
            "column",
            pa.int32(),
            f"column whose lattice point is nearest to the front bumper; {_NO_LATTICE}",
            frame=LATTICE,
            nullable=True,
        ),
        Column("lane", pa.int8(), f"lane of the centre of the body; {_LANE}"),
        Column(
            "reserved_column",
            pa.int32(),
            "column of the cell that the vehicle holds or, during a move, moves to; that of its "
            f"last cell if it waits at the end of its lane; {_NO_LATTICE}",
            frame=LATTICE,
            nullable=True,
        ),
        Column(
            "reserved_lane",
            pa.int8(),
            f"lane of that cell; {_NO_LATTICE}",
            nullable=True,
        ),
        Column(
            "preferred_lane",
            pa.int8(),
            "lane in which the vehicle wants to leave the road; -1: any that reaches its "
            "destination; null: unknown, in an earlier recording",
            nullable=True,
        ),
    ),
)
"""One row per vehicle on the road and tick."""

TRIPS = Table(
    "laneweave.trips/1",
    (
        Column("vehicle", pa.string(), "name of the vehicle"),
        Column("arrival_lane", pa.int8(), f"lane in which it arrives; {_LANE}"),
        Column(
            "preferred_lane",
            pa.int8(),
            "lane in which it wants to leave the road; -1: any that reaches its destination",
        ),
        Column("final_lane", pa.int8(), "lane in which it left; null: not left", nullable=True),
        Column(
            "on_preferred_lane",
            pa.bool_(),
            "whether it left by its destination, and in its preferred lane if it has one; null: "
            "not left",
            nullable=True,
        ),
        Column("demanded_s", pa.float64(), "road time of the arrival at the entrance", "s"),
        Column(
            "entered_s",
            pa.float64(),
            "road time at which the front bumper passed the entrance; null: not entered",
            "s",
            nullable=True,
        ),
        Column(
            "left_s",
            pa.float64(),
            "road time at which the front bumper passed the end of the road or the exit; null: "
            "not left",
            "s",
            nullable=True,
        ),
        Column(
            "travel_time_s",
            pa.float64(),
            "left_s - demanded_s: waiting at the entrance is included; null: not left",
            "s",
            nullable=True,
        ),
        Column(
            "entry_delay_s",
            pa.float64(),
            "entered_s - demanded_s; null: not entered",
            "s",
            nullable=True,
        ),
        Column(
            "formation",
            pa.int32(),
            "number of its formation; in the rolling operation, of the block of columns in which "
            "it entered; null: none",
            nullable=True,
        ),
        Column(
            "counted",
            pa.bool_(),
            "whether summary.json counts it: it left, and it entered after 60 s and not after the "
            "last arrival (all that left, in a corridor)",
        ),
        Column("entrance", pa.string(), "name of the entrance; main: the start of the road"),
        Column(
            "destination",
            pa.string(),
            "name of the exit by which it wants to leave; end: the end of the road",
        ),
        Column(
            "exit",
            pa.string(),
            "name of the exit by which it left; end: the end of the road; null: not left",
            nullable=True,
        ),
        Column(
            "free_flow_s", pa.float64(), "time at v_F from the entrance to the destination", "s"
        ),
        Column(
            "vehicle_type",
            pa.string(),
            "type of the vehicle; car: the scenario's table vehicle",
        ),
        Column(
            "sumo_id",
            pa.string(),
            "name of the vehicle in the user's SUMO demand; null: no corridor",
            nullable=True,
        ),
    ),
)
"""One row per vehicle that has arrived, in order of arrival."""

TICKS = Table(
    "laneweave.ticks/1",
    (
        Column("t_s", pa.float64(), "road time", "s"),
        Column("on_road", pa.int32(), "number of vehicles on the road"),
        Column("tick_ms", pa.float32(), "wall time that the tick took", "ms"),
    ),
)
"""One row per tick."""
