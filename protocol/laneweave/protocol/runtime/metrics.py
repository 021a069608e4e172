"""Numbers that a process offers to whoever looks at it, without knowing who that is.

A *snapshot* is a frozen attrs class with a class variable `ABOUT` and one field for each number: an
int, a float, a bool, or a mapping of text to number. The class is the one description of its
numbers: a field's name says the unit last, in base units, and ends with `_total` if the number only
ever grows; its metadata, made by `told`, says what it is.

Whoever looks does so from a thread of its own, and never into what another one counts: it puts a
`Look` among the events of the process, and the thread that counts answers it (`looking`).
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar, Protocol

import attrs
from attrs import frozen

PREFIX = "laneweave"
LOOK_S = 2.0
"""A process that is too busy to tell its numbers in this time hangs."""


class Snapshot(attrs.AttrsInstance, Protocol):
    """Numbers of one subject at one moment."""

    ABOUT: ClassVar[str]
    """What they are about, the first word of their names."""


Source = Callable[[], Iterable[Snapshot]]
"""Returns the numbers of a process as they are now; callable from any thread but its own. Raises
`TimeoutError` where the process hangs."""
Observe = Callable[[Source], None]
"""Is told where the numbers of a process come from, once they can be asked for."""


def unobserved(_: Source) -> None:
    """Let nobody look: the `Observe` of most processes."""


@frozen
class Look:
    """Somebody wants to know a process's numbers."""

    _answers: queue.SimpleQueue[Iterable[Snapshot]] = attrs.field(factory=queue.SimpleQueue)

    def answer(self, numbers: Iterable[Snapshot]) -> None:
        """Tell them; to be called by the thread that counts."""
        self._answers.put(numbers)

    def wait(self) -> Iterable[Snapshot]:
        """Return the answer.

        Raises:
            TimeoutError: there was none in time.
        """
        try:
            return self._answers.get(timeout=LOOK_S)
        except queue.Empty:
            raise TimeoutError(f"no numbers within {LOOK_S:g} s") from None


def looking(ask: Callable[[Look], None]) -> Source:
    """Return a source that hands looks to `ask` and waits for their answers."""

    def look() -> Iterable[Snapshot]:
        one = Look()
        ask(one)
        return one.wait()

    return look


class Offering(Protocol):
    """A core that has numbers to offer."""

    @property
    def numbers(self) -> Iterable[Snapshot]:
        """Its numbers as they are now."""


@frozen
class Metric:
    """The description of one number."""

    name: str
    """Whole, as in `laneweave_node_published_total`."""
    meaning: str
    label: str
    """What tells the parts of it from each other; empty: it has none."""
    field: str
    """Of the snapshot."""

    @property
    def counts(self) -> bool:
        """Whether it only ever grows."""
        return self.name.endswith("_total")

    def samples(self, snapshot: Snapshot) -> Iterator[tuple[tuple[str, ...], float]]:
        """Yield the labels' values and the number, for each part of it."""
        value = getattr(snapshot, self.field)
        if self.label:
            for part, number in value.items():
                yield (str(part),), float(number)
        else:
            yield (), float(value)


def told(meaning: str, *, label: str = "") -> dict[str, Any]:
    """Return a field's metadata.

    Args:
        meaning: what the number is, in one sentence without the full stop.
        label: of a mapping: what its keys are.
    """
    return {"meaning": meaning, "label": label}


def metrics_of(kind: type[Snapshot]) -> tuple[Metric, ...]:
    """Return what the numbers of a snapshot are."""
    return tuple(
        Metric(
            name=f"{PREFIX}_{kind.ABOUT}_{attribute.name}",
            meaning=attribute.metadata.get("meaning") or attribute.name.replace("_", " "),
            label=attribute.metadata.get("label", ""),
            field=attribute.name,
        )
        for attribute in attrs.fields(kind)
    )


@frozen
class NodeNumbers:
    """What a node has counted."""

    ABOUT: ClassVar[str] = "node"

    published_total: int = attrs.field(metadata=told("Messages that this process has published"))
    received_total: Mapping[str, int] = attrs.field(
        metadata=told("Well-formed messages that have arrived", label="topic")
    )
    rejected_total: int = attrs.field(
        metadata=told("Messages that have arrived and were not well formed")
    )
    events_total: int = attrs.field(
        metadata=told("Events that the core has handled: messages, tokens, timers, results")
    )
    handling_seconds_total: float = attrs.field(
        metadata=told("Time that this process has spent on handling events")
    )


@frozen
class RouterNumbers:
    """What a router knows of itself."""

    ABOUT: ClassVar[str] = "router"

    sessions: int = attrs.field(metadata=told("Processes that are connected"))
