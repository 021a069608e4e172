"""The explanation of a vehicle in a recorded run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from attrs import frozen

from laneweave.launch.explain.facts import Facts, facts_of
from laneweave.launch.explain.reasons import reason_of
from laneweave.launch.explain.story import StoryLine, seconds, story_of, to_dict, wanted
from laneweave.launch.recordings.events import Event, read_events
from laneweave.launch.recordings.files import EVENTS_FILE, TRIPS_FILE
from laneweave.launch.recordings.runs import scenario_of
from laneweave.protocol.errors import BadInputError, unknown_name
from laneweave.protocol.names import span_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire import events as kinds
from laneweave.sim_bridge.recording.missed_lanes import leaderless_after_s


class Fate(StrEnum):
    """What became of a vehicle."""

    REACHED = "reached"
    """It left the road where it wanted to."""
    MISSED = "missed"
    """It left the road elsewhere."""
    ON_ROAD = "on-road"
    """It was on the road when the recording ended."""
    NOT_ENTERED = "not-entered"
    """It had arrived, but not entered."""


@frozen
class Explanation:
    """What happened to a vehicle, and why."""

    vehicle: str
    fate: Fate
    reason: str
    """Why it missed its lane, or stands at the end of one (`explain.reasons.Reason`); empty: it did
    not."""
    text: str
    """One line: fate and reason."""
    story: tuple[StoryLine, ...]
    """What happened to it and to those on which it depended, in the order of road time: lines with
    `t_s`, `kind` and `text`."""

    def to_dict(self) -> dict[str, Any]:
        """Return the explanation as JSON values."""
        return {
            "vehicle": self.vehicle,
            "fate": self.fate.value,
            "reason": self.reason or None,
            "text": self.text,
            "story": [to_dict(line) for line in self.story],
        }


def explain(folder: Path, vehicle: str) -> Explanation:
    """Return the explanation of a vehicle, from the files of a run, which may go on.

    Args:
        folder: the run's folder, with `events.jsonl`; `trips.parquet` may be missing.
        vehicle: name of the vehicle.

    Raises:
        BadInputError: the folder has no events, or the vehicle is unknown.
    """
    events, trips = _events(folder), _trips(folder)
    entered = {str(event["vehicle"]) for event in events if event["kind"] == kinds.ENTERED}
    known = sorted(entered.union(trips))
    if vehicle not in known:
        span = span_of(known) if known else "none has arrived"
        raise unknown_name("VEHICLE", vehicle, known, f"a vehicle of the run ({span})")
    facts = facts_of(events, vehicle, leaderless_after_s(_scenario(folder)))
    fate, reason, text = _conclusion(facts)
    return Explanation(vehicle, fate, reason, f"{vehicle} {text}", story_of(facts))


def _conclusion(facts: Facts) -> tuple[Fate, str, str]:
    """Return the fate of a vehicle, the reason for it, and both in words."""
    entered, left = facts.entered, facts.left
    if entered is None:
        return Fate.NOT_ENTERED, "", f"has not entered the road until {seconds(facts.end_s)}"
    goal = wanted(entered)
    if left is None:
        text = f"was on the road at {seconds(facts.end_s)}, on its way to {goal}"
        if not facts.stands:
            return Fate.ON_ROAD, "", text
        found = reason_of(facts)
        return Fate.ON_ROAD, found.reason.value, f"{text}: {found.text}"
    if left["on_preferred_lane"]:
        return Fate.REACHED, "", f"reached its goal ({goal}) at {seconds(left['t_s'])}"
    found = reason_of(facts)
    return Fate.MISSED, found.reason.value, f"missed its goal ({goal}): {found.text}"


def _events(folder: Path) -> Sequence[Event]:
    """Return the events of a run.

    Raises:
        BadInputError: there are none, or they cannot be read.
    """
    try:
        return list(read_events(folder, required=True))
    except BadInputError as error:
        why = getattr(error.__cause__, "strerror", None) or error.__cause__
        allowed = f"the folder of a run, with {EVENTS_FILE} ({why})"
        raise BadInputError("RUN", str(folder), allowed) from error


def _trips(folder: Path) -> Mapping[str, None]:
    """Return the names of the vehicles that have arrived; none if they are not recorded yet."""
    try:
        names = pq.read_table(folder / TRIPS_FILE, columns=["vehicle"])["vehicle"]
    except (OSError, ValueError):
        return {}
    return dict.fromkeys(map(str, names.to_pylist()))


def _scenario(folder: Path) -> Scenario:
    """Return the scenario of a run; the defaults if it is not recorded yet."""
    try:
        return scenario_of(folder / TRIPS_FILE)
    except (OSError, ValueError):
        return Scenario()
