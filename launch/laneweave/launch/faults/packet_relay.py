"""Links that delay packets: a process that passes packets between two network namespaces.

The kernel of many machines cannot delay packets (`netem` is an optional module). Here a process
holds a network device (TUN) in either namespace, and writes to one what it reads from the other,
after a delay. It treats IP packets of all protocols alike, and nothing else changes: addresses,
routes, packet filters, and endpoints are those of a link without delay. Without jitter packets keep
their order.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import itertools
import os
import random
import selectors
import signal
import struct
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection

from attrs import define, field

from laneweave.launch.faults.namespace_processes import join_namespace

MAX_WAITING = 10_000
"""Maximum number of packets that wait in each direction; further ones are lost."""
MAX_PACKET_BYTES = 65_536
_AT_ONCE = 64
"""Maximum number of packets read from a device before the other one gets its turn."""
_DEVICES = "/dev/net/tun"
_TUNSETIFF = 0x400454CA
_IFF_TUN_WITHOUT_HEADER = 0x0001 | 0x1000


@define
class DelayQueue:
    """Packets that wait until their delay is over."""

    random: random.Random
    delay_s: float = 0.0
    jitter_s: float = 0.0
    """Maximum of an additional, uniformly distributed delay of each packet; reorders packets."""
    limit: int = MAX_WAITING
    _waiting: list[tuple[float, int, bytes]] = field(factory=list)
    _numbers: Iterator[int] = field(factory=itertools.count)

    def add(self, packet: bytes, now_s: float) -> bool:
        """Add a packet; return False if it is lost because too many wait."""
        if len(self._waiting) >= self.limit:
            return False
        due_s = now_s + self.delay_s + self.jitter_s * self.random.random()
        # The number keeps the order of packets that are due at the same time.
        heapq.heappush(self._waiting, (due_s, next(self._numbers), packet))
        return True

    @property
    def next_s(self) -> float | None:
        """Time at which the next packet is due; None if none waits."""
        return self._waiting[0][0] if self._waiting else None

    def due(self, now_s: float) -> Iterator[bytes]:
        """Remove and yield the packets that are due."""
        while self._waiting and self._waiting[0][0] <= now_s:
            yield heapq.heappop(self._waiting)[2]


def relay_packets(
    connection: Connection, ends: tuple[tuple[int, str], tuple[int, str]], seed: str
) -> None:
    """Create a device in each of two namespaces and pass packets until the connection is closed.

    Args:
        connection: receives (delay, jitter) [s] of both directions. An error text (empty on
            success) is sent after creating the devices, and after each change.
        ends: for both ends, the id of a process in the namespace and the name of the device.
        seed: of the jitter.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        devices = [_open_device(process_id, name) for process_id, name in ends]
    except OSError as error:
        connection.send(f"cannot create a TUN device: {error.strerror}")
        return
    connection.send("")
    _Relay(connection, devices[0], devices[1], seed).run()


def _open_device(process_id: int, name: str) -> int:
    """Create a TUN device in the namespace of a process and return its file descriptor."""
    join_namespace(process_id)
    device = os.open(_DEVICES, os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN_WITHOUT_HEADER))
    return device


class _Relay:
    """The loop of a relay."""

    def __init__(self, connection: Connection, one: int, other: int, seed: str) -> None:
        self._connection = connection
        self._directions = {
            one: (other, DelayQueue(random.Random(f"{seed}/0"))),  # noqa: S311 (reproducible)
            other: (one, DelayQueue(random.Random(f"{seed}/1"))),  # noqa: S311 (reproducible)
        }

    def run(self) -> None:
        """Pass packets until the connection is closed."""
        with selectors.DefaultSelector() as selector:
            for readable in (self._connection.fileno(), *self._directions):
                selector.register(readable, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select(self._wait_s()):
                    if key.fd not in self._directions:
                        if not self._change():
                            return
                    else:
                        self._read(key.fd)
                self._write()

    def _wait_s(self) -> float | None:
        due_s = [queue.next_s for _, queue in self._directions.values() if queue.next_s is not None]
        return max(0.0, min(due_s) - time.monotonic()) if due_s else None

    def _change(self) -> bool:
        """Change the delays as requested; return False if the connection is closed."""
        try:
            delay_s, jitter_s = self._connection.recv()
            for _, queue in self._directions.values():
                queue.delay_s, queue.jitter_s = delay_s, jitter_s
            self._connection.send("")
        except (EOFError, OSError):
            return False
        return True

    def _read(self, device: int) -> None:
        _, queue = self._directions[device]
        # A device that is down can neither be read nor written.
        with contextlib.suppress(OSError):
            for _ in range(_AT_ONCE):
                queue.add(os.read(device, MAX_PACKET_BYTES), time.monotonic())

    def _write(self) -> None:
        now_s = time.monotonic()
        for device, queue in self._directions.values():
            for packet in queue.due(now_s):
                with contextlib.suppress(OSError):
                    os.write(device, packet)
