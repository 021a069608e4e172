"""The last minutes of a live road: frames in a ring, bounded in number and in size."""

from __future__ import annotations

from collections import deque
from typing import Any

from attrs import define, field

MOST_FRAMES = 3000
"""Five minutes at ten frames a second."""
MOST_CHARACTERS = 48_000_000


@define
class Ring:
    """Frames as text, the oldest forgotten first; a `Film`."""

    scene: dict[str, Any]
    most_frames: int = MOST_FRAMES
    most_characters: int = MOST_CHARACTERS
    next: int = 0
    """Number of the next frame."""
    _frames: deque[str] = field(factory=deque)
    _characters: int = 0

    def append(self, frame: str) -> None:
        """Add the frame with the number `next`."""
        self._frames.append(frame)
        self._characters += len(frame)
        self.next += 1
        while len(self._frames) > self.most_frames or (
            self._characters > self.most_characters and len(self._frames) > 1
        ):
            self._characters -= len(self._frames.popleft())

    @property
    def first(self) -> int:
        """Number of the oldest frame."""
        return self.next - len(self._frames)

    @property
    def last(self) -> int:
        """Number of the newest frame."""
        return self.next - 1

    def frames(self, begin: int, end: int) -> list[str]:
        """Return the frames from `begin` to `end`, as far as they are there."""
        first = self.first
        return [
            self._frames[number - first]
            for number in range(max(begin, first), min(end, self.last) + 1)
        ]
