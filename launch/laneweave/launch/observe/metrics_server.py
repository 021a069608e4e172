"""Metrics of a process in the Prometheus text format, over HTTP, where they are asked for."""

from __future__ import annotations

import contextlib
import socket
import socketserver
import sys
import threading
from collections.abc import Iterator
from http.server import ThreadingHTTPServer

import structlog
from prometheus_client import CollectorRegistry, MetricsHandler, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import MetricsSnapshot, Observe, Source, metrics_of
from laneweave.protocol.validators import host_and_port

log = structlog.get_logger(__name__)

FIELD = "observation.metrics"
PROCESS = "laneweave_process_info"
PROCESS_MEANING = "1, with what this process is"
REQUEST_S = 5.0
"""Whoever asks gets this long to say what for."""
POLL_S = 0.05
"""How soon the server notices that it is to end."""


class NumbersCollector(Collector):
    """Asks a process for its numbers whenever somebody wants to see them."""

    def __init__(self, labels: dict[str, str]) -> None:
        """Begin without numbers; `labels` tell what the process is."""
        self._labels = labels
        self._source: Source | None = None

    def look_at(self, source: Source) -> None:
        """Take numbers from a source from now on: the process is up."""
        self._source = source

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics; see `Collector`."""
        about = GaugeMetricFamily(PROCESS, PROCESS_MEANING, labels=list(self._labels))
        about.add_metric(list(self._labels.values()), 1.0)
        yield about
        for snapshot in self._source() if self._source is not None else ():
            yield from families(snapshot)


def families(snapshot: MetricsSnapshot) -> Iterator[Metric]:
    """Yield the numbers of a snapshot as Prometheus knows them."""
    for metric in metrics_of(type(snapshot)):
        kind = CounterMetricFamily if metric.counts else GaugeMetricFamily
        family = kind(metric.name, metric.meaning, labels=[metric.label] if metric.label else [])
        for labels, value in metric.samples(snapshot):
            family.add_metric(labels, value)
        yield family


class _Server(ThreadingHTTPServer):
    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        class Handler(MetricsHandler):
            timeout = REQUEST_S

        Handler.registry = registry
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), Handler)

    def server_bind(self) -> None:
        # Not the base class's: that one looks up this machine's name, which may take its time.
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def handle_error(self, *_: object) -> None:
        # One who has gone away, or a process that hangs: no reason to write a traceback.
        log.warning("metrics not told", reason=repr(sys.exc_info()[1]))


@contextlib.contextmanager
def shown_metrics(address: str, **labels: str) -> Iterator[Observe]:
    """Serve metrics while the context lasts.

    The thread that serves is a daemon, as those that answer are: nobody who asks, or asks for
    nothing and stays, keeps the process from ending.

    Args:
        address: HOST:PORT, where it listens and nowhere else.
        labels: what the process is.

    Yields:
        What is to be told where the numbers come from.

    Raises:
        BadInputError: it cannot listen there.
    """
    collector = NumbersCollector(labels)
    registry = CollectorRegistry()
    registry.register(collector)
    ProcessCollector(registry=registry)
    try:
        server = _Server(*host_and_port(FIELD, address), registry)
    except OSError as error:
        allowed = f"an address of this machine and a free port ({error.strerror})"
        raise BadInputError(FIELD, address, allowed) from error
    serving = threading.Thread(
        target=server.serve_forever, args=(POLL_S,), name="metrics", daemon=True
    )
    serving.start()
    try:
        yield collector.look_at
    finally:
        server.shutdown()
        server.server_close()
