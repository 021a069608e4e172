"""Events: one JSON object per line in `events.jsonl`, and the statistics of plans among them."""

from __future__ import annotations

import json
import math
from array import array
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from laneweave.protocol.files import append
from laneweave.protocol.scenario.formation_table import SOLVERS, solver_of_event
from laneweave.protocol.summary import Planning, PlanningMs
from laneweave.protocol.wire.events import PLAN_EVENTS
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.statistics import percentiles_of


def line_of(t_s: float, kind: str, data: Mapping[str, object]) -> bytes:
    """Return the line of an event.

    Values and keys that JSON does not support are written as text; keys `t_s` and `kind` in the
    data are ignored.
    """
    own: dict[str, object] = {"t_s": t_s, "kind": kind}
    line: object = {**own, **data, **own}
    try:
        text = json.dumps(line, default=str, allow_nan=False)
    except (TypeError, ValueError):
        text = json.dumps(_supported(line), default=str)
    return f"{text}\n".encode()


def _supported(value: object) -> object:
    """Return a copy of a value in which keys and numbers that JSON does not support are text."""
    if isinstance(value, Mapping):
        keys = (key if isinstance(key, str | int | None) else str(key) for key in value)
        return dict(zip(keys, map(_supported, value.values()), strict=True))
    if isinstance(value, list | tuple):
        return [_supported(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def append_event(path: Path, t_s: float, kind: str, data: Mapping[str, object]) -> None:
    """Append an event to the file of a run, whose bridge may write to it at the same time.

    Raises:
        OSError: the file cannot be written.
    """
    with path.open("ab", buffering=0) as file:
        append(file, line_of(t_s, kind, data))


class Events:
    """Writer of events, each of which it writes at once; counts the plans among them.

    It appends to the file, because the launcher of a run adds the faults that it injects.
    """

    def __init__(self, path: Path, disk: Disk | None = None) -> None:
        """Open the file."""
        self._disk = disk or Disk()
        self._file = path.open("ab", buffering=0)
        self._plans = self._optimal = self._largest = self._fallbacks = 0
        self._by_solver = Counter(dict.fromkeys(SOLVERS, 0))
        self._solve_ms = array("d")

    def add(self, t_s: float, kind: str, data: Mapping[str, object]) -> None:
        """Write an event, as `line_of` does; after `close`, ignore it."""
        if self._file.closed:
            return
        if kind in PLAN_EVENTS:
            self._count_plan(kind, data)
        if self._disk.works:
            with self._disk.writing():
                append(self._file, line_of(t_s, kind, data))

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def _count_plan(self, kind: str, plan: Mapping[str, object]) -> None:
        self._plans += 1
        self._optimal += plan.get("status") == "optimal"
        self._fallbacks += plan.get("fallback") is True
        self._largest = max(self._largest, int(_number(plan.get("vehicles"))))
        self._solve_ms.append(_number(plan.get("solve_ms")))
        solver = solver_of_event(kind, plan)
        if solver is not None:
            self._by_solver[solver] += 1

    def planning(self) -> Planning:
        """Return statistics of all plans."""
        solve_ms = np.array(self._solve_ms)
        return Planning(
            plans=self._plans,
            optimal=self._optimal,
            largest_formation=self._largest,
            by_solver=dict(self._by_solver),
            fallbacks=self._fallbacks,
            solve_ms=PlanningMs(**percentiles_of(solve_ms, 50, 95, largest=True)),
        )


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else 0.0
