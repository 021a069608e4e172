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
    _active: dict[tuple[int, float, Name | None, float], int] = field(factory=dict)
    """Index in `_figures` of each part that is closed now, by its identity."""
    _waits: dict[Name, tuple[int, float]] = field(factory=dict)
    """Index of the part at which each vehicle waits, and road time since which it does."""
    _stopped: set[tuple[Name, int]] = field(factory=set)
    """Vehicles that have stopped, with the index of the part."""

    def on_obstacle(self, t_s: float, kind: str, obstacle: Obstacle) -> None:
        """Note that a part is closed, is longer or shorter than before, or is open again."""
        place = obstacle.identity
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

    def on_lane_end(self, t_s: float, vehicle: Name, lane: int, kind: str, s_m: float) -> None:
        """Note that a vehicle has no cell any more, or has one again."""
        if kind == LEFT_LATTICE:
            number = self._ahead(lane, s_m)
            has_broken_down = any(vehicle == own for _, _, own, _ in self._active)
            if number is not None and not has_broken_down:
                # It may stop again before it has a cell: both waits count, the vehicle only once.
                self._end_wait(vehicle, t_s)
                self._waits[vehicle] = number, t_s
                if (vehicle, number) not in self._stopped:
                    self._stopped.add((vehicle, number))
                    self._change(number, stopped=self._figures[number].stopped + 1)
        elif kind == ENTERED_LATTICE:
            self._end_wait(vehicle, t_s)

    def _end_wait(self, vehicle: Name, t_s: float) -> None:
        if vehicle in self._waits:
            number, since_s = self._waits.pop(vehicle)
            waited_s = round(self._figures[number].waited_s + t_s - since_s, 6)
            self._change(number, waited_s=waited_s)

    def _ahead(self, lane: int, s_m: float) -> int | None:
        """Return the part for which a vehicle stops: the next one ahead, or a passing vehicle."""
        here = [number for place, number in self._active.items() if place[0] == lane]
        moving = [number for number in here if self._figures[number].cause == PASSING]
        ahead = [
            number for number in here if number not in moving and self._figures[number].to_m > s_m
        ]
        if ahead:
            return min(ahead, key=lambda number: self._figures[number].from_m)
        return moving[-1] if moving else None

    @property
    def figures(self) -> list[ObstacleFigures] | None:
        """All parts that were closed for a time; None: none."""
        return self._figures or None

    def _change(self, number: int, **figures: Any) -> None:  # noqa: ANN401 (of any field)
        self._figures[number] = evolve(self._figures[number], **figures)
