"""Waiting for something that other threads or processes bring about."""

from __future__ import annotations

import time
from collections.abc import Callable


def wait_until(condition: Callable[[], object], within_s: float) -> None:
    """Wait for something to happen; at most half of the time is spent on looking for it."""
    began_s = looked_s = time.monotonic()
    while not condition():
        now_s = time.monotonic()
        assert now_s < began_s + within_s, f"not within {within_s:g} s"
        time.sleep(max(0.02, now_s - looked_s))
        looked_s = time.monotonic()
