"""What the processes of a run with faults share without messages: a small file that all map.

It holds the road time, which says which faults are in force, and for each process how many messages
it has lost to faults. Messages could not tell this: they are what gets lost. The file is a row of
8-byte words in the machine's own order: road time as a float64, then one counter for each process.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from attrs import define, field

WORD = 8


@define
class LocalBoard:
    """The board of a run within one process; a `FaultBoard`."""

    road_s: float = 0.0
    dropped: int = 0


class SharedBoard:
    """The supervisor's side of the file: gives each process a word, and reads them all."""

    def __init__(self, path: Path) -> None:
        """Make the file; the road time is 0."""
        self.path = path
        path.write_bytes(bytes(WORD))

    def new_word(self) -> int:
        """Return the index of a word that is nobody's yet, for one process."""
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
        """Messages that faults took from all processes, also from those that have ended."""
        content = self.path.read_bytes()[WORD:]
        return sum(struct.unpack(f"={len(content) // WORD}Q", content))


@define
class BoardWord:
    """One process's side of the file; a `FaultBoard`."""

    path: Path
    index: int
    """Of this process's word."""
    _memory: mmap.mmap = field(init=False)
    _times: memoryview[float] = field(init=False)
    _counters: memoryview[int] = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Map the file; the mapping ends with the process."""
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
        """Messages that faults took from this process."""
        return self._counters[self.index]

    @dropped.setter
    def dropped(self, value: int) -> None:
        self._counters[self.index] = value
