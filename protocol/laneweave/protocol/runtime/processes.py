"""Process signals: termination with the parent process, SIGINT and SIGTERM."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

_PR_SET_PDEATHSIG = 1


def die_with_parent(parent: int | None = None) -> None:
    """Have the kernel send SIGTERM to this process when its parent dies.

    Args:
        parent: process ID of the parent, which may already have died; None: the current parent.
    """
    parent = parent or os.getppid()
    _set_death_signal(signal.SIGTERM)
    if os.getppid() != parent:
        sys.exit(1)


def outlive_parent() -> None:
    """Undo `die_with_parent`."""
    _set_death_signal(0)


def _set_death_signal(number: int) -> None:
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)


@contextlib.contextmanager
def stop_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on SIGINT and SIGTERM until the block ends.

    Outside the main thread, signals are left to the main thread, which receives all of them.
    `stop` must neither take a lock nor log, since the interrupted code may hold the same lock.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(_number: int, _frame: object) -> None:
        stop()

    before = {
        number: signal.signal(number, on_signal)
        for number in (signal.SIGINT, signal.SIGTERM)
        # Ignored signals stay ignored: a supervisor handles Ctrl-C for all its processes.
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
