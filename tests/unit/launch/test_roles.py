"""Starting roles: what happens when no process can be made."""

from __future__ import annotations

from typing import NoReturn

import pytest

from laneweave.launch.roles import start_role
from laneweave.protocol.errors import CommandFailedError


class _DeadServer:
    """A fork server that dies while it is asked for a process."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    def Process(self, **_: object) -> _DeadServer:  # noqa: N802 (the context's name)
        return self

    def start(self) -> NoReturn:
        raise self._error


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (EOFError(), "the fork server is gone"),
        (ConnectionRefusedError(111, "Connection refused"), "Connection refused"),
    ],
)
def test_a_dead_fork_server_is_a_failure_with_words(error: Exception, reason: str) -> None:
    with pytest.raises(CommandFailedError, match=rf"cannot start agent-v1: .*{reason}"):
        start_role(_DeadServer(error), "agent", "agent-v1", {}, {})  # type: ignore[arg-type]
