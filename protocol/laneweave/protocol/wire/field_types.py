"""Types of the fields of messages, which are checked when a message is decoded."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Real = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""Finite number; its range is wider than any position, speed or time, and safe in calculations."""

Cell = tuple[Int64, Int64]
"""`lattice.Cell`."""
PlannedMove = tuple[Int64, Cell, Cell]
"""`lattice.PlannedMove`."""


class Message(Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Base class of messages and of the classes that are part of them: an array of its fields."""
