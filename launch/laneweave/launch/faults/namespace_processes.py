"""What runs in the processes that hold the network namespaces of a run."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
from multiprocessing.connection import Connection
from pathlib import Path

ANSWER_S = 10.0
"""Maximum time to create a namespace or to run a command in it."""
_CLONE_NEWNET = 0x40000000


def join_namespace(process_id: int) -> None:
    """Move this process, which must be single-threaded, into the namespace of another process.

    Raises:
        OSError: permission is missing, or the other process does not exist.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with Path(f"/proc/{process_id}/ns/net").open("rb") as namespace:
        _check(libc.setns(namespace.fileno(), _CLONE_NEWNET))


def hold_namespace(connection: Connection) -> None:
    """Create a network namespace, and run commands in it until the connection is closed.

    Receives each command as a list of words. Sends an error text (empty on success) after creating
    the namespace and after each command.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _check(ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNET))
    except OSError as error:
        connection.send(f"cannot create a network namespace: {error.strerror}")
        return
    connection.send("")
    while True:
        try:
            words = connection.recv()
        except EOFError:
            return
        connection.send(_run(words))


def _check(status: int) -> None:
    if status != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _run(words: list[str]) -> str:
    try:
        done = subprocess.run(  # noqa: S603 (the words come from this module)
            words, capture_output=True, text=True, timeout=ANSWER_S / 2, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    return "" if done.returncode == 0 else f"{' '.join(words)}: {done.stderr.strip()}"
