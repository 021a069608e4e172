"""Links between network namespaces that lose and delay packets."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from laneweave.launch.faults.network_namespaces import (
    HUB,
    HUB_ADDRESS,
    GroupNetwork,
    Link,
    NamespacesUnavailableError,
)
from laneweave.launch.run.roles import fork_server
from support.harness import (
    DEMAND,
    END_S,
    SHORT_ROAD,
    Lab,
    check_safe_and_complete,
    final_lanes,
    interrupt,
    summary,
    trips,
)

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
DELAY_S = 0.05
TRIPS = 5
ECHO = f"""
import socket, threading
def over_udp():
    while True:
        packet, sender = inbox.recvfrom(100)
        inbox.sendto(packet, sender)
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inbox:
    inbox.bind(("{HUB_ADDRESS}", {PORT}))
    threading.Thread(target=over_udp, daemon=True).start()
    with socket.create_server(("0.0.0.0", {PORT})) as server:
        print("ready", flush=True)
        while True:
            with server.accept()[0] as connection:
                while byte := connection.recv(1):
                    connection.send(byte)
"""
ASKER = f"""
import socket, time
kind = socket.SOCK_STREAM if "%s" == "tcp" else socket.SOCK_DGRAM
with socket.socket(socket.AF_INET, kind) as outbox:
    outbox.settimeout(20)
    outbox.connect(("{HUB_ADDRESS}", {PORT}))
    for _ in range({TRIPS}):
        began_s = time.monotonic()
        outbox.send(b"?")
        outbox.recv(1)
        print(time.monotonic() - began_s)
"""


@pytest.fixture
def network() -> Iterator[GroupNetwork]:
    network = GroupNetwork(fork_server(), ("one", "other"), delayed=("other",))
    try:
        network.open()
        network.set_links({"one": Link(loss=0.5)})
    except NamespacesUnavailableError as error:
        network.close()
        pytest.skip(f"there can be no links that lose and delay packets here: {error}")
    yield network
    network.close()


def start(network: GroupNetwork, name: str, text: str) -> subprocess.Popen[str]:
    """Start a Python program in a namespace."""
    where = f"--net=/proc/{network.process_id(name)}/ns/net"
    words = ["nsenter", where, "--", sys.executable, "-c", text]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


def lost(network: GroupNetwork, group: str) -> set[int]:
    """Send numbered packets from a group to the hub, and return the numbers of the lost ones."""
    receiver = start(network, HUB, RECEIVER)
    try:
        assert receiver.stdout is not None
        assert receiver.stdout.readline() == "ready\n"
        sender = start(network, group, SENDER)
        sender.communicate(timeout=30)
        came, _ = receiver.communicate(timeout=30)
    finally:
        receiver.kill()
    return set(range(PACKETS)) - {int(line) for line in came.split()}


def round_trips_s(network: GroupNetwork, group: str, protocol: str) -> list[float]:
    """Return the times of round trips between a group and the hub."""
    echo = start(network, HUB, ECHO)
    try:
        assert echo.stdout is not None
        assert echo.stdout.readline() == "ready\n"
        came, _ = start(network, group, ASKER % protocol).communicate(timeout=30)
    finally:
        echo.kill()
        echo.communicate(timeout=30)
    return [float(line) for line in came.split()]


def test_a_link_loses_a_share_of_its_packets(network: GroupNetwork) -> None:
    network.set_links({"one": Link(loss=0.1)})
    missing = lost(network, "one")
    assert 0.06 < len(missing) / PACKETS < 0.14
    assert lost(network, "other") == set()
    network.set_links({"one": Link(loss=1.0)})
    network.set_links({})
    assert lost(network, "one") == set()


@pytest.mark.more
def test_a_link_loses_successive_packets(network: GroupNetwork) -> None:
    network.set_links({"one": Link(loss=0.05, burst=20)})
    missing = lost(network, "one")
    assert 0.03 < len(missing) / PACKETS < 0.07
    begins = [number for number in missing if number - 1 not in missing]
    assert len(begins) <= len(missing) / 20 + 1


@pytest.mark.parametrize("protocol", ["udp", "tcp"])
@pytest.mark.more
def test_a_link_delays_packets_in_both_directions(network: GroupNetwork, protocol: str) -> None:
    network.set_links({"other": Link(delay_s=DELAY_S)})
    delayed = round_trips_s(network, "other", protocol)
    assert len(delayed) == TRIPS
    assert min(delayed) >= 2 * DELAY_S
    network.set_links({})
    assert min(round_trips_s(network, "other", protocol)) < DELAY_S
    assert min(round_trips_s(network, "one", protocol)) < DELAY_S


@pytest.mark.more
def test_a_link_delays_and_loses_packets_and_is_cut(network: GroupNetwork) -> None:
    network.set_links({"other": Link(delay_s=0.01, loss=0.1)})
    assert 0.06 < len(lost(network, "other")) / PACKETS < 0.14
    network.set_links({"other": Link(up=False)})
    network.set_links({})
    assert lost(network, "other") == set()


@pytest.fixture
def delays(lab: Lab) -> tuple[object, ...]:
    """Arguments of a run in which every link delays packets by 20 ms."""
    short = lab.path("short.toml", SHORT_ROAD)
    faults = lab.path("faults.toml", "[[link]]\ndelay_s = 0.02\n")
    out = ("--out", lab.folder / "out", "--vehicles-per-process", "8")
    return ("run", short, *DEMAND, "--faults", faults, *out)


@pytest.mark.more
def test_a_run_over_links_with_delays(lab: Lab, delays: tuple[object, ...]) -> None:
    ended = lab.run(*delays)
    if "link[0]: " in ended.err:
        pytest.skip(f"there can be no links that delay packets here: {ended.err}")
    assert ended.status == 0, ended
    folder: Path = lab.folder / "out"
    check_safe_and_complete(folder)
    # A tick and its answer cross the links of the bridge and of the vehicles.
    assert summary(folder)["runtime"]["tick_ms"]["p50"] >= 4 * 20.0
    wanted = {name: trip["preferred_lane"] for name, trip in trips(folder).items()}
    assert final_lanes(folder) == wanted
    lab.check_nothing_left()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
@pytest.mark.more
def test_relays_end_with_their_run(
    lab: Lab, delays: tuple[object, ...], number: signal.Signals
) -> None:
    process = lab.start(*delays)

    def relays() -> bool:
        if process.poll() is not None:
            _, error = process.communicate()
            pytest.skip(f"there can be no links that delay packets here: {error}")
        return sum(_name(one).startswith("agent-") for one in lab.processes()) > 0

    lab.wait_until(relays)
    interrupt(process, number)
    lab.wait_until(lambda: not lab.processes(), END_S)


def _name(process: psutil.Process) -> str:
    try:
        return process.name()
    except psutil.Error:
        return ""
