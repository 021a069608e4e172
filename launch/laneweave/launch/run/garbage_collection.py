"""When cyclic garbage is looked for: hardly ever, since hardly any is made."""

from __future__ import annotations

import gc

_THRESHOLD = 50_000
"""Objects made before young ones are looked at; 700 by default, which costs a run 6 percent."""


def collect_seldom() -> None:
    """Look for cyclic garbage seldom, in this process from now on, and never at what is there."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(_THRESHOLD)
