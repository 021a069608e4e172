"""Strict conversion of untyped maps (TOML, MessagePack, JSON) into attrs classes, with cattrs.

Nothing is coerced: a string is not a number, a bool is not an int, an int is accepted where a
float is meant. Unknown keys are errors. Every failure becomes one `BadInputError` that names the
field by its path.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import attrs
from cattrs import Converter
from cattrs.errors import (
    AttributeValidationNote,
    BaseValidationError,
    ForbiddenExtraKeysError,
    IterableValidationNote,
)

from laneweave.protocol.errors import BadInputError

T = TypeVar("T")


def _exactly(kind: type, name: str) -> Callable[[object, type], object]:
    def hook(value: object, _: type) -> object:
        if type(value) is not kind:
            raise BadInputError("", value, name)
        return value

    return hook


def _number(value: object, _: type) -> float:
    if type(value) is int:
        return float(value)
    if type(value) is not float or not math.isfinite(value):
        raise BadInputError("", value, "a finite number")
    return value


def strict_converter(*, detailed: bool) -> Converter:
    """Return a converter that coerces nothing; `detailed` collects paths for error messages."""
    converter = Converter(forbid_extra_keys=True, detailed_validation=detailed)
    converter.register_structure_hook(int, _exactly(int, "an integer"))
    converter.register_structure_hook(str, _exactly(str, "a string"))
    converter.register_structure_hook(bool, _exactly(bool, "true or false"))
    converter.register_structure_hook(bytes, _exactly(bytes, "bytes"))
    converter.register_structure_hook(float, _number)
    return converter


_CONVERTER = strict_converter(detailed=True)


def structure(data: Mapping[str, Any], kind: type[T]) -> T:
    """Build an instance of the attrs class `kind` from nested maps.

    Raises:
        BadInputError: the first thing that is wrong, named by its path.
    """
    if not isinstance(data, Mapping):
        raise BadInputError("", data, "a table")
    try:
        return _CONVERTER.structure(data, kind)
    except BaseValidationError as group:
        raise first_problem(group) from None
    except BadInputError:
        raise
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise BadInputError("", data, str(error)) from error


def first_problem(error: Exception, path: str = "") -> BadInputError:
    """Return the first leaf of a cattrs error group as one line with its path."""
    if isinstance(error, BaseValidationError):
        for inner in error.exceptions:
            return first_problem(inner, path + _step(inner, bool(path)))
    if isinstance(error, ForbiddenExtraKeysError):
        unknown = min(error.extra_fields)
        allowed = sorted(attribute.alias for attribute in attrs.fields(error.cl))
        name = f"{path}.{unknown}" if path else unknown
        return BadInputError(name, "an unknown key", "one of " + ", ".join(allowed))
    if isinstance(error, BadInputError):
        return (
            error.within(path) if error.field else BadInputError(path, error.value, error.allowed)
        )
    if isinstance(error, KeyError):
        return BadInputError(path, "nothing", "a value; this field is required")
    return BadInputError(path, "a value of another kind", str(error) or type(error).__name__)


def _step(error: BaseException, nested: bool) -> str:
    for note in getattr(error, "__notes__", []):
        if isinstance(note, AttributeValidationNote):
            return f".{note.name}" if nested else note.name
        if isinstance(note, IterableValidationNote):
            return f"[{note.index}]"
    return ""
