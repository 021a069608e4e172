"""Errors that are reported to the user."""

from __future__ import annotations

import reprlib
from typing import Final

from attrs import frozen

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 4
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 12
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 80


@frozen(repr=False)
class Described:
    """A description in the place of a value, which a message shows without quotes."""

    text: str

    def __repr__(self) -> str:
        """Return the text."""
        return self.text


NO_VALUE: Final = Described("no value")
UNKNOWN_KEY: Final = Described("an unknown key")


class BadInputError(ValueError):
    """A value from a user or a peer is invalid.

    The one-line message names the field, the value and the allowed values. The command line prints
    the message and exits with status 2; a running process counts the error and continues.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        """Store the parts of the message, which shows a shortened `value`."""
        self.field = field
        self.value = value
        self.allowed = allowed
        super().__init__(field, value, allowed)

    def __str__(self) -> str:
        """Return the message as one line."""
        try:
            shown = _SHORT.repr(self.value)
        except ValueError:  # an integer with thousands of digits
            shown = f"a huge {type(self.value).__name__}"
        field, value, allowed = one_line(self.field, 120), one_line(shown, 80), self.allowed
        return f"{field}: got {value}; allowed: {one_line(allowed)}"

    def within(self, parent: str) -> BadInputError:
        """Return the same error with the field's name prefixed by `parent`."""
        separator = "." if parent and self.field and not self.field.startswith("[") else ""
        return BadInputError(f"{parent}{separator}{self.field}", self.value, self.allowed)


def one_line(text: str, length: int = 500) -> str:
    """Return a text as one printable line of at most `length` characters."""
    words = "".join(char if char.isprintable() else " " for char in text).split()
    line = " ".join(words)
    return line if len(line) <= length else line[: length - 3] + "..."


class RefusedError(Exception):
    """Another process rejected the input; the message is its reason. Exit status 2."""


class CommandFailedError(RuntimeError):
    """A command failed although its input is valid; the message says why. Exit status 1."""
