"""Waiting for conditions that other threads or processes fulfil."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def wait_until(
    condition: Callable[[], T | None], within_s: float, state: Callable[[], object] = lambda: ""
) -> T:
    """Wait for a condition and return its value; evaluating it takes at most half of the time.

    Args:
        condition: whether what is waited for has come.
        within_s: maximum time.
        state: returns what the failure shows.
    """
    began_s = looked_s = time.monotonic()
    while not (found := condition()):
        now_s = time.monotonic()
        assert now_s < began_s + within_s, f"not within {within_s:g} s: {state()}"
        time.sleep(max(0.02, now_s - looked_s))
        looked_s = time.monotonic()
    return found
