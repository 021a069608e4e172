"""The fault board: road time and counters of dropped messages, shared by the processes of a run.

The board cannot use messages, because faults drop them. Real processes map a shared file: road time
as a float64, then one 8-byte counter per process, in native byte order.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from attrs import define, field, frozen

from laneweave.protocol.runtime.message_faults import FaultyCore, MessageRule
from laneweave.protocol.runtime.node import Core

VALUE_BYTES = 8


@define
class LocalBoard:
    """`FaultBoard` of a run in one process."""

    road_s: float = 0.0
    dropped: int = 0


class SharedBoard:
    """The shared file as seen by the launcher, which assigns and reads all counters."""

    def __init__(self, path: Path) -> None:
        """Create the file with road time 0."""
        self.path = path
        path.write_bytes(bytes(VALUE_BYTES))

    def new_counter(self) -> int:
        """Create a counter for a process, and return its index."""
        with self.path.open("ab") as file:
            index = file.tell() // VALUE_BYTES
            file.write(bytes(VALUE_BYTES))
        return index

    @property
    def road_s(self) -> float:
        """Road time."""
        found: float = struct.unpack("=d", self.path.read_bytes()[:VALUE_BYTES])[0]
        return found

    @property
    def dropped(self) -> int:
        """Number of messages dropped by faults in all current and past processes."""
        content = self.path.read_bytes()[VALUE_BYTES:]
        return sum(struct.unpack(f"={len(content) // VALUE_BYTES}Q", content))


@define
class ProcessBoard:
    """`FaultBoard` of a role process, mapped to the shared file."""

    path: Path
    index: int
    """Index of this process's counter."""
    _times: memoryview[float] = field(init=False)
    _counters: memoryview[int] = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Map the file until the process ends."""
        with self.path.open("r+b") as file:
            whole = memoryview(mmap.mmap(file.fileno(), 0))
        self._times, self._counters = whole.cast("d"), whole.cast("Q")

    @property
    def road_s(self) -> float:
        """Road time."""
        return self._times[0]

    @road_s.setter
    def road_s(self, value: float) -> None:
        self._times[0] = value

    @property
    def dropped(self) -> int:
        """Number of messages dropped by faults in this process."""
        return self._counters[self.index]

    @dropped.setter
    def dropped(self, value: int) -> None:
        self._counters[self.index] = value


@frozen
class MessageFaults:
    """Message faults of a role process, passed to it as an option."""

    rules: tuple[MessageRule, ...]
    board: Path
    """File of the run's `SharedBoard`."""
    counter: int
    """Index of this process's counter."""
    receiver: str
    """Kind of the process."""
    names: tuple[str, ...]
    """Name of the process, or of each vehicle that it drives."""
    seed: str

    def wrap(self, core: Core) -> Core:
        """Return a core that applies these message faults to `core`."""
        board = ProcessBoard(self.board, self.counter)
        return FaultyCore(
            core, self.rules, board, receiver=self.receiver, seed=self.seed, names=self.names
        )
