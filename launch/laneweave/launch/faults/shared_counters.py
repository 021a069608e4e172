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

WORD = 8


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
        path.write_bytes(bytes(WORD))

    def new_word(self) -> int:
        """Create a counter for a process, and return its index."""
        with self.path.open("ab") as file:
            index = file.tell() // WORD
            file.write(bytes(WORD))
        return index

    @property
    def road_s(self) -> float:
        """Road time."""
        found: float = struct.unpack("=d", self.path.read_bytes()[:WORD])[0]
        return found

    @property
    def dropped(self) -> int:
        """Number of messages dropped by faults in all current and past processes."""
        content = self.path.read_bytes()[WORD:]
        return sum(struct.unpack(f"={len(content) // WORD}Q", content))


@define
class BoardWord:
    """`FaultBoard` of a role process: its counter in the shared file."""

    path: Path
    index: int
    """Index of this process's counter."""
    _memory: mmap.mmap = field(init=False)
    _times: memoryview[float] = field(init=False)
    _counters: memoryview[int] = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Map the file until the process ends."""
        with self.path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 0)
        whole = memoryview(self._memory)
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
    word: int
    """Index of this process's counter."""
    receiver: str
    seed: str

    def wrap(self, core: Core) -> Core:
        """Return a core that applies these message faults to `core`."""
        board = BoardWord(self.board, self.word)
        return FaultyCore(core, self.rules, board, receiver=self.receiver, seed=self.seed)
