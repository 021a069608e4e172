"""Events: one JSON object per line in `events.jsonl`, and the statistics of plans among them."""

from __future__ import annotations

import json
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from laneweave.protocol.scenario.formation_table import SOLVERS, solver_of_event
from laneweave.protocol.summary import Planning, PlanningMs
from laneweave.protocol.wire.events import PLAN_EVENTS
from laneweave.sim_bridge.recording.disk import Disk
from laneweave.sim_bridge.recording.statistics import percentiles_of


class Events:
    """Writer of events, each of which is in the file at once."""

    def __init__(self, path: Path, disk: Disk | None = None) -> None:
        """Open the file."""
        self._path = path
        self._disk = disk or Disk()
        self._file = path.open("wb", buffering=0)

    def add(self, t_s: float, kind: str, data: Mapping[str, object]) -> None:
        """Write an event; after `close`, ignore it.

        Values that JSON does not support are written as text; keys `t_s` and `kind` in the data are
        ignored.
        """
        if not self._file.closed and self._disk.works:
            own: dict[str, object] = {"t_s": t_s, "kind": kind}
            line = json.dumps({**own, **data, **own}, default=str) + "\n"
            with self._disk.writing():
                self._file.write(line.encode())

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()

    def planning(self) -> Planning:
        """Return statistics of all plans, read from the file."""
        plans = optimal = largest_formation = fallbacks = 0
        by_solver = Counter(dict.fromkeys(SOLVERS, 0))
        solve_ms = array("d")
        for plan in self._plans():
            plans += 1
            optimal += plan.get("status") == "optimal"
            fallbacks += plan.get("fallback") is True
            largest_formation = max(largest_formation, int(_number(plan.get("vehicles"))))
            solve_ms.append(_number(plan.get("solve_ms")))
            solver = solver_of_event(plan["kind"], plan)
            if solver is not None:
                by_solver[solver] += 1
        return Planning(
            plans=plans,
            optimal=optimal,
            largest_formation=largest_formation,
            by_solver=dict(by_solver),
            fallbacks=fallbacks,
            solve_ms=PlanningMs(**percentiles_of(np.array(solve_ms), 50, 95, largest=True)),
        )

    def _plans(self) -> Iterator[dict[str, Any]]:
        with self._path.open(encoding="utf-8") as lines:
            for line in lines:
                if not line.endswith("\n"):
                    return  # the disk was full
                event = json.loads(line)
                if event["kind"] in PLAN_EVENTS:
                    yield event


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else 0.0
