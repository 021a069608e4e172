"""Stories: everything that determines a run, so that it can be changed, stored and run again."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator, Mapping
from pathlib import Path

from attrs import evolve, frozen

from laneweave.launch.fault_search.events.faults import FaultEvent, draw_events
from laneweave.launch.fault_search.profiles import Profile
from laneweave.launch.fault_search.road_setup import HOLD_PERIODS_TICKS
from laneweave.launch.fault_search.setup import Setup
from laneweave.protocol.config.source_files import (
    SourceFile,
    json_lines,
    read_text,
    unique_keys,
)
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.structuring import structure, unstructure
from laneweave.protocol.wire.messages import Name

SCHEMA = "laneweave.story/1"
MAX_BYTES = 1 << 24
NEW_PREFERENCES_S = (0.8, 3.0)
"""Range of intervals at which the preferred lanes change during the fault phase."""


@frozen
class Preferences:
    """The preferred lanes of all vehicles from a time on."""

    t_s: float
    lanes: Mapping[Name, int]


@frozen(kw_only=True)
class Story:
    """Setup and events of a run; the same story gives the same run."""

    name: str
    seed: int
    """Seed of all that the run itself draws: message faults, durations, back-offs."""
    setup: Setup
    preferences: tuple[Preferences, ...]
    """Changes of the preferred lanes, by time; the first at time 0."""
    events: tuple[FaultEvent, ...] = ()
    """Fault events, by time."""

    @classmethod
    def drawn(cls, seed: int, profile: Profile) -> Story:
        """Draw the story of a seed from a profile."""
        rng = random.Random(f"{profile.name}/{seed}")  # noqa: S311 (simulation, no secrets)
        setup = Setup.drawn(profile, rng)
        period_ticks = random.Random(f"rate/{seed}").choice(HOLD_PERIODS_TICKS)  # noqa: S311
        setup = evolve(setup, road=evolve(setup.road, hold_period_ticks=period_ticks))
        fault_s = setup.lasting.fault_s
        return cls(
            name=f"{profile.name} {seed}",
            seed=seed,
            setup=setup,
            preferences=tuple(_draw_preferences(setup, fault_s, rng)),
            events=draw_events(profile, fault_s, rng),
        )

    @property
    def fault_s(self) -> float:
        """Duration of the fault phase."""
        return self.setup.lasting.fault_s

    @classmethod
    def read(cls, path: Path) -> Story:
        """Read a story from a file.

        Raises:
            BadInputError: the file cannot be read, or is not a story.
        """
        text = read_text(path, "story", "JSON", MAX_BYTES)
        try:
            table = json.loads(text, object_pairs_hook=unique_keys)
        except (ValueError, RecursionError) as error:
            raise BadInputError("story", str(path), f"valid JSON ({error})") from error
        if not isinstance(table, dict) or table.pop("schema", None) != SCHEMA:
            raise BadInputError("story", str(path), f'a file with "schema": "{SCHEMA}"')
        with SourceFile(str(path), text, table, json_lines).located():
            return structure(table, cls)

    def text(self) -> str:
        """Return the story as JSON."""
        table = {"schema": SCHEMA, **unstructure(self)}
        return json.dumps(table, indent=1) + "\n"


def _draw_preferences(setup: Setup, fault_s: float, rng: random.Random) -> Iterator[Preferences]:
    """Draw changes until the end of the fault phase; all vehicles can follow the last one."""
    first = setup.preferences(rng, last=False)
    yield Preferences(0.0, first)
    t_s, last = 0.0, False
    while not last:
        t_s += rng.uniform(*NEW_PREFERENCES_S)
        last = t_s + NEW_PREFERENCES_S[1] > fault_s
        entered = setup.road.roadside and not setup.road.rolling
        lanes = first if last and entered else setup.preferences(rng, last=last)
        yield Preferences(t_s, lanes)
