"""The line for a wrong command line: unknown commands and options, wrong values."""

from __future__ import annotations

import re
from typing import Any

import typer

from laneweave.protocol.errors import BadInputError, one_line, unknown_name

_ALLOWED = {
    "int_parsing": "an integer",
    "float_parsing": "a number",
    "value_error": "text without a null byte",
}
"""Allowed values, by the type of the error of typer's parser."""
_RANGES = ("greater_than_equal", "less_than_equal", "finite_number")


def usage_error(error: typer.TyperException) -> str:
    """Return the line for an error of typer, with the name that was probably meant."""
    line = one_line(str(getattr(error, "format_message", error.__str__)()))
    similar = getattr(error, "possibilities", None)
    if similar:
        return f"{getattr(error, 'message', line)}. Did you mean '{similar[0]}'?"
    found = re.match(r"Invalid value for '([^']*)'(?: \(env var: '(\w*)'\))?", line)
    reasons: list[dict[str, Any]] = getattr(error.__cause__ or error.__context__, "errors", list)()
    if not found or not reasons:
        return line
    name = f"{found[1]} or {found[2]}" if found[2] else found[1]
    return str(_wrong_value(name, reasons[0], getattr(error, "param", None)))


def _wrong_value(name: str, reason: dict[str, Any], parameter: object) -> BadInputError:
    """Return the error of the value of an option or argument.

    Args:
        name: name of the option or argument.
        reason: error of typer's parser, which is pydantic's.
        parameter: typer's object of the option or argument.
    """
    value, message = reason["input"], reason["msg"].removeprefix("Value error, ")
    choices = re.search(r" is not one of (.*)\.$", message)
    if choices:
        names = re.findall("'([^']*)'", choices[1])
        return unknown_name(name, value, names, ", ".join(names))
    allowed = _ALLOWED.get(reason["type"], message)
    if reason["type"] in _RANGES:
        low, high = (getattr(parameter, bound, None) for bound in ("min", "max"))
        allowed = f"at least {low}" if high is None else f"[{low:g}, {high:g}]"
    return BadInputError(name, value, allowed)
