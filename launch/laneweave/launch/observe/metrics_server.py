"""An HTTP server for the metrics of a process, in the Prometheus text format."""

from __future__ import annotations

import contextlib
import socket
import socketserver
import sys
import threading
from collections.abc import Iterator
from http.server import ThreadingHTTPServer

import structlog
from prometheus_client import (
    CollectorRegistry,
    MetricsHandler,
    ProcessCollector,
    generate_latest,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.field_validators import host_and_port
from laneweave.protocol.runtime.metrics import MetricsSnapshot, Observe, Source, metrics_of

log = structlog.get_logger(__name__)

FIELD = "observation.metrics"
PROCESS = "laneweave_process_info"
PROCESS_MEANING = "1, with labels that describe this process"
REQUEST_S = 5.0
"""Timeout for reading a request."""
POLL_S = 0.05
"""Period at which the server checks for shutdown."""


class MetricsCollector(Collector):
    """Collector that reads the metrics of a process at each request."""

    def __init__(self, labels: dict[str, str]) -> None:
        """Start without a metrics source; `labels` describe the process."""
        self._labels = labels
        self._source: Source | None = None

    def register(self, source: Source) -> None:
        """Set the source of metrics; called once the process has started."""
        self._source = source

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics; see `Collector`."""
        about = GaugeMetricFamily(PROCESS, PROCESS_MEANING, labels=list(self._labels))
        about.add_metric(list(self._labels.values()), 1.0)
        yield about
        for snapshot in self._source() if self._source is not None else ():
            yield from families(snapshot)


def families(snapshot: MetricsSnapshot) -> Iterator[Metric]:
    """Yield the metrics of a snapshot as Prometheus metric families."""
    for metric in metrics_of(type(snapshot)):
        kind = CounterMetricFamily if metric.counts else GaugeMetricFamily
        family = kind(metric.name, metric.meaning, labels=[metric.label] if metric.label else [])
        for labels, value in metric.samples(snapshot):
            family.add_metric(labels, value)
        yield family


def text_of(snapshot: MetricsSnapshot) -> bytes:
    """Return a snapshot in the Prometheus text format."""

    class Snapshot(Collector):
        def collect(self) -> Iterator[Metric]:
            return families(snapshot)

    registry = CollectorRegistry()
    registry.register(Snapshot())
    return generate_latest(registry)


class _Server(ThreadingHTTPServer):
    def __init__(self, host: str, port: int, registry: CollectorRegistry) -> None:
        class Handler(MetricsHandler):
            timeout = REQUEST_S

        Handler.registry = registry
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), Handler)

    def server_bind(self) -> None:
        # The base class would also look up the host name, which may be slow.
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def handle_error(self, *_: object) -> None:
        # Log no traceback when a client disconnects.
        log.warning("metrics not sent", reason=repr(sys.exc_info()[1]))


@contextlib.contextmanager
def serve_metrics(address: str, **labels: str) -> Iterator[Observe]:
    """Serve metrics until the context exits.

    All threads are daemons, so that clients do not delay process exit.

    Args:
        address: HOST:PORT to listen on.
        labels: labels that describe the process.

    Yields:
        A function that registers the source of the metrics.

    Raises:
        BadInputError: the address cannot be used.
    """
    collector = MetricsCollector(labels)
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
        yield collector.register
    finally:
        server.shutdown()
        server.server_close()
