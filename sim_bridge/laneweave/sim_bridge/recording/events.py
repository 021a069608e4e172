"""Events: one JSON object per line in `events.jsonl`, and the statistics of plans among them."""

from __future__ import annotations

import json
import math
from array import array
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from laneweave.protocol.files import overwrite
from laneweave.protocol.scenario.formation_table import SOLVERS, solver_of_event
from laneweave.protocol.summary import Planning, PlanningMs
from laneweave.protocol.wire.events import PLAN_EVENTS
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.statistics import percentiles_of


class Events:
    """Writer of events, each of which it writes at once; counts the plans among them."""

    def __init__(self, path: Path, disk: Disk | None = None) -> None:
        """Open the file."""
        self._disk = disk or Disk()
        self._file = path.open("wb+", buffering=0)
        self._plans = self._optimal = self._largest = self._fallbacks = 0
        self._by_solver = Counter(dict.fromkeys(SOLVERS, 0))
        self._solve_ms = array("d")

    def add(self, t_s: float, kind: str, data: Mapping[str, object]) -> None:
        """Write an event; after `close`, ignore it.

        Values that JSON does not support are written as text; keys `t_s` and `kind` in the data are
        ignored.
        """
        if self._file.closed:
            return
        if kind in PLAN_EVENTS:
            self._count_plan(kind, data)
        own: dict[str, object] = {"t_s": t_s, "kind": kind}
        line = json.dumps({**own, **data, **own}, default=str) + "\n"
        if self._disk.works:
            with self._disk.writing():
                overwrite(self._file, self._file.tell(), line.encode())

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
