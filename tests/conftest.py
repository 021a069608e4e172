"""For all tests: what they start can be interrupted, and in which order they run."""

from __future__ import annotations

import signal

import pytest

FIRST = ("tests/system/", "tests/simulation/")
"""Long ones. Who runs tests in parallel ends with short ones, so that nobody waits for the last."""
SHORT = "tests/system/test_bad_input.py"


def pytest_configure() -> None:
    """Heed SIGINT: a shell's background jobs ignore it, and their children inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let those who wait for processes begin, while another worker computes."""
    items.sort(key=_turn)


def _turn(item: pytest.Item) -> int:
    if item.nodeid.startswith(SHORT):
        return len(FIRST)
    found = (turn for turn, folder in enumerate(FIRST) if item.nodeid.startswith(folder))
    return next(found, len(FIRST) + 1)
