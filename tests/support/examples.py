"""Property tests try all of their examples in `make test-more`, and a part in `make test`."""

from __future__ import annotations

from collections.abc import Collection

from hypothesis import HealthCheck, settings

SUPPRESSED = (HealthCheck.too_slow,)
"""Health checks of hypothesis that fail while the machine is busy."""
ALL = "all"
"""Profile (`--hypothesis-profile`) in which each test tries all of its examples."""
PART = "part"
"""Profile in which each test tries a part of its examples, the default."""
DIVISOR = 4
FEWEST = 10
USUAL = 100
"""Number of examples of a test that names none."""


def register_profiles() -> None:
    """Register both profiles, neither of which depends on the machine's load, and load one."""
    for name in (ALL, PART):
        settings.register_profile(
            name,
            deadline=None,
            suppress_health_check=SUPPRESSED,
            max_examples=_tried(USUAL, name),
        )
    settings.load_profile(PART)


def examples(number: int, *, suppress_health_check: Collection[HealthCheck] = ()) -> settings:
    """Return settings for a test; `number` is that of its examples in the profile `ALL`."""
    return settings(
        max_examples=_tried(number, settings.get_current_profile_name()),
        suppress_health_check=[*SUPPRESSED, *suppress_health_check],
    )


def _tried(number: int, profile: str) -> int:
    return number if profile == ALL else min(number, max(FEWEST, number // DIVISOR))
