"""Links between network namespaces that lose packets."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest

from laneweave.launch.faults.network_namespaces import (
    HUB,
    HUB_ADDRESS,
    GroupNetwork,
    Link,
    NamespacesUnavailableError,
)
from laneweave.launch.run.roles import fork_server

PACKETS = 2000
PORT = 7000
RECEIVER = f"""
import socket
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inbox:
    inbox.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    inbox.bind(("0.0.0.0", {PORT}))
    print("ready", flush=True)
    while True:
        number = int(inbox.recv(100))
        if number < 0:
            break
        print(number)
"""
SENDER = f"""
import socket, time
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outbox:
    for number in range({PACKETS}):
        outbox.sendto(b"%d" % number, ("{HUB_ADDRESS}", {PORT}))
        if number % 100 == 0:
            time.sleep(0.001)
    for _ in range(200):
        outbox.sendto(b"-1", ("{HUB_ADDRESS}", {PORT}))
"""


@pytest.fixture
def network() -> Iterator[GroupNetwork]:
    network = GroupNetwork(fork_server(), ("one", "other"))
    try:
        network.open()
        network.set_links({"one": Link(loss=0.5)})
    except NamespacesUnavailableError as error:
        network.close()
        pytest.skip(f"there can be no links that lose packets here: {error}")
    yield network
    network.close()


def lost(network: GroupNetwork, group: str) -> set[int]:
    """Send numbered packets from a group to the hub, and return the numbers of the lost ones."""

    def start(name: str, text: str) -> subprocess.Popen[str]:
        where = f"--net=/proc/{network.process_id(name)}/ns/net"
        words = ["nsenter", where, "--", sys.executable, "-c", text]
        return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)

    receiver = start(HUB, RECEIVER)
    try:
        assert receiver.stdout is not None
        assert receiver.stdout.readline() == "ready\n"
        sender = start(group, SENDER)
        sender.communicate(timeout=30)
        came, _ = receiver.communicate(timeout=30)
    finally:
        receiver.kill()
    return set(range(PACKETS)) - {int(line) for line in came.split()}


def test_a_link_loses_a_share_of_its_packets(network: GroupNetwork) -> None:
    network.set_links({"one": Link(loss=0.1)})
    missing = lost(network, "one")
    assert 0.06 < len(missing) / PACKETS < 0.14
    assert lost(network, "other") == set()
    network.set_links({"one": Link(loss=1.0)})
    network.set_links({})
    assert lost(network, "one") == set()


def test_a_link_loses_successive_packets(network: GroupNetwork) -> None:
    network.set_links({"one": Link(loss=0.05, burst=20)})
    missing = lost(network, "one")
    assert 0.03 < len(missing) / PACKETS < 0.07
    begins = [number for number in missing if number - 1 not in missing]
    assert len(begins) <= len(missing) / 20 + 1
