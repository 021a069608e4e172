"""Errors that are reported to the user."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Collection, Iterable, Sequence
from itertools import islice
from typing import Final

from attrs import frozen

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 4
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 12
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 80
MAX_PROBLEMS = 100
"""Number of errors of one input after which the rest of it is not examined."""
MAX_COMPARED = 100
"""Maximum length of a name that is compared with allowed names."""


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

    def __init__(
        self,
        field: str,
        value: object,
        allowed: str,
        *,
        choices: Collection[object] = (),
        place: str = "",
        at_least: float | None = None,
    ) -> None:
        """Store the parts of the message, which shows a shortened `value`.

        Args:
            field: name of the field, with its path in a file.
            value: the invalid value; `UNKNOWN_KEY` if the last part of `field` is an invalid name.
            allowed: description of the allowed values.
            choices: the allowed values, of which the message suggests the most similar one; empty:
                no suggestion.
            place: file and line of the value; empty: unknown, or not from a file.
            at_least: lowest allowed value; None: there is none, or it is only in `allowed`.
        """
        self.field = field
        self.value = value
        self.allowed = allowed
        self.choices = choices
        self.place = place
        self.at_least = at_least
        super().__init__(field, value, allowed)

    @property
    def problems(self) -> tuple[BadInputError, ...]:
        """The errors of single values: this one, or several."""
        return (self,)

    @property
    def suggestion(self) -> str:
        """The choice that was probably meant; empty if none is similar."""
        if len(self.choices) == 1 and self.value is UNKNOWN_KEY:
            return str(*self.choices)
        name = self.field.rpartition(".")[2] if self.value is UNKNOWN_KEY else self.value
        return most_similar(name, self.choices)

    def __str__(self) -> str:
        """Return the message as one line."""
        try:
            shown = _SHORT.repr(self.value)
        except ValueError:  # an integer with thousands of digits
            shown = f"a huge {type(self.value).__name__}"
        field, value, allowed = one_line(self.field, 180), one_line(shown, 80), self.allowed
        line = f"{field}: got {value}; allowed: {one_line(allowed)}"
        suggestion = self.suggestion
        if suggestion:
            line += f"; did you mean {one_line(suggestion, 80)}?"
        return f"{line} ({one_line(self.place)})" if self.place else line

    def within(self, parent: str) -> BadInputError:
        """Return the same error with the field's name prefixed by `parent`."""
        separator = "." if parent and self.field and not self.field.startswith("[") else ""
        return self._with(field=f"{parent}{separator}{self.field}")

    def at(self, place: str) -> BadInputError:
        """Return the same error with its place in a file, unless it has one."""
        return self._with(place=self.place or place)

    def of(self, field: str) -> BadInputError:
        """Return the same error with another name of the field."""
        return self._with(field=field)

    def suggesting(self, suggestion: str) -> BadInputError:
        """Return the same error of an unknown key with another suggestion."""
        return self._with(choices=(suggestion,))

    def _with(
        self,
        field: str | None = None,
        place: str | None = None,
        choices: Collection[object] | None = None,
    ) -> BadInputError:
        return BadInputError(
            self.field if field is None else field,
            self.value,
            self.allowed,
            choices=self.choices if choices is None else choices,
            place=self.place if place is None else place,
            at_least=self.at_least,
        )


class SeveralBadInputsError(BadInputError):
    """Several values of one input are invalid.

    Field, value and message are those of the first error; `problems` has all of them.
    """

    def __init__(self, problems: Sequence[BadInputError]) -> None:
        """Store the errors, at least one."""
        first = problems[0]
        super().__init__(
            first.field,
            first.value,
            first.allowed,
            choices=first.choices,
            place=first.place,
            at_least=first.at_least,
        )
        self._problems = tuple(problems)

    @property
    def problems(self) -> tuple[BadInputError, ...]:
        """The errors of single values."""
        return self._problems

    def __str__(self) -> str:
        """Return the message of the first error, and how many others there are."""
        more = len(self._problems) - 1
        return f"{self._problems[0]} (and {more} more error{'s' if more > 1 else ''})"

    def __reduce__(self) -> tuple[type[SeveralBadInputsError], tuple[tuple[BadInputError, ...]]]:
        """Return how to copy the error to another process."""
        return SeveralBadInputsError, (self._problems,)

    def within(self, parent: str) -> SeveralBadInputsError:
        """Return the same errors with the fields' names prefixed by `parent`."""
        return SeveralBadInputsError([one.within(parent) for one in self._problems])

    def at(self, place: str) -> SeveralBadInputsError:
        """Return the same errors with their place in a file, unless they have one."""
        return SeveralBadInputsError([one.at(place) for one in self._problems])


def combined(errors: Iterable[BadInputError]) -> BadInputError:
    """Return one or more errors as one; of several errors of a field, only the first is kept."""
    first: dict[str, BadInputError] = {}
    for error in errors:
        for problem in error.problems:
            first.setdefault(one_line(problem.field), problem)
    problems = list(first.values())
    return SeveralBadInputsError(problems) if len(problems) > 1 else problems[0]


def raise_all(errors: Iterable[BadInputError]) -> None:
    """Raise the errors, at most `MAX_PROBLEMS`, as one; do nothing if there are none."""
    problems = [*islice(errors, MAX_PROBLEMS)]
    if problems:
        raise combined(problems)


def unknown_name(
    field: str, value: object, choices: Collection[object], allowed: str = ""
) -> BadInputError:
    """Return the error of a value that is not one of the choices, which suggests a similar one.

    Args:
        field: name of the field.
        value: the invalid value; `UNKNOWN_KEY` if the last part of `field` is the invalid name.
        choices: the allowed values.
        allowed: description of the allowed values; empty: their list.
    """
    described = allowed or "one of " + ", ".join(map(str, choices))
    return BadInputError(field, value, described, choices=choices)


def most_similar(name: object, choices: Iterable[object]) -> str:
    """Return the choice that a misspelt name probably means; empty if none is similar."""
    if not isinstance(name, str) or len(name) > MAX_COMPARED:
        return ""
    wanted = _comparable(name)
    comparable = {_comparable(str(choice)): str(choice) for choice in reversed([*choices])}
    found = difflib.get_close_matches(wanted, comparable, n=1)
    # `volume` for `volume_veh_per_lane_h`
    found += [one for one in comparable if wanted and one.startswith(f"{wanted}_")]
    return comparable[found[0]] if found else ""


def _comparable(name: str) -> str:
    return name.lower().replace("-", "_")


def one_line(text: str, length: int = 500) -> str:
    """Return a text as one printable line of at most `length` characters."""
    if not text.isprintable():
        text = "".join(char if char.isprintable() else " " for char in text)
    line = " ".join(text.split())
    return line if len(line) <= length else line[: length - 3] + "..."


class RefusedError(Exception):
    """Another process rejected the input; the message is its reason. Exit status 2."""


class CommandFailedError(RuntimeError):
    """A command failed although its input is valid; the message says why. Exit status 1."""
