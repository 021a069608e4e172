"""The commands, in this process."""

from __future__ import annotations

import pytest

from laneweave.launch.run import logs
from support.commands import Here


@pytest.fixture
def laneweave(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Here:
    """Runs commands; logs are not bound to a stream that ends with the test."""
    monkeypatch.setattr(logs, "log_to_terminal", lambda *_: None)
    return Here(capsys)
