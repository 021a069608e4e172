"""Starting roles: what happens when no process can be made."""

from __future__ import annotations

import os
import signal
from multiprocessing import forkserver
from typing import NoReturn

import pytest

from laneweave.launch.run.roles import LAUNCHER, PRELOADED, THREAD_LIMITS, fork_server, start_role
from laneweave.protocol.errors import CommandFailedError
from support.commands import python


class _DeadServer:
    """A fork server that dies while it is asked for a process."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    def Process(self, *, name: str, **_: object) -> _DeadServer:  # noqa: N802 (the context's name)
        self.name = name
        return self

    def start(self) -> NoReturn:
        raise self._error


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (EOFError(), "the fork server has ended"),
        (ConnectionRefusedError(111, "Connection refused"), "Connection refused"),
    ],
)
def test_a_dead_fork_server_is_a_failure_with_words(error: Exception, reason: str) -> None:
    with pytest.raises(CommandFailedError, match=rf"cannot start agent-v1: .*{reason}"):
        start_role(_DeadServer(error), "agent", "agent-v1", {}, {})  # type: ignore[arg-type]


def test_ctrl_c_while_the_fork_server_starts_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forkserver, "ensure_running", lambda: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        fork_server()
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


LOOK_AROUND = """
import gc, importlib, os, sys
before = len(os.listdir("/proc/self/fd"))
importlib.import_module(sys.argv[1])
print(len(os.listdir("/proc/self/task")))
print(len(os.listdir("/proc/self/fd")) - before)
print(gc.get_count()[2], gc.get_freeze_count() > len(gc.get_objects()))
"""


@pytest.mark.slow
def test_the_fork_server_has_one_thread_and_nothing_open_and_leaves_nothing_to_collect() -> None:
    set_by_launcher = dict.fromkeys(THREAD_LIMITS, "1") | {LAUNCHER: str(os.getpid())}
    done = python(LOOK_AROUND, PRELOADED, env=os.environ | set_by_launcher)
    assert done.stdout.split() == ["1", "0", "0", "True"], done.stderr
