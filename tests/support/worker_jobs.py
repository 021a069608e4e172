"""What workers are given to do in tests; apart, so that their processes load little."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from laneweave.protocol.runtime.node import Clock


def process_id(_left_s: float, _clock: Clock) -> int:
    return os.getpid()


def left(left_s: float, _clock: Clock) -> float:
    return left_s


def sleep(seconds: float, _left_s: float, _clock: Clock) -> float:
    time.sleep(seconds)
    return seconds


def niceness(_left_s: float, _clock: Clock) -> int:
    return os.nice(0)


def fail(_left_s: float, _clock: Clock) -> None:
    raise ValueError("no such thing")


def note(file: Path, *_: object) -> int:
    """Note that this process has begun; returns how many have."""
    with file.open("a", encoding="utf-8") as lines:
        lines.write(f"{os.getpid()}\n")
    return len(noted(file))


def noted(file: Path) -> list[int]:
    """Return which processes have begun."""
    return [int(line) for line in file.read_text().splitlines()] if file.exists() else []


def die(file: Path, _left_s: float, _clock: Clock) -> None:
    """Note it, and be killed."""
    note(file)
    os.kill(os.getpid(), signal.SIGKILL)


def hang_at_first(file: Path, _left_s: float, _clock: Clock) -> int:
    """Go on for ever when nobody has begun before; returns the process's id."""
    if note(file) == 1:
        time.sleep(1000.0)
    return os.getpid()


def meet(file: Path, _left_s: float, _clock: Clock) -> int:
    """Wait until two have begun; returns the process's id."""
    note(file)
    while len(noted(file)) < 2:
        time.sleep(0.01)
    return os.getpid()


def read_clock(file: Path, _left_s: float, clock: Clock) -> None:
    """Read the clock for ever."""
    note(file)
    while True:
        clock()


def lock(_left_s: float, _clock: Clock) -> Any:  # noqa: ANN401 (whatever cannot be pickled)
    return threading.Lock()


class Shy:
    """Can be pickled, and not be unpickled."""

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        """Return what fails when it is made again."""
        return int, ("not a number",)

    def __call__(self, _left_s: float, _clock: Clock) -> None:
        """Do nothing."""


def shy(_left_s: float, _clock: Clock) -> Shy:
    return Shy()
