"""Incarnations: numbers that tell one process, or one claim of a process, from all others.

A number is a time in ns whose low bits are the process's own: numbers grow from process to process
as time does, and two processes that live at the same time on one machine never have the same one,
also where one has to step above a number that is ahead of its clock.
"""

from __future__ import annotations

import os
import time

_OWN_BITS = 22
"""As many as a process id of Linux has; a step of the rest is 4 ms."""
_STEP = 1 << _OWN_BITS


class Incarnations:
    """The numbers of this process, each greater than the one before."""

    def __init__(self) -> None:
        """Begin above nothing."""
        self._last = 0

    def __call__(self) -> int:
        """Return a number that no process has used before."""
        number = time.time_ns() // _STEP * _STEP + os.getpid() % _STEP
        self._last = number = above(number, self._last)
        return number


def above(number: int, floor: int) -> int:
    """Return the number, or where that is not above `floor` the next one of the same process."""
    if number > floor:
        return number
    return number + -(-(floor + 1 - number) // _STEP) * _STEP
