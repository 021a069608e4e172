"""The files of a finished run."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from attrs import frozen

from laneweave.launch.explain.explanation import Explanation, explain
from laneweave.launch.recordings.events import read_events
from laneweave.launch.recordings.files import TICKS_FILE, TRIPS_FILE, not_a_run, reading
from laneweave.launch.recordings.runs import scenario_of
from laneweave.launch.recordings.trajectories import read_trajectories
from laneweave.protocol.errors import unknown_name
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import RunSummary, read_summary
from laneweave.protocol.wire.events import FIELDS


@frozen
class RecordedRun:
    """A finished run; its tables are read from the folder at each call.

    Tables are those of pyarrow: `table.to_pandas()` returns a DataFrame, `table["s_m"].to_numpy()`
    one column. docs/RESULT_FILES.md explains the columns.
    """

    folder: Path
    summary: RunSummary
    """Content of `summary.json`."""
    scenario: Scenario
    """The scenario with which the run was made."""

    def trips(self) -> pa.Table:
        """Return one row per vehicle: arrival, lanes, times.

        Raises:
            BadInputError: the file cannot be read.
        """
        return self._table(TRIPS_FILE)

    def trajectories(self, columns: Sequence[str] | None = None) -> pa.Table:
        """Return the recorded states of all vehicles, in the order of time.

        Args:
            columns: names of the columns to read; None: all.

        Raises:
            BadInputError: there is no such column, or the file cannot be read; sweeps keep the
                trajectories of some runs only.
        """
        return read_trajectories(self.folder, columns)

    def ticks(self) -> pa.Table:
        """Return one row per tick of the bridge: vehicles on the road, duration.

        Raises:
            BadInputError: the file cannot be read; sweeps do not keep it.
        """
        return self._table(TICKS_FILE)

    def events(self, kind: str | None = None) -> list[dict[str, Any]]:
        """Return the events in the order of time: `t_s`, `kind`, and the data of their kind.

        Args:
            kind: kind of the events, such as `plan-made`; None: all.

        Raises:
            BadInputError: the file cannot be read, or the run has no such event and this release no
                such kind.
        """
        kinds = () if kind is None else (kind,)
        events = read_events(self.folder, *kinds, required=True)
        found = [dict(event) for event in sorted(events, key=itemgetter("t_s"))]
        # Plug-ins and other releases have kinds of their own.
        if not found and kind is not None and kind not in FIELDS:
            raise unknown_name("kind", kind, FIELDS)
        return found

    def explain(self, vehicle: str) -> Explanation:
        """Return what happened to a vehicle, and why it missed its lane, if it did.

            found = laneweave.load_run("runs/demo").explain("v0039")
            print(found.reason, found.text)
            for line in found.story:
                print(line.t_s, line.text)

        Raises:
            BadInputError: there is no such vehicle, or the events cannot be read.
        """
        return explain(self.folder, vehicle)

    def _table(self, name: str) -> pa.Table:
        with reading(self.folder, name):
            return pq.read_table(self.folder / name)


def load_run(folder: Path | str) -> RecordedRun:
    """Return the run in a folder, which `laneweave run` or a sweep has written.

        trips = laneweave.load_run("runs/demo").trips().to_pandas()

    Raises:
        BadInputError: the folder is not that of a finished run.
    """
    folder = Path(folder)
    summary = read_summary(folder)
    if summary is None:
        raise not_a_run(folder, "its summary.json is missing or incomplete")
    with reading(folder, TRIPS_FILE):
        scenario = scenario_of(folder / TRIPS_FILE)
    return RecordedRun(folder, summary, scenario)
