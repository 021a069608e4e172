"""Garbage of simulated runs: most of what they make lives as long as they do."""

from __future__ import annotations

import gc

_THRESHOLD = 50_000
"""Objects made before young ones are looked at; 700 by default, which costs a run 6 percent."""


def collect_seldom() -> None:
    """Look for cyclic garbage seldom, in this process from now on, and never at what is there."""
    gc.freeze()
    gc.set_threshold(_THRESHOLD)
