"""Process signals: how a process is asked to stop, and termination with the parent process.

`STOP_SIGNALS` ask a process to end in good order: Ctrl-C, `kill`, `timeout`, systemd, schedulers,
and a terminal that is closed. They may be sent to all processes of a run at once, and more than
once. A launcher must end its roles in a certain order, so its roles ignore these signals, and the
launcher ends them with `ROLE_STOP` (docs/adr/0044).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask a process to end in good order."""
ROLE_STOP = signal.SIGUSR1
"""Signal with which a launcher ends its roles."""
REPEAT_S = 1.0
"""Time for which further stop signals count as repetitions: `timeout` sends SIGTERM to a process,
and then to its whole group, and a shell passes on a SIGHUP that the terminal sends, too."""
RAISE_AGAIN_S = 0.01
"""Delay before a KeyboardInterrupt that Python has discarded is raised again."""
_PR_SET_PDEATHSIG = 1
_TERMINAL_LOST = 5
"""`errno.EIO`, which `termios` raises for a terminal that was closed."""


class _StopState:
    """The stop signals of this process."""

    last_s = -float("inf")
    """Time of the last one."""
    last: signal.Signals | int = signal.SIGINT
    """The last one."""
    deferred = 0
    """Number of blocks of `interrupts_deferred` that are open."""
    pending = False
    """Whether one arrived in such a block."""


def die_with_parent(
    parent: int | None = None, number: signal.Signals | int = signal.SIGTERM
) -> None:
    """Have the kernel send a signal to this process when its parent dies.

    Args:
        parent: process ID of the parent, which may already have died; None: the current parent.
        number: the signal.
    """
    parent = parent or os.getppid()
    _set_death_signal(number)
    if os.getppid() != parent:
        sys.exit(1)


def outlive_parent() -> None:
    """Undo `die_with_parent`."""
    _set_death_signal(0)


def _set_death_signal(number: int) -> None:
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)


@contextlib.contextmanager
def stop_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on `STOP_SIGNALS` and `ROLE_STOP` until the block ends.

    Outside the main thread, signals are left to the main thread, which receives all of them.
    `stop` must neither take a lock nor log, since the interrupted code may hold the same lock.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(number: int, _frame: object) -> None:
        _on_stop_signal(number)
        stop()

    before = {number: signal.signal(number, on_signal) for number in accepted_stop_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def accepted_stop_signals() -> list[signal.Signals]:
    """Return `STOP_SIGNALS` and `ROLE_STOP` without those that this process ignores.

    Ignored signals stay ignored: a launcher handles them for all its roles, and `nohup` makes its
    command ignore SIGHUP.
    """
    numbers = (*STOP_SIGNALS, ROLE_STOP)
    return [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]


def raise_interrupts(*numbers: signal.Signals) -> None:
    """Raise KeyboardInterrupt in the main thread on signals that this process does not ignore.

    Python discards exceptions in finalizers and in callbacks of weak references, which it may run
    at any moment; an interrupt there is raised again shortly afterwards (using SIGALRM).
    """
    for number in numbers:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)
    signal.signal(signal.SIGALRM, _repeat_discarded)
    sys.unraisablehook = _on_discarded


def stop_signal_received() -> bool:
    """Return whether a stop signal has arrived since this process started."""
    return _StopState.last_s > -float("inf")


@contextlib.contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Raise the KeyboardInterrupt of `raise_interrupts` only at the end of the block."""
    _StopState.deferred += 1
    try:
        yield
    finally:
        _StopState.deferred -= 1
    if _StopState.pending and not _StopState.deferred:
        _StopState.pending = False
        raise KeyboardInterrupt


def _interrupt(number: int, _frame: object) -> None:
    repeated = time.monotonic() - _StopState.last_s < REPEAT_S
    _on_stop_signal(number)
    if repeated:
        return  # it would interrupt the handling of the first one
    if _StopState.deferred:
        _StopState.pending = True
    else:
        raise KeyboardInterrupt


def _on_discarded(discarded: sys.UnraisableHookArgs) -> None:
    if issubclass(discarded.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, RAISE_AGAIN_S)
    else:
        sys.__unraisablehook__(discarded)


def _repeat_discarded(_number: int, _frame: object) -> None:
    _StopState.last_s = -float("inf")
    signal.raise_signal(_StopState.last)


def _on_stop_signal(number: int) -> None:
    _StopState.last_s, _StopState.last = time.monotonic(), number
    if number == signal.SIGHUP:
        _release_lost_terminal()


def _release_lost_terminal() -> None:
    """Discard further output to a terminal that was closed; writing to it would raise errors."""
    for descriptor in (1, 2):
        try:
            termios.tcgetattr(descriptor)
        except termios.error as error:
            if error.args[0] == _TERMINAL_LOST:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
