"""The fault board: road time and message loss counters that the processes of a run share.

Messages could not carry this, because faults drop them. The board of real processes is a file that
all of them map: road time as a float64, then one 8-byte counter per process, in native byte order.
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
    """Board of a run in one process; a `FaultBoard`."""

    road_s: float = 0.0
    dropped: int = 0


class SharedBoard:
    """The launcher's side of the shared file: assigns counters to processes and reads them all."""

    def __init__(self, path: Path) -> None:
        """Create the file with road time 0."""
        self.path = path
        path.write_bytes(bytes(WORD))

    def new_word(self) -> int:
        """Return the index of a new counter, for one process."""
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
        """Number of messages dropped by faults in all processes, including those that ended."""
        content = self.path.read_bytes()[WORD:]
        return sum(struct.unpack(f"={len(content) // WORD}Q", content))


@define
class BoardWord:
    """One role process's side of the shared file; a `FaultBoard`."""

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
    """Message faults of one role process; passed to it as an option."""

    rules: tuple[MessageRule, ...]
    board: Path
    """File of the run's `SharedBoard`."""
    word: int
    """Index of this process's counter."""
    receiver: str
    seed: str

    def wrap(self, core: Core) -> Core:
        """Return the core behind message faults."""
        board = BoardWord(self.board, self.word)
        return FaultyCore(core, self.rules, board, receiver=self.receiver, seed=self.seed)
