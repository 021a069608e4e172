"""Waiting for conditions that other threads or processes fulfil."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def wait_until(condition: Callable[[], T], within_s: float) -> T:
    """Wait for a condition and return its value; evaluating it takes at most half of the time."""
    began_s = looked_s = time.monotonic()
    while not (found := condition()):
        now_s = time.monotonic()
        assert now_s < began_s + within_s, f"not within {within_s:g} s"
        time.sleep(max(0.02, now_s - looked_s))
        looked_s = time.monotonic()
    return found
