"""Cost of security: time from put to callback, and start-up time of a router.

    .venv/bin/python benchmarks/security.py

The router runs in a separate process, a vehicle and a coordinator in this one. The vehicle sends
500 states of 300 B per second, in alternating rounds over TCP, TLS without access rules and TLS
with them, so that other load on the machine affects all three alike. Then routers with rules for
10, 1000 and 5000 vehicles are started.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import attrs

from laneweave.launch.deploy.certificate_authority import issue, make_authority
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.runtime.transport import Delivery, Received
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.security.access_control import access_of, guard_of
from laneweave.protocol.security.connection import Access, RouterGuard
from laneweave.protocol.transports.zenoh.transport import ZenohTransport, run_router
from laneweave.protocol.wire.identities import parse_identity
from laneweave.protocol.wire.topics import STATE, Keys, Quality

ROUNDS, SAMPLES, PERIOD_S, PAYLOAD_BYTES = 6, 500, 0.002, 300
START_S = 120.0


def _scenario(
    folder: Path, port: int, kind: str, vehicles: int = 10, options: str = ""
) -> Scenario:
    return parse_scenario(
        {
            "network": {"endpoint": f"{kind}/127.0.0.1:{port}{options}"},
            "security": {
                "mode": "off" if kind == "tcp" else "mtls",
                "folder": str(folder),
                "vehicles": [f"v{number:04d}" for number in range(1, vehicles + 1)],
            },
        }
    )


def _route(endpoint: str, guard: RouterGuard | None, ready: Connection) -> None:
    run_router([endpoint], 1.0, ready=lambda: ready.send(None), guard=guard)


@contextmanager
def _router(endpoint: str, guard: RouterGuard | None) -> Iterator[float]:
    """Run a router; yield its start-up time in seconds."""
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_route, args=(endpoint, guard, there))
    began = time.monotonic()
    process.start()
    if not here.poll(START_S):
        raise TimeoutError("the router did not start")
    try:
        yield time.monotonic() - began
    finally:
        process.terminate()
        process.join(10.0)


def _latencies_us(vehicle: Access, coordinator: Access) -> list[float]:
    """Return the times from put to callback of one round."""
    found: list[float] = []

    def take(delivery: Delivery) -> None:
        if isinstance(delivery, Received):
            found.append((time.perf_counter_ns() - int(delivery.payload[:20])) / 1000.0)

    key = Keys(vehicle.realm).key(STATE, formation=1, vehicle="v0001")
    reader, sender = ZenohTransport(coordinator, take), ZenohTransport(vehicle, lambda _: None)
    try:
        reader.subscribe(Keys(vehicle.realm).all_of(STATE))
        time.sleep(0.3)
        for _ in range(SAMPLES):
            payload = f"{time.perf_counter_ns():020d}".ljust(PAYLOAD_BYTES).encode()
            sender.publish(key, payload, Quality.LATEST)
            time.sleep(PERIOD_S)
        time.sleep(0.2)
    finally:
        sender.close()
        reader.close()
    return found


def _measure(folder: Path) -> dict[str, object]:
    secured, open_ = _scenario(folder, 27901, "tls"), _scenario(folder, 27902, "tcp")
    unruled = _scenario(folder, 27903, "tls")
    guard = guard_of(secured)
    assert guard is not None  # noqa: S101 (the scenario is secured)
    no_rules = attrs.evolve(guard, access_control={"enabled": False}, size_limits=[])
    variants: dict[str, tuple[Scenario, RouterGuard | None]] = {
        "tcp": (open_, None),
        "tls": (unruled, no_rules),
        "tls with rules": (secured, guard),
        "quic with rules": (_scenario(folder, 27904, "quic"), guard),
        "quic?mixed_rel=1 with rules": (
            _scenario(folder, 27905, "quic", options="?mixed_rel=1"),
            guard,
        ),
    }
    found: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(ROUNDS):
        for name, (scenario, rules) in variants.items():
            with _router(scenario.network.endpoint, rules):
                vehicle, leader = (
                    access_of(scenario, who, {}) for who in ("vehicle.v0001", "coordinator.c1")
                )
                found[name] += _latencies_us(vehicle, leader)
    report: dict[str, object] = {}
    for name, times in found.items():
        percent = statistics.quantiles(times, n=100)
        report[name] = {
            "samples": len(times),
            "put_to_callback_us_p50": round(percent[49]),
            "put_to_callback_us_p99": round(percent[98]),
            "lost": ROUNDS * SAMPLES - len(times),
        }
    return report


def _starts(folder: Path) -> dict[str, object]:
    report: dict[str, object] = {}
    for vehicles in (10, 1000, 5000):
        scenario = _scenario(folder, 27910, "tls", vehicles)
        began = time.monotonic()
        guard = guard_of(scenario)
        made_s = time.monotonic() - began
        with _router(scenario.network.endpoint, guard) as start_s:
            access = access_of(scenario, "coordinator.c1", {})
            began = time.monotonic()
            ZenohTransport(access, lambda _: None).close()
            report[f"{vehicles} vehicles"] = {
                "rules_made_s": round(made_s, 2),
                "router_started_s": round(start_s, 2),
                "session_ms": round(1000 * (time.monotonic() - began), 1),
            }
    return report


def main() -> None:
    """Measure, and print JSON."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        authority = make_authority(folder)
        for name in ("router", "vehicle.v0001", "coordinator.c1"):
            issue(authority, folder, parse_identity(name), days=30.0)
        report = {"latency": _measure(folder), "start": _starts(folder)}
    sys.stdout.write(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
