"""Thousands of malformed plan requests, to one coordinator and to three that share them."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import msgpack
import pytest

from laneweave.coordinator.client import PlanClient
from laneweave.coordinator.planning import PlanRequest
from laneweave.coordinator.service_format import CODES, FAILED, OVERLOADED
from laneweave.protocol.topics import SERVICE, Keys
from laneweave.protocol.transport import Answer
from laneweave.protocol.zenoh_transport import ZenohTransport
from system.harness import Lab
from system.mutations import Mutant, mutants
from system.service_lab import REALM, ServiceLab, request

IN_FLIGHT = 48
"""Below the service's limit, which stays out of this."""
ANSWER_S = 30.0
FLAT_MB = 20.0


@pytest.fixture(scope="module", params=[1, 3], ids=["one", "three"])
def service(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ServiceLab]:
    sockets = Path(tempfile.mkdtemp(prefix="lw-"))
    lab = Lab(tmp_path_factory.mktemp("service"), sockets)
    names = tuple(f"c{number}" for number in range(1, 1 + request.param))
    try:
        with ServiceLab(lab, names).running() as running:
            yield running
    finally:
        left = lab.kill_rest()
        shutil.rmtree(sockets, ignore_errors=True)
    assert not left


def verdict(mutant: Mutant, answer: Answer | None) -> str:
    """Return what a mutant was answered, which must be a plan or an error that names the field."""
    said = f"{mutant.kind} {mutant.encoding!r} {mutant.payload[:300]!r}: {answer}"
    assert answer is not None, f"not answered: {said}"
    unpack = json.loads if answer.encoding.startswith("application/json") else msgpack.unpackb
    data = unpack(answer.payload)
    if answer.ok:
        assert data["schema"] == "laneweave.plan.response/1", said
        return str(data["status"])
    assert set(data) == {"field", "message", "code"}, said
    assert data["code"] in CODES, said
    assert data["code"] not in (FAILED, OVERLOADED), said
    assert data["field"], said
    assert data["message"].isprintable(), said
    assert 10 < len(data["message"]) < 800, said
    return str(data["code"])


def ask_all(service: ServiceLab, asked: Iterator[Mutant]) -> Counter[str]:
    """Ask many at a time; returns how often what was answered."""
    key = Keys(REALM).key(SERVICE)
    verdicts: Counter[str] = Counter()
    waiting: deque[tuple[Mutant, Future[Answer | None]]] = deque()
    transport = ZenohTransport(service.access, lambda _: None)
    try:
        for mutant in asked:
            if len(waiting) == IN_FLIGHT:
                first, answer = waiting.popleft()
                verdicts[verdict(first, answer.result(ANSWER_S))] += 1
            asking = transport.ask(key, mutant.payload, ANSWER_S, mutant.encoding)
            waiting.append((mutant, asking))
        for mutant, answer in waiting:
            verdicts[verdict(mutant, answer.result(ANSWER_S))] += 1
    finally:
        transport.close()
    return verdicts


def check(service: ServiceLab, seed: int, count: int) -> None:
    begun_s = time.monotonic()
    verdicts = ask_all(service, mutants(seed, 1000))
    before_mb = {name: service.rss_mb(name) for name in service.names}
    verdicts += ask_all(service, mutants(seed + 1, count - 1000))
    after_mb = {name: service.rss_mb(name) for name in service.names}
    grown_mb = {name: round(after_mb[name] - before_mb[name], 1) for name in service.names}
    print(dict(verdicts), "grown:", grown_mb, "MB in", round(time.monotonic() - begun_s, 1), "s")  # noqa: T201
    assert verdicts.total() >= count
    assert verdicts["invalid"] > 0.7 * count
    assert verdicts["optimal"] > 0
    assert max(grown_mb.values()) < FLAT_MB
    with PlanClient(service.access) as client:
        for name in service.names:
            valid = PlanRequest.from_dict(service.for_one(name, request()))
            assert client.plan(valid).status == "optimal"


def test_malformed_requests(service: ServiceLab) -> None:
    check(service, seed=1, count=2000)


@pytest.mark.full
def test_ten_thousand_malformed_requests(service: ServiceLab) -> None:
    check(service, seed=100, count=10_000)
