"""Errors that a person reads."""

from __future__ import annotations

import reprlib

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 4
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 12
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 80


class BadInputError(ValueError):
    """Something a user or a peer supplied is not acceptable.

    The message is one line that names the field, the value and what is allowed. The command line
    prints it and ends with exit status 2; a running process counts it and goes on.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        """Store the three parts; `value` is shortened so that the line stays readable."""
        self.field = field
        self.value = value
        self.allowed = allowed
        super().__init__(field, value, allowed)

    def __str__(self) -> str:
        """Return the one line, whatever the value and the name are."""
        try:
            shown = _SHORT.repr(self.value)
        except ValueError:  # an integer of thousands of digits
            shown = f"a huge {type(self.value).__name__}"
        field, value, allowed = one_line(self.field, 120), one_line(shown, 80), self.allowed
        return f"{field}: got {value}; allowed: {one_line(allowed)}"

    def within(self, parent: str) -> BadInputError:
        """Return the same error with `parent` put before the field's name."""
        separator = "." if parent and self.field and not self.field.startswith("[") else ""
        return BadInputError(f"{parent}{separator}{self.field}", self.value, self.allowed)


def one_line(text: str, length: int = 500) -> str:
    """Return text as one readable line, or as part of one."""
    words = "".join(char if char.isprintable() else " " for char in text).split()
    line = " ".join(words)
    return line if len(line) <= length else line[: length - 3] + "..."


class RefusedError(Exception):
    """Somebody else refused the input; the message is their line. Exit status 2."""


class CommandFailedError(RuntimeError):
    """The input is good and yet the command cannot be done; the message says why. Status 1."""
