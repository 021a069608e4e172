"""Profiles: kinds and severity of the faults in a search.

A profile defines the ranges and choices from which each run draws. Shares are probabilities; times
are in virtual seconds.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from importlib.resources import files
from typing import Any

from attrs import frozen

from laneweave.protocol.errors import unknown_name
from laneweave.protocol.structuring import structure

Span = tuple[int, int]
"""Minimum and maximum, both included."""


@frozen(kw_only=True)
class LastingRanges:
    """The ranges from which the faults throughout the fault phase are drawn."""

    loss: tuple[float, ...] = (0.0, 0.0, 0.1, 0.3, 0.5, 0.8)
    """Probability that a receiver loses a message."""
    duplication: tuple[float, ...] = (0.0, 0.0, 0.3)
    jitter_s: tuple[float, ...] = (0.003, 0.003, 0.003, 0.05, 0.05, 0.3, 0.3, 1.0, 5.0)
    """Maximum additional delay of a message; the minimum delay is 2 ms."""
    command_loss: tuple[float, ...] = (0.0, 0.0, 0.0, 0.3)
    """Additional loss of SENSE and COMMAND messages."""
    late_commands: tuple[float, ...] = (0.0, 0.0, 0.0, 0.3)
    """Share of commands whose motion is refused, as if they came too late for their tick."""
    slow_moves: tuple[float, ...] = (0.0, 0.2, 0.5)
    """Share of motions that last up to three slots."""
    compute_failure: tuple[float, ...] = (0.0, 0.0, 0.0, 0.3)
    compute_jitter_s: tuple[float, ...] = (0.0, 0.0, 0.3, 2.0)
    """Maximum additional planning time."""
    wrong_clocks: float = 0.7
    """Share of runs with wrong clocks: offsets up to 50 ms, rate errors up to 5 %."""


@frozen(kw_only=True)
class Profile:
    """The ranges and choices from which the runs of a search draw."""

    name: str
    text: str
    """Description in one line."""
    rolling: bool = False
    """Whether to use the rolling operation, in which vehicles own cells."""
    roadside: bool = False
    """Whether vehicles enter one after another at the real roadside."""
    lane_ends: bool = False
    """Whether lane 0 ends before the road (rolling operation at the real roadside)."""
    roads: bool = False
    """Whether a lane ends, joins or leaves, as drawn (at the real roadside)."""
    interchanges: bool = False
    """Whether a lane leads to an exit, and ramps behind it join (rolling, at the roadside)."""
    surprises: Span = (0, 0)
    """Number of breakdowns, closed parts and vehicles of other systems (at the real roadside)."""
    density: tuple[float, float] = (0.3, 0.7)
    """Occupied share of the cells in which vehicles may enter (rolling operation)."""
    vehicles: Span = (2, 16)
    blocks: Span = (1, 4)
    lanes: Span = (2, 4)
    growing: float = 0.5
    """Share of runs with formations of different lengths."""
    max_joined: Span = (1, 2)
    crowding: float = 0.5
    """Share of runs in which more vehicles may prefer a lane than their block has cells there."""
    leavers: float = 0.15
    """Share of vehicles that leave the road during the fault phase."""
    lasting: LastingRanges = LastingRanges()
    event_kinds: tuple[str, ...] = ()
    """Kinds of fault events, equally likely; kinds may be repeated. See `faults`."""
    events: Span = (0, 12)
    """Number of fault events in a run."""
    fault_s: tuple[float, float] = (10.0, 12.0)
    """Duration of the fault phase, after which all vehicles must arrive."""


def _load() -> Iterator[Profile]:
    """Yield the profiles of `profiles.toml`, completed with values from their base profiles.

    A base comes before the profiles that are derived from it.
    """
    text = files("laneweave.launch.fault_search").joinpath("profiles.toml").read_text("utf-8")
    tables: dict[str, dict[str, Any]] = {}
    for name, table in tomllib.loads(text).items():
        base = tables.get(table.pop("base", ""), {})
        lasting = base.get("lasting", {}) | table.get("lasting", {})
        tables[name] = base | table | {"name": name, "lasting": lasting}
        yield structure(tables[name], Profile)


PROFILES = {profile.name: profile for profile in _load()}


GUIDED = "guided"
"""Name of the choice of all profiles with faults."""


def profiles_named(name: str) -> tuple[Profile, ...]:
    """Return the profile of a name; for `guided`, all profiles with fault events.

    Raises:
        BadInputError: there is no such profile.
    """
    if name == GUIDED:
        return tuple(profile for profile in PROFILES.values() if profile.event_kinds)
    if name not in PROFILES:
        names = (GUIDED, *PROFILES)
        raise unknown_name("--profile", name, names, ", ".join(names))
    return (PROFILES[name],)
