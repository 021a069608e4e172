"""What parts of lanes that were closed for a time have cost, for the summary of a run."""

from __future__ import annotations

from typing import Any

from attrs import define, evolve, field

from laneweave.protocol.summary import ObstacleFigures
from laneweave.protocol.wire.events import ENTERED_LATTICE, LEFT_LATTICE, PART_OPENED
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.obstacle_messages import PASSING, Obstacle


@define
class ObstacleLog:
    """The closed parts of a run."""

    _figures: list[ObstacleFigures] = field(factory=list)
    _active: dict[tuple[int, float, Name | None], int] = field(factory=dict)
    """Index in `_figures` of each part that is closed now, by lane, beginning and vehicle."""
    _waits: dict[Name, tuple[int, float]] = field(factory=dict)
    """Index of the part at which each vehicle waits, and road time since which it does."""

    def on_obstacle(self, t_s: float, kind: str, obstacle: Obstacle) -> None:
        """Note that a part is closed, is longer or shorter than before, or is open again."""
        place = obstacle.lane, obstacle.from_m, obstacle.vehicle
        number = self._active.setdefault(place, len(self._figures))
        if number == len(self._figures):
            self._figures.append(
                ObstacleFigures(
                    cause=obstacle.cause,
                    lane=obstacle.lane,
                    from_m=obstacle.from_m,
                    to_m=obstacle.to_m,
                    vehicle=obstacle.vehicle or "",
                    since_s=obstacle.since_s,
                )
            )
        opened_s = lowest_mps = None
        if kind == PART_OPENED:
            del self._active[place]
            opened_s = round(t_s, 6)
        if obstacle.cause == PASSING:
            lowest_mps = round(obstacle.speed_mps, 3)
        self._change(number, to_m=obstacle.to_m, opened_s=opened_s, lowest_speed_mps=lowest_mps)

    def on_lane_end(self, t_s: float, vehicle: Name, lane: int, kind: str) -> None:
        """Note that a vehicle has no cell any more, or has one again."""
        if kind == LEFT_LATTICE:
            here = [number for place, number in self._active.items() if place[0] == lane]
            if here and self._figures[here[-1]].vehicle != vehicle:
                self._waits[vehicle] = here[-1], t_s
                self._change(here[-1], stopped=self._figures[here[-1]].stopped + 1)
        elif kind == ENTERED_LATTICE and vehicle in self._waits:
            number, since_s = self._waits.pop(vehicle)
            waited_s = round(self._figures[number].waited_s + t_s - since_s, 6)
            self._change(number, waited_s=waited_s)

    @property
    def figures(self) -> list[ObstacleFigures] | None:
        """All parts that were closed for a time; None: none."""
        return self._figures or None

    def _change(self, number: int, **figures: Any) -> None:  # noqa: ANN401 (of any field)
        self._figures[number] = evolve(self._figures[number], **figures)
