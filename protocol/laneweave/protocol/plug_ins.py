"""Implementations that users choose by name: built in, or entry points of other distributions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from attrs import frozen

from laneweave.protocol.errors import BadInputError, one_line, unknown_name
from laneweave.protocol.names import NAME_PATTERN

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@frozen(eq=False)
class PlugIns:
    """All implementations of one kind.

    Built-in ones take precedence. Only the implementation that is asked for is imported, and
    entry points are searched only for names that are not built in.
    """

    kind: str
    """Kind, for messages, such as `solver`."""
    group: str
    """Group of the entry points."""
    built_in: Mapping[str, str]
    """Object of each built-in name, as `module:attribute`."""
    reserved: frozenset[str] = frozenset()
    """Names with another meaning, which plug-ins cannot have."""

    def names(self) -> tuple[str, ...]:
        """Return all names: built-in ones first, then those of plug-ins, sorted."""
        return (*self.built_in, *sorted(_entry_points(self.group).keys() - self._taken))

    def is_built_in(self, name: str) -> bool:
        """Return whether a name is built in."""
        return name in self.built_in

    def checked(self, name: str, field: str, others: Iterable[str] = ()) -> str:
        """Return the name of an existing implementation, which is not imported.

        Args:
            name: the name.
            field: field or option that contains it.
            others: other names that are allowed there, for the message.

        Raises:
            BadInputError: there is no such implementation, or two distributions have it.
        """
        if not self.is_built_in(name):
            self._plug_in(name, field, others)
        return name

    def origin(self, name: str) -> str:
        """Return name and version of a plug-in's distribution; empty: built in, or unknown."""
        points = [] if name in self._taken else _entry_points(self.group).get(name, [])
        return _distribution(points[0]) if points else ""

    def load(self, name: str, field: str) -> Any:  # noqa: ANN401 (its type is that of the group)
        """Import an implementation; if it is a class, return an instance.

        Raises:
            BadInputError: there is no such implementation, or a plug-in cannot be loaded.
        """
        if self.is_built_in(name):
            module, _, attribute = self.built_in[name].partition(":")
            return _instance(getattr(import_module(module), attribute))
        point = self._plug_in(name, field)
        try:
            return _instance(point.load())
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            allowed = f"a {self.kind} that can be loaded; that of {_distribution(point)} fails"
            raise BadInputError(field, name, one_line(f"{allowed}: {reason}")) from error

    @property
    def _taken(self) -> frozenset[str]:
        return self.reserved | self.built_in.keys()

    def _plug_in(self, name: str, field: str, others: Iterable[str] = ()) -> EntryPoint:
        points = [] if name in self._taken else _entry_points(self.group).get(name, [])
        if not points:
            names = tuple(dict.fromkeys([*others, *self.names()]))
            allowed = f"one of {', '.join(names)}, or the name of a plug-in that is installed"
            raise unknown_name(field, name, names, allowed)
        if len(points) > 1:
            both = " and ".join(map(_distribution, points))
            raise BadInputError(field, name, f"a {self.kind} of one distribution; {both} have one")
        return points[0]


@cache
def _entry_points(group: str) -> dict[str, list[EntryPoint]]:
    """Return the installed entry points of a group by name; names that are not valid are left out.

    The search is done once per process.
    """
    from importlib.metadata import entry_points  # noqa: PLC0415 (slow to import)

    found: dict[str, list[EntryPoint]] = {}
    for point in entry_points(group=group):
        if NAME_PATTERN.fullmatch(point.name):
            found.setdefault(point.name, []).append(point)
    return found


def _distribution(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else point.value


def _instance(found: Any) -> Any:  # noqa: ANN401
    return found() if isinstance(found, type) else found
