"""Reading single values of a JSON document, with errors that name the field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from laneweave.coordinator.planning.grid import Cell
from laneweave.protocol.errors import BadInputError, one_line


def as_mapping(field: str, value: object, known: Sequence[str]) -> Mapping[str, Any]:
    """Return an object that has no keys but the known ones."""
    if not isinstance(value, Mapping):
        raise BadInputError(field, value, "an object")
    for key in value:
        if key not in known:
            shown = one_line(str(key), 80) or repr(key)
            name = f"{field}.{shown}" if field != "request" else shown
            raise BadInputError(name, value[key], "only the keys " + ", ".join(known))
    return value


def require(fields: Mapping[str, Any], parent: str, names: Sequence[str]) -> None:
    """Reject an object in which one of the names is missing."""
    for name in names:
        if name not in fields:
            raise BadInputError(f"{parent}.{name}" if parent else name, None, "a required field")


def as_list(field: str, value: object, most: int) -> Sequence[Any]:
    """Return a list of at most `most` items."""
    if not isinstance(value, list | tuple):
        raise BadInputError(field, value, "a list")
    if len(value) > most:
        raise BadInputError(field, f"{len(value)} items", f"at most {most} items")
    return value


def as_int(field: str, value: object, least: int, most: int) -> int:
    """Return a whole number in a range; true and false are no numbers."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise BadInputError(field, value, f"a whole number from {least} to {most}")
    return value


def as_bool(field: str, value: object) -> bool:
    """Return true or false."""
    if not isinstance(value, bool):
        raise BadInputError(field, value, "true or false")
    return value


def as_text(field: str, value: object) -> str:
    """Return a string."""
    if not isinstance(value, str):
        raise BadInputError(field, value, "a string")
    return value


def as_cell(field: str, value: object) -> Cell:
    """Return a pair [column, lane] of whole numbers."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise BadInputError(field, value, "[column, lane]")
    for number in value:
        if isinstance(number, bool) or not isinstance(number, int):
            raise BadInputError(field, value, "[column, lane], two whole numbers")
    return value[0], value[1]
