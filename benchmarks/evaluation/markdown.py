"""Tables and numbers as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

MISSING: Final = "missing"
"""Text for a planned measurement that is not available yet."""
NOT_RUN: Final = "-"
"""Text for a measurement that is not planned."""
HOLDS, MISSED = "holds", "**missed**"


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; without rows, a table with one row `MISSING`."""
    listed = list(rows) or [[MISSING, *[""] * (len(headings) - 1)]]
    lines = [" | ".join(cells) for cells in (headings, *listed)]
    rule = "|" + "---|" * len(headings)
    first, *others = (f"| {line} |" for line in lines)
    return "\n".join((first, rule, *others))


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def number(value: float | None, digits: int) -> str:
    """Return a number as text, or `-` if it is unknown."""
    return "-" if value is None else f"{value:.{digits}f}"
