"""The deployment of compose.yaml on three hosts and a hub, which are network namespaces.

More of it, and longer: `benchmarks/hosts.py`, whose results are in docs/FAULTS.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from laneweave.launch.faults.network_namespaces import Link, NamespacesUnavailableError
from support.harness import Lab, check_safe_and_complete, events, summary
from support.hosts import LINKS, Hosts, lasts, open_hosts

SHORT = {"s2_m": 100.0, "s3_m": 350.0}
DEMAND = {"duration_s": 10.0}
END_S = 180.0
"""No run here takes a fourth of it; it only guards against hanging."""

MakeHosts = Callable[..., Hosts]


@pytest.fixture
def make_hosts(lab: Lab) -> Iterator[MakeHosts]:
    """Make hosts on which nothing runs yet; whatever runs on them at last is ended."""
    with ExitStack() as stack:

        def make(pace: float = 6.0, link: str = "tls") -> Hosts:
            try:
                return stack.enter_context(
                    open_hosts(
                        lab.folder,
                        pace=pace,
                        link=link,
                        environment=lab.environment,
                        road=SHORT,
                        demand=DEMAND,
                    )
                )
            except NamespacesUnavailableError as error:
                pytest.skip(f"there can be no network namespaces here: {error}")

        yield make


def finish(hosts: Hosts) -> Path:
    """Wait for the end of the run and return its folder; whoever is left ends in good order."""
    assert hosts.finish("bridge", END_S) == 0
    others = [name for name in hosts.running if name != "router"]
    assert set(hosts.stop(*others, "router").values()) == {0}
    folder = hosts.runs[-1]
    check_safe_and_complete(folder)
    return folder


@pytest.mark.more
def test_a_link_is_cut_and_the_router_killed(make_hosts: MakeHosts) -> None:
    # Slow enough that agents are back long before the first vehicle leaves the road.
    hosts = make_hosts(pace=2.0)
    hosts.start_all()
    hosts.wait_road(8.0)
    hosts.partition("vehicles", 5.0)
    hosts.wait_road(hosts.road_s + 2.0)
    hosts.kill("router")
    time.sleep(1.0)
    hosts.start("router")

    folder = finish(hosts)

    # All vehicles had agents again. Not all sorted: the road went on while the link was cut, and
    # let vehicles enter without agents.
    vehicles = summary(folder)["vehicles"]
    assert vehicles["left_unattended"] == 0
    assert vehicles["left"] == vehicles["demanded"]


@pytest.mark.more
def test_links_lose_packets(make_hosts: MakeHosts) -> None:
    hosts = make_hosts(pace=3.0, link="quic?mixed_rel=1")
    try:
        hosts.start_all(Link(loss=0.1))
    except NamespacesUnavailableError as error:
        pytest.skip(f"there can be no links that lose packets here: {error}")
    folder = finish(hosts)
    assert summary(folder)["failover"]["leader_changes"] <= 1


@pytest.mark.full
@pytest.mark.parametrize("link", LINKS)
def test_a_link_is_cut(make_hosts: MakeHosts, link: str) -> None:
    hosts = make_hosts()
    hosts.start_all()
    hosts.wait_road(8.0)
    hosts.partition(link, 8.0)
    folder = finish(hosts)
    # That a host of several processes vanishes does not keep the others from talking.
    assert link != "coordinators" or events(folder, "agent-silent") == []


@pytest.mark.full
def test_every_process_is_killed_once(make_hosts: MakeHosts) -> None:
    hosts = make_hosts(pace=2.0)
    hosts.start_all()
    hosts.wait_healthy(*(name for name in hosts.running if name != "bridge"))
    hosts.wait_road(5.0)
    for name in [name for name, service in hosts.services.items() if lasts(service)]:
        if name != "bridge":
            hosts.kill(name)
            time.sleep(1.0)
            hosts.start(name)
            hosts.wait_healthy(name)
    finish(hosts)


@pytest.mark.full
def test_a_bridge_that_died_begins_anew(make_hosts: MakeHosts) -> None:
    hosts = make_hosts()
    hosts.start_all()
    hosts.wait_road(8.0)
    hosts.kill("bridge")
    hosts.start("bridge")
    finish(hosts)
    assert len(hosts.runs) == 2
