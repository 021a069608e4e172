"""Settings for all tests: signals, order, hypothesis, and a summary of tests without a browser."""

from __future__ import annotations

import gc
import signal

import pytest

from support.chromium import NO_BROWSER
from support.examples import register_profiles

FIRST = ("tests/system/", "tests/simulation/")
"""Folders of long tests. They run first, so that parallel workers finish at about the same time."""
SHORT = "tests/system/test_bad_input.py"
"""System tests that are short."""


register_profiles()


def pytest_configure() -> None:
    """Let child processes receive SIGINT and SIGHUP, which background jobs and nohup ignore.

    Child processes inherit that a signal is ignored, but no handlers. Garbage is not collected
    while tests are collected, which would take 15 % of that time.
    """
    gc.disable()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run tests that wait for processes first, beside tests that compute."""
    items.sort(key=_rank)


def pytest_collection_finish() -> None:
    """Exclude the collected tests from garbage collection, which would take 7 % of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)
    gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say how many tests were skipped for want of a browser, and how to install one."""
    skipped = [
        report
        for report in terminalreporter.stats.get("skipped", [])
        if NO_BROWSER in str(report.longrepr)
    ]
    if skipped:
        terminalreporter.write_line(
            f"{len(skipped)} tests of the live page and of reports were skipped: {NO_BROWSER}. "
            "On Debian: apt-get install chromium chromium-driver"
        )


def _rank(item: pytest.Item) -> int:
    if item.nodeid.startswith(SHORT):
        return len(FIRST)
    found = (rank for rank, folder in enumerate(FIRST) if item.nodeid.startswith(folder))
    return next(found, len(FIRST) + 1)
