"""Metrics of a process: what it counts, described once, readable from other threads.

A *snapshot* is a frozen attrs class with a class variable `ABOUT` and one field per metric: an int,
a float, a bool, or a mapping of text to number, described by `metric`. Field names end with the
unit, in base units, and with `_total` if the value only ever grows.

A reader never touches the counters of another thread: it puts a `SnapshotRequest` among the events
of the process, and the thread that counts answers it (`snapshot_source`).
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar, Protocol

import attrs
from attrs import frozen

PREFIX = "laneweave"
SNAPSHOT_TIMEOUT_S = 2.0
"""A process that does not answer a request in this time counts as hanging."""


class MetricsSnapshot(attrs.AttrsInstance, Protocol):
    """Metrics of one subject at one moment."""

    ABOUT: ClassVar[str]
    """Subject: the first word of the metrics' names."""


Source = Callable[[], Iterable[MetricsSnapshot]]
"""Returns the current metrics of a process; callable from any thread but its own. Raises
`TimeoutError` if the process hangs."""
Observe = Callable[[Source], None]
"""Callback that registers the metrics source of a process, once it is ready."""


def unobserved(_: Source) -> None:
    """Ignore the source: the `Observe` of a process without a metrics server."""


@frozen
class SnapshotRequest:
    """Request for the metrics of a process, answered by the thread that counts."""

    _answers: queue.SimpleQueue[Iterable[MetricsSnapshot]] = attrs.field(factory=queue.SimpleQueue)

    def answer(self, snapshots: Iterable[MetricsSnapshot]) -> None:
        """Answer; called by the thread that counts."""
        self._answers.put(snapshots)

    def wait(self) -> Iterable[MetricsSnapshot]:
        """Return the answer.

        Raises:
            TimeoutError: there was none in time.
        """
        try:
            return self._answers.get(timeout=SNAPSHOT_TIMEOUT_S)
        except queue.Empty:
            raise TimeoutError(f"no metrics within {SNAPSHOT_TIMEOUT_S:g} s") from None


def snapshot_source(request: Callable[[SnapshotRequest], None]) -> Source:
    """Return a source that passes requests to `request` and waits for their answers."""

    def snapshots() -> Iterable[MetricsSnapshot]:
        one = SnapshotRequest()
        request(one)
        return one.wait()

    return snapshots


@frozen
class Metric:
    """Description of one metric."""

    name: str
    """Full name, such as `laneweave_node_published_total`."""
    meaning: str
    label: str
    """Name of the label that distinguishes its parts; empty: it has none."""
    field: str
    """Field of the snapshot."""

    @property
    def counts(self) -> bool:
        """Whether it only ever grows."""
        return self.name.endswith("_total")

    def samples(self, snapshot: MetricsSnapshot) -> Iterator[tuple[tuple[str, ...], float]]:
        """Yield (label values, number) for each part."""
        value = getattr(snapshot, self.field)
        if self.label:
            for part, number in value.items():
                yield (str(part),), float(number)
        else:
            yield (), float(value)


def metric(meaning: str, *, label: str = "", default: object = attrs.NOTHING) -> Any:  # noqa: ANN401
    """Return the attrs field of a metric.

    Args:
        meaning: what the number is, in one sentence without the full stop.
        label: of a mapping: what its keys are.
        default: of the field; without one it is mandatory.
    """
    return attrs.field(default=default, metadata={"meaning": meaning, "label": label})


def metrics_of(kind: type[MetricsSnapshot]) -> tuple[Metric, ...]:
    """Return the descriptions of a snapshot's metrics."""
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
class NodeMetrics:
    """Counters of a node."""

    ABOUT: ClassVar[str] = "node"

    published_total: int = metric("Messages that this process has published")
    received_total: Mapping[str, int] = metric(
        "Well-formed messages that have arrived", label="topic"
    )
    rejected_total: int = metric("Messages that have arrived and were not well formed")
    events_total: int = metric(
        "Events that the core has handled: messages, tokens, timers, results"
    )
    handling_seconds_total: float = metric("Time that this process has spent on handling events")


@frozen
class RouterMetrics:
    """Counters of a router."""

    ABOUT: ClassVar[str] = "router"

    sessions: int = metric("Processes that are connected")
