"""For all tests: what they start can be interrupted, wherever they themselves were started."""

from __future__ import annotations

import signal


def pytest_configure() -> None:
    """Heed SIGINT: a shell's background jobs ignore it, and their children inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
