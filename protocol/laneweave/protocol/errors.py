"""Errors that a person reads."""

from __future__ import annotations


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
        """Return the one line."""
        shown = " ".join(repr(self.value).split())
        if len(shown) > 80:
            shown = shown[:77] + "..."
        return f"{self.field}: got {shown}; allowed: {self.allowed}"

    def within(self, parent: str) -> BadInputError:
        """Return the same error with `parent` put before the field's name."""
        separator = "" if self.field.startswith("[") or not self.field else "."
        return BadInputError(f"{parent}{separator}{self.field}", self.value, self.allowed)
