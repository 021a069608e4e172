"""Tables and numbers as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

MISSING: Final = "missing"
"""Stands where a measurement is planned and not there."""
NOT_RUN: Final = "-"
"""Stands where none is planned."""
HOLDS, MISSED = "holds", "**missed**"


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; without rows it has one that says so."""
    listed = list(rows) or [[MISSING, *[""] * (len(headings) - 1)]]
    lines = [" | ".join(cells) for cells in (headings, *listed)]
    rule = "|" + "---|" * len(headings)
    first, *others = (f"| {line} |" for line in lines)
    return "\n".join((first, rule, *others))


def number(value: float | None, digits: int) -> str:
    """Return a number as text, `-` where it is not known."""
    return "-" if value is None else f"{value:.{digits}f}"
