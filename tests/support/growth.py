"""Containers that grow with each vehicle that has passed, in runs in virtual time."""

from __future__ import annotations

import gc
import re
from collections import deque
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from attrs import define, field

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.sim_bridge import core as bridge
from laneweave.sim_bridge.recording import reports, ticks, trajectories, trips
from laneweave.sim_bridge.road import entry

BOUNDS: tuple[tuple[ModuleType, str], ...] = (
    (bridge, "REPORT_TICKS"),
    (reports, "MAX_SENDERS"),
    (entry, "LOAD_S"),
    (ticks, "ROWS_PER_GROUP"),
    (trajectories, "TICKS_PER_GROUP"),
    (trips, "ROWS_PER_GROUP"),
)
"""Sizes of buffers, in entries or seconds, which would otherwise still grow during a short run."""
SMALL = 10
_Cache = type(lru_cache(id))
"""Class of functions with a cache, whose entries the collector knows as a dictionary."""
PER_VEHICLE = 0.12
"""Entries for each vehicle that passed from which a container counts as growing: fewer than one for
each formation."""


@define
class Growth:
    """Lengths of all containers in this process, measured at some road times."""

    at_s: tuple[float, ...]
    """Road times, ascending."""
    left: list[int] = field(factory=list)
    """Number of vehicles that have left at these times."""
    _lengths: list[dict[int, int]] = field(factory=list)
    """Length of each container by its id."""
    _containers: list[Any] = field(factory=list)
    """All containers at the last of these times."""

    def watch(self, view: RoadView) -> None:
        """Measure when the next road time is reached."""
        if view.clock is None or len(self.left) == len(self.at_s):
            return
        if view.clock.t_s >= self.at_s[len(self.left)]:
            gc.collect()
            self._containers = list(_unbounded_containers())
            self._lengths.append({id(one): len(one) for one in self._containers})
            self.left.append(view.clock.left)

    def growing(self) -> list[str]:
        """Return the containers that have grown in every interval, with their newest entries."""
        steps = [
            PER_VEHICLE * (after - before)
            for before, after in zip(self.left, self.left[1:], strict=False)
        ]
        found = []
        for one in self._containers:
            lengths = [known.get(id(one), len(one)) for known in self._lengths]
            if all(
                after - before >= step
                for before, after, step in zip(lengths, lengths[1:], steps, strict=False)
            ):
                found.append(f"{type(one).__name__} {lengths}: ... {str(list(one)[-3:])[:300]}")
        return found


def _unbounded_containers() -> Iterator[Any]:
    """Yield all containers in this process that have no maximum length."""
    objects = gc.get_objects()
    # The collector does not know dictionaries of numbers and texts: find them in other objects.
    found = {id(one): one for one in (*objects, *gc.get_referents(*objects)) if _is_unbounded(one)}
    found.pop(id(vars(re)["_cache"]), None)
    for one in objects:
        if isinstance(one, _Cache) and one.cache_parameters()["maxsize"] is not None:
            for entries in gc.get_referents(one):
                found.pop(id(entries), None)
    yield from found.values()


def _is_unbounded(one: object) -> bool:
    return isinstance(one, (dict, list, set)) or (isinstance(one, deque) and one.maxlen is None)


def growth_of(
    folder: Path,
    patch: pytest.MonkeyPatch,
    formation: Mapping[str, str],
    *,
    first_s: float,
    phase_s: float,
    phases: int = 2,
) -> Growth:
    """Drive a dense stream over a short road in virtual time, and measure the growth.

    Args:
        folder: folder of the run.
        patch: reduces the sizes of buffers.
        formation: fields of the scenario's formation.
        first_s: road time of the first measurement.
        phase_s: time between measurements, longer than a vehicle is announced or on the road.
        phases: number of intervals.
    """
    for module, name in BOUNDS:
        patch.setattr(module, name, SMALL)
    at_s = tuple(first_s + phase_s * number for number in range(phases + 1))
    scenario = parse_scenario(
        {
            "road": {"s1_m": 20.0, "s2_m": 20.0, "s3_m": 200.0},
            "demand": {"volume_veh_per_lane_h": 1600.0, "duration_s": at_s[-1]},
            "formation": dict(formation),
        }
    )
    growth = Growth(at_s)
    outcome = SimulatedRun(scenario, folder, show_progress=False, watch=growth.watch).run()
    assert not outcome.problems
    return growth
