"""Violations of properties that every run must satisfy, and how checks report them."""

from __future__ import annotations

from collections.abc import Callable

from attrs import frozen

Report = Callable[[str, float, list[str], str], None]
"""Callback for a violation: kind, virtual time, vehicles, text."""


@frozen
class Violation:
    """A violated property."""

    kind: str
    t_s: float
    """Virtual time."""
    vehicles: tuple[str, ...]
    text: str

    def __str__(self) -> str:
        """Return the violation as one line."""
        return f"{self.t_s:8.3f} s  {self.kind}: {', '.join(self.vehicles)}: {self.text}"


def once(report: Report) -> Report:
    """Return a callback that reports each violation only the first time.

    Two violations are the same if kind, first vehicle and text are equal.
    """
    reported: set[tuple[str, str, str]] = set()

    def report_once(kind: str, t_s: float, vehicles: list[str], text: str) -> None:
        if (kind, vehicles[0], text) not in reported:
            reported.add((kind, vehicles[0], text))
            report(kind, t_s, vehicles, text)

    return report_once
