"""Metrics over HTTP: how numbers become metrics, and a server that nobody can hold up."""

from __future__ import annotations

import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Mapping
from typing import ClassVar

import pytest
from attrs import Factory, frozen
from prometheus_client.parser import text_string_to_metric_families

from laneweave.launch.observe.metrics_server import families, serve_metrics
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import MetricsSnapshot, metric, metrics_of, snapshot_source


@frozen
class Counted:
    """A snapshot."""

    ABOUT: ClassVar[str] = "test"

    apples_total: int = metric("Apples eaten", default=3)
    pears_total: Mapping[str, int] = metric(
        "Pears eaten", label="colour", default=Factory(lambda: {"green": 1, "red": 2})
    )
    ripe: bool = True
    age_seconds: float = 1.5


def free_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def scrape(address: str) -> dict[tuple[str, ...], float]:
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=60) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain")
        text = answer.read().decode()
    return {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_numbers_become_metrics() -> None:
    found = list(families(Counted()))
    assert [(one.name, one.type) for one in found] == [
        ("laneweave_test_apples", "counter"),
        ("laneweave_test_pears", "counter"),
        ("laneweave_test_ripe", "gauge"),
        ("laneweave_test_age_seconds", "gauge"),
    ]
    assert [metric.meaning for metric in metrics_of(Counted)] == [
        "Apples eaten", "Pears eaten", "ripe", "age seconds",
    ]  # fmt: skip


def test_metrics_are_read_at_each_request() -> None:
    address, eaten = free_address(), 0

    def source() -> Iterable[MetricsSnapshot]:
        nonlocal eaten
        eaten += 1
        return [Counted(apples_total=eaten)]

    with serve_metrics(address, role="test", name="t1") as observe:
        assert scrape(address)["laneweave_process_info", "t1", "test"] == 1.0
        observe(source)
        assert scrape(address)["laneweave_test_apples_total",] == 1.0
        found = scrape(address)
    assert found["laneweave_test_apples_total",] == 2.0
    assert found["laneweave_test_pears_total", "red"] == 2.0
    assert found["laneweave_test_ripe",] == 1.0
    with pytest.raises(urllib.error.URLError):
        scrape(address)


@pytest.mark.slow
def test_the_thread_that_counts_answers() -> None:
    with pytest.raises(TimeoutError, match="no metrics within 2 s"):
        snapshot_source(lambda _: None)()
    assert list(snapshot_source(lambda look: look.answer([Counted()]))()) == [Counted()]


def test_a_process_that_hangs_tells_nothing() -> None:
    address = free_address()

    def source() -> Iterable[MetricsSnapshot]:
        raise TimeoutError

    with serve_metrics(address) as observe:
        observe(source)
        with pytest.raises(OSError):  # noqa: PT011 (closed, in one way or another)
            scrape(address)


def test_an_idle_client_does_not_delay_the_end() -> None:
    address = free_address()
    host, port = address.split(":")
    with serve_metrics(address), socket.create_connection((host, int(port))) as open_end:
        open_end.sendall(b"GET /metrics HTTP/1.1\r\n")
        scrape(address)
        began_s = time.monotonic()
    assert time.monotonic() - began_s < 5.0


def test_it_listens_nowhere_else() -> None:
    address = free_address()
    with serve_metrics(address), pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", int(address.split(":")[1])))


@pytest.mark.parametrize("host", ["127.0.0.1", "192.0.2.1"])
def test_unusable_addresses_are_refused(host: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"{host}:{taken.getsockname()[1]}"
        with pytest.raises(BadInputError, match=r"observation.metrics: got .*a free port"):
            serve_metrics(address).__enter__()
