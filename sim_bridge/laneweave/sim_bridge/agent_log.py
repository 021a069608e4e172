"""Log of the vehicles whose agents are lost or come back: one line for those of a fleet."""

from __future__ import annotations

from collections.abc import Callable, Collection

import structlog
from attrs import define, field

from laneweave.protocol.names import Name, first_names

log = structlog.get_logger(__name__)

GATHER_S, REPEAT_S = 1.0, 10.0
"""Time for which changes are gathered for a line, and minimum time between two lines about the same
fleet (road time)."""
MAX_NAMES = 5
"""Maximum number of vehicles that a line names."""
LOST, BACK = "agents lost", "agents back"


@define
class AgentLog:
    """Writer of these lines, which follow from the vehicles that have caretakers."""

    fleet_of: Callable[[str], str]
    """Returns the fleet that drives a vehicle; empty: none is known."""
    _without: frozenset[Name] = frozenset()
    """Vehicles without agents at the last update."""
    _waiting: dict[tuple[str, str], tuple[float, float, list[Name]]] = field(factory=dict)
    """When each line was begun, when it is due, and its vehicles, by change and fleet."""
    _logged_s: dict[tuple[str, str], float] = field(factory=dict)
    """When each line was written last."""

    def update(self, without: Collection[Name], on_road: Collection[Name], t_s: float) -> None:
        """Register the vehicles without agents, and write the lines that are due.

        Args:
            without: vehicles on the road without agents.
            on_road: all vehicles on the road.
            t_s: road time.
        """
        now = frozenset(without)
        if now != self._without:
            self._add(LOST, now - self._without, t_s)
            self._add(BACK, (self._without - now).intersection(on_road), t_s)
            self._without = now
        if self._waiting:
            self._write(t_s)

    def close(self, t_s: float) -> None:
        """Write all lines."""
        self._write(t_s, all_lines=True)

    def _add(self, change: str, vehicles: Collection[Name], t_s: float) -> None:
        for vehicle in sorted(vehicles):
            key = change, self.fleet_of(vehicle)
            again_s = self._logged_s.get(key, -REPEAT_S) + REPEAT_S
            line = self._waiting.setdefault(key, (t_s, max(t_s + GATHER_S, again_s), []))
            line[2].append(vehicle)

    def _write(self, t_s: float, *, all_lines: bool = False) -> None:
        for key, (begun_s, due_s, vehicles) in list(self._waiting.items()):
            if t_s < due_s and not all_lines:
                continue
            del self._waiting[key]
            self._logged_s[key] = t_s
            change, fleet = key
            write = log.warning if change == LOST else log.info
            write(
                change,
                **({"fleet": fleet} if fleet else {}),
                count=len(vehicles),
                vehicles=first_names(vehicles, MAX_NAMES),
                road_s=round(begun_s, 3),
            )
