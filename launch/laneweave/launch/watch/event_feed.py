"""The newest events, as short as they fit on the page."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from attrs import define, field

from laneweave.protocol.scenario.solvers import STREAM_PLANNED, solver_of_event

MOST_NEWS = 8
MOST_CHARACTERS = 90
MOST_NUMBER = 1e12
FREQUENT = (
    STREAM_PLANNED, "plan-made", "plan-in-force", "formation-closed", "entered", "left",
)  # fmt: skip
"""Events that would leave no room for others."""
PLANNED = (STREAM_PLANNED, "plan-made")


@define
class Newest:
    """The newest events that are not everyday ones."""

    _rows: deque[list[Any]] = field(factory=lambda: deque(maxlen=MOST_NEWS))

    def add(self, t_s: float, who: str, kind: str, data: Mapping[str, Any]) -> None:
        """Add an event."""
        if kind not in FREQUENT:
            self._rows.append([round(t_s, 1), who, kind, details(data)])

    @property
    def rows(self) -> list[list[Any]]:
        """All of them, oldest first: [t, who, what, details]."""
        return list(self._rows)


def details(data: Mapping[str, Any]) -> str:
    """Return an event's data in one short line."""
    text = ", ".join(f"{name} {_brief(value)}" for name, value in data.items())
    return text if len(text) <= MOST_CHARACTERS else text[: MOST_CHARACTERS - 1] + "…"


def _brief(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return " ".join(_brief(item) for item in value)
    return str(value)


def plan_facts(t_s: float, kind: str, data: Mapping[str, Any]) -> list[Any] | None:
    """Return what a frame says of a plan, by an event that tells of one; None of any other."""
    if kind not in PLANNED:
        return None
    return [
        round(t_s, 1),
        _number(data.get("vehicles")),
        _number(data.get("solve_ms")),
        solver_of_event(kind, data),
        data.get("fallback") is True,
    ]


def _number(value: object) -> float:
    """Return a number that can be shown; 0 for whatever else a sender says."""
    if isinstance(value, (int, float)) and abs(value) < MOST_NUMBER:
        return round(float(value), 2)
    return 0.0
