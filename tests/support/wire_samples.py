"""Messages of every kind, made from the types of their fields, so that a new kind is included."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from msgspec import Struct

from laneweave.protocol.wire.codec import KINDS
from laneweave.protocol.wire.messages import Ballot, Name

Leaf = Callable[[Any], Any]
"""From the annotation of a simple field (a number, a name, ...) to its value."""


def is_struct(hint: object) -> bool:
    """Tell whether an annotation is a message or a class that is part of one."""
    return isinstance(hint, type) and issubclass(hint, Struct)


def hints_of(kinds: Mapping[str, type[Struct]]) -> dict[type, dict[str, Any]]:
    """Return the annotations of the fields of all kinds, and of the classes nested in them."""
    found: dict[type, dict[str, Any]] = {}

    def add(hint: Any) -> None:  # noqa: ANN401
        if is_struct(hint) and hint not in found:
            found[hint] = get_type_hints(hint)
        for part in found[hint].values() if is_struct(hint) else get_args(hint):
            add(part)

    for kind in kinds.values():
        add(kind)
    return found


HINTS = hints_of(KINDS)


def filled(hint: Any, leaf: Leaf) -> Any:  # noqa: ANN401
    """Return a value of an annotation; optional parts are present, collections have one entry."""
    parts = get_args(hint)
    if is_struct(hint):
        return hint(**{name: filled(part, leaf) for name, part in HINTS[hint].items()})
    if hint is Ballot:
        return Ballot(leaf(int), leaf(Name), leaf(int), leaf(int))
    if get_origin(hint) in (Union, UnionType):
        return filled(next(part for part in parts if part is not NoneType), leaf)
    if get_origin(hint) is tuple:
        entries = parts[:1] if parts[-1] is Ellipsis else parts
        return tuple(filled(part, leaf) for part in entries)
    if get_origin(hint) is dict and parts[1] is not Any:
        return {filled(parts[0], leaf): filled(parts[1], leaf)}
    return leaf(hint)


def same(
    *, name: str, number: int, real: float, flag: bool = True, raw: bytes = b"", data: object = None
) -> Leaf:
    """Return a function that gives each simple field the value of its type."""
    values = {
        Name: name,
        str: name,
        int: number,
        float: real,
        bool: flag,
        bytes: raw,
        dict[str, Any]: data,
    }
    return values.__getitem__


def different() -> Leaf:
    """Return a function that gives each number and name a value of its own."""
    numbers = itertools.count(1)
    makers: dict[Any, Callable[[int], Any]] = {
        Name: "v{}".format,
        str: "text {}".format,
        int: lambda number: -number,
        float: lambda number: number + 0.5,
        bool: lambda number: number % 2 == 1,
        bytes: lambda number: bytes([number]) * 8,
        dict[str, Any]: lambda number: {"n": number, "pair": ["a", {"b": None}]},
    }
    return lambda hint: makers[hint](next(numbers))
