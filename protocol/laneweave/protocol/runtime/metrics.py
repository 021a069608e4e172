"""Metrics of a process, described once and readable from other threads.

A *snapshot* is a frozen attrs class with a class variable `ABOUT` and one field per metric: an int,
a float, a bool, or a mapping from text to numbers, described by `metric`. Field names end with a
base unit, and with `_total` if the value never decreases.

A reader does not access another thread's counters: it queues a `SnapshotRequest` as an input of
the process, and the counting thread answers it (`snapshot_source`).
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar, Protocol

import attrs
from attrs import frozen

PREFIX = "laneweave"
SNAPSHOT_TIMEOUT_S = 2.0
"""Time without an answer after which a process counts as hanging."""


class MetricsSnapshot(attrs.AttrsInstance, Protocol):
    """Metrics of one subject at one moment."""

    ABOUT: ClassVar[str]
    """Part of the metrics' names after `PREFIX`."""


Source = Callable[[], Iterable[MetricsSnapshot]]
"""Returns the current metrics of a process, called from another thread. Raises `TimeoutError` if
the process hangs."""
Observe = Callable[[Source], None]
"""Callback that registers the metrics source of a process when it is ready."""


def unobserved(_: Source) -> None:
    """Ignore the metrics source; the `Observe` for a process without a metrics server."""


@frozen
class SnapshotRequest:
    """Request for the metrics of a process, answered by its counting thread."""

    _answers: queue.SimpleQueue[Iterable[MetricsSnapshot]] = attrs.field(factory=queue.SimpleQueue)

    def answer(self, snapshots: Iterable[MetricsSnapshot]) -> None:
        """Set the answer; called by the counting thread."""
        self._answers.put(snapshots)

    def wait(self) -> Iterable[MetricsSnapshot]:
        """Wait for the answer and return it.

        Raises:
            TimeoutError: no answer arrives within `SNAPSHOT_TIMEOUT_S`.
        """
        try:
            return self._answers.get(timeout=SNAPSHOT_TIMEOUT_S)
        except queue.Empty:
            raise TimeoutError(f"no metrics within {SNAPSHOT_TIMEOUT_S:g} s") from None


def snapshot_source(request: Callable[[SnapshotRequest], None]) -> Source:
    """Return a source that passes a request to `request` and waits for the answer."""

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
    """Name of the label that distinguishes the samples; empty: a single, unlabelled sample."""
    field: str
    """Name of the snapshot field."""

    @property
    def counts(self) -> bool:
        """Whether the metric is a counter, which never decreases."""
        return self.name.endswith("_total")

    def samples(self, snapshot: MetricsSnapshot) -> Iterator[tuple[tuple[str, ...], float]]:
        """Yield (label values, value) for each sample."""
        value = getattr(snapshot, self.field)
        if self.label:
            for part, number in value.items():
                yield (str(part),), float(number)
        else:
            yield (), float(value)


def metric(meaning: str, *, label: str = "", default: object = attrs.NOTHING) -> Any:  # noqa: ANN401
    """Return the attrs field of a metric.

    Args:
        meaning: description of the value, without a final full stop.
        label: name of the label for the keys of a mapping.
        default: default value; a field without one is mandatory.
    """
    return attrs.field(default=default, metadata={"meaning": meaning, "label": label})


def metrics_of(kind: type[MetricsSnapshot]) -> tuple[Metric, ...]:
    """Return the descriptions of the metrics in a snapshot class."""
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

    published_total: int = metric("Messages published by this process")
    received_total: Mapping[str, int] = metric("Valid messages received", label="topic")
    rejected_total: int = metric("Invalid messages received")
    skipped_fields_total: int = metric("Fields of a later release in messages received")
    events_total: int = metric("Events handled by the core: messages, tokens, timers, results")
    handling_seconds_total: float = metric("Time spent handling events")


@frozen
class RouterMetrics:
    """Counters of a router."""

    ABOUT: ClassVar[str] = "router"

    sessions: int = metric("Connected processes")
